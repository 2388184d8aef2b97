"""Measures what well-chosen questions save: labels, and costs of explanations.

    python benchmarks/questions.py identify      questions until incorrect beliefs are known
    python benchmarks/questions.py grid          labels × design × labeler × errors → types, costs
    python benchmarks/questions.py people        people who are not as assumed (people.py)
    python benchmarks/questions.py labels        how many of their labels differ, by kind
    python benchmarks/questions.py plot          the pictures, from the rows
    python benchmarks/questions.py speed         time to choose a question
    python benchmarks/questions.py --quick       a little of each, nothing written

Each seed has both domains and two random maps, on which nothing was tuned: a rescue map whose cells
are all starts, and a four-rooms map with random goals, penalties and incorrect beliefs. Each seed
draws two to five types, with three observers each. QMDP explains at λ = 1; costs are means over
traces and types.

Results go to benchmarks/results/. If a part runs with some options only, all other rows of its
table stay, with the day of their measurement. Rows of the grid are saved one by one in
outputs/benchmarks/, those of people beside the table, and a stopped run continues there.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from datetime import date
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from hydra.utils import instantiate
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from omegaconf import OmegaConf
from people import (
    AS_ASSUMED,
    BY_A_VARIANT,
    CLIP,
    IN_WORDS,
    KINDS,
    MISREAD,
    OTHER_VALUES,
    Altered,
    differing,
    misreading,
    scrambled,
    setting_of,
    tired,
    without_a_fact,
)
from sklearn.metrics import adjusted_rand_score

from xplain import Hypotheses, Questionnaire
from xplain.domains.base import Domain, transition_features
from xplain.domains.four_rooms import FourRooms
from xplain.domains.rescue import Rescue
from xplain.domains.users.hypotheses import hypotheses_of
from xplain.domains.users.setting import Setting
from xplain.errors import XplainError
from xplain.experiment.config import compose_config
from xplain.experiment.pipeline import draw_trace
from xplain.explanation.belief import Independent as IndependentLabels
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.learning.data.observers import Observations, SimulatedObservers
from xplain.learning.data.queries import Independent, Queries
from xplain.learning.labelers import Labeler
from xplain.learning.mixture.labeler import HypothesisTrainer
from xplain.learning.user_types import UserTypes, label_table, learn_perfect, oracle_labelers
from xplain.questions.designs import Adaptive, Battery
from xplain.randomness import stream
from xplain.report.plots import COLOURS, MARKERS, STYLES
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP

RESULTS = Path(__file__).parent / "results"
ROWS = Path("outputs/benchmarks/questions_grid.csv")
PEOPLE = RESULTS / "questions_people.csv"
FIRST_SEED = 7200
MAPS = ("rescue", "four_rooms", "random rescue", "random rooms")
WAYS = {
    "random questions, trees": ("independent", "tree"),
    "random questions, hypotheses": ("independent", "hypotheses"),
    "battery, hypotheses": ("battery", "hypotheses"),
    "adaptive, hypotheses": ("adaptive", "hypotheses"),
    "adaptive in turn, hypotheses": ("in turn", "hypotheses"),
}
DRAWN = tuple(WAYS)[:4]
"""Ways in the picture, and the default."""
COMPARED = {"adaptive, hypotheses": (20, 40), "random questions, trees": (40,)}
"""For ``people``: labels of each person, by way. The second way has no hypotheses."""
POINTS = (5, 10, 20, 40, 80, 320)
IDENTIFIED = ("map", "seed", "error", "questions", "right")
PARTS = ("identify", "grid", "people", "labels", "plot", "speed")
SPEEDS = ((6, 150), (12, 500))
"""Facts and transitions, for ``speed``."""
KEY = ["map", "way", "points", "error", "people", "seed"]


@cache
def domain_of(name: str, seed: int) -> Domain:
    """Makes a shipped domain, or the random map of this seed."""
    kind = "rescue" if "rescue" in name else "four_rooms"
    cfg = compose_config("observe", [f"domain={kind}"]).domain
    if not name.startswith("random"):
        made: Domain = instantiate(cfg)
        return made
    rng = stream(seed, "benchmark", name)
    values: Any = OmegaConf.to_container(cfg, resolve=True)
    while True:
        try:
            drawn = _draw_rescue(values, rng) if kind == "rescue" else _draw_rooms(values, rng)
            matters = np.bitwise_or.reduce(hypotheses_of(drawn, None).matters)
        except XplainError:  # no way to the shelter, or ambiguous ties
            continue
        if int(matters) == (1 << len(drawn.parameters)) - 1:
            return drawn


def _draw_rescue(values: Any, rng: np.random.Generator) -> Domain:
    """Draws a map of 6 × 6 cells, a fifth of them walls, with two cells of each obstacle; every
    free cell is a start."""
    cells = np.full(36, ".", dtype="<U1")
    cells[rng.random(36) < 0.2] = "#"
    for symbol, cell in zip("SVAFUrrppff", rng.permutation(36), strict=False):
        cells[cell] = symbol
    text = "\n".join("".join(row) for row in cells.reshape(6, 6))
    return Rescue(text, values["parameters"], values["rescue_reward"], values["discount"])


def _draw_rooms(values: Any, rng: np.random.Generator) -> Domain:
    """Draws two goals and four penalty cells in the four rooms; every free cell is a start."""
    text = values["map"].replace("s", ".")
    free = [(r, c) for r, line in enumerate(text.split()) for c, x in enumerate(line) if x == "."]

    def cell() -> list[int]:
        return [int(x) for x in free[rng.integers(len(free))]]

    goals = [{"cell": cell(), "reward": float(rng.integers(2, 8))} for _ in range(2)]
    moved = [goals[0], {"cell": cell(), "reward": goals[1]["reward"]}]
    drawn = {
        "goals": (goals, moved),
        "discount": (0.9, float(rng.choice([0.5, 0.7, 0.97]))),
        "step_cost": (0.0, float(rng.choice([0.25, 0.5, 1.0]))),
        "penalty_cells": ([cell() for _ in range(4)], [cell() for _ in range(4)]),
        "penalty": (float(rng.choice([1.0, 2.0, 4.0])), 0.05),
    }
    parameters = {
        name: fields | dict(zip(("accurate", "inaccurate"), drawn[name], strict=True))
        for name, fields in values["parameters"].items()
    }
    return FourRooms(text, parameters)


def design_of(way: str, path: str | None, error: float, people: str) -> tuple[Queries, Any]:
    """Makes the query design and the trainer of a way."""
    asked, labeler = WAYS[way]
    clips = {"clip": CLIP, "misread": MISREAD} if people == "misread clips" else {}
    designs: dict[str, Queries] = {
        "independent": Independent(),
        "battery": Battery(hypotheses=path),
        "adaptive": Adaptive(error=max(error, 0.01), hypotheses=path, **clips),  # type: ignore[arg-type]
        "in turn": Adaptive(error=max(error, 0.01), hypotheses=path, in_turn=True),
    }
    if labeler == "hypotheses":
        return designs[asked], None
    return designs[asked], instantiate(compose_config("discover", [f"labeler={labeler}"]).labeler)


def observed_by(
    setting: Setting, queries: Queries, points: int, error: float, people: str, seed: int
) -> Observations:
    """Collects labels of three observers of each type, with their errors."""
    if people == "tire":
        error, queries = 0.0, Altered(queries, lambda answer: tired(answer, points, seed))
    elif people.startswith("misread"):
        queries = Altered(queries, lambda answer: misreading(answer, setting, seed))
    crowd = SimulatedObservers(3, points, error)
    return crowd.collect(setting, queries, seed)


def row_of(
    name: str, way: str, points: int, error: float, people: str, seed: int, traces: int
) -> dict[str, Any]:
    """Measures one data set: types found, labels learned, costs of explanations."""
    domain = domain_of(name, seed)
    setting = setting_of(domain, people, seed)
    with tempfile.TemporaryDirectory() as folder:
        files = {"unwritten": without_a_fact, "scrambled": scrambled}
        path = files[people](domain, seed, Path(folder)) if people in files else None
        queries, trainer = design_of(way, path, error, people)
        trainer = trainer or HypothesisTrainer(path=path)
        observed = observed_by(setting, queries, points, error, people, seed)
        clusterer = instantiate(
            compose_config("discover", ["clusterer=dirichlet"]).clusterer, _partial_=True
        )
        types = clusterer(labeler=trainer).find(observed, seed)
        none = _measure_none(observed, types, hypotheses_of(domain, path), error)
        given = trainer.adapt_to(observed)
        perfect = learn_perfect(observed, given, seed, types)
        oracle = oracle_labelers(perfect, observed)
    assert observed.truth is not None
    alike = setting.distinct[observed.truth]
    row = dict(zip(KEY, (name, way, points, error, people, seed), strict=True))
    row |= {
        "types": len(np.unique(alike)),
        "found": types.clustering.n_types,
        "ari": float(adjusted_rand_score(alike, types.clustering.assignment)),
        "none": none,
        "accuracy": _measure_accuracy(setting, oracle),
    }
    return row | _measure_costs(setting, types, oracle, traces, seed)


def _measure_none(
    observed: Observations, types: UserTypes, hypotheses: Hypotheses, error: float
) -> float:
    """Returns the share of observers whom probably no hypothesis fits, by their own questionnaires,
    or because their type believes something incorrectly that no hypothesis contains."""
    dataset, needs = observed.dataset, types.clustering.needs
    unwritten = ~int(np.bitwise_or.reduce(hypotheses.facts))
    odd = np.zeros(0) if needs is None else needs[types.clustering.assignment] & unwritten
    hypotheses = hypotheses.drop_indistinguishable()
    assert hypotheses.features is not None
    place = {row.tobytes(): t for t, row in enumerate(hypotheses.features)}
    said = []
    for o in range(len(dataset.observers)):
        questions = Questionnaire(hypotheses, max(error, 0.01))
        for p in np.flatnonzero(dataset.observer == o):
            t = place.get(dataset.features[dataset.transition[p]].tobytes())
            if t is not None:
                questions.answer(int(dataset.label[p]), (t, int(dataset.message_set[p])))
        said.append(questions.none > 0.5 or (len(odd) > 0 and bool(odd[o])))
    return float(np.mean(said))


def _measure_accuracy(setting: Setting, oracle: tuple[Labeler, ...] | None) -> float:
    """Returns the share of right predictions over all transitions and message sets, given true
    types."""
    assert oracle is not None
    features = transition_features(setting.domain, setting.reachable)
    table = label_table(oracle, features, setting.reachable).array(setting.n_messages)
    return float(((table >= 0.5) == setting.label_table(setting.reachable)).mean())


def _measure_costs(
    setting: Setting, types: Any, oracle: tuple[Labeler, ...] | None, traces: int, seed: int
) -> dict[str, float]:
    """Returns the mean costs of QMDP with learned types and labels, with true types and labels, and
    with true labels at a confidence of 0.975 (because people err); and the mean costs of the
    learned oracle and the clairvoyant."""
    found: dict[str, list[float]] = {}
    n = setting.n_messages
    for index in range(traces):
        trace = draw_trace(setting, 40, seed, index)
        features, labels = transition_features(setting.domain, trace), setting.label_table(trace)
        assert oracle is not None
        learned, perfect = (
            label_table(labelers, features, trace).array(n) for labelers in (types.labelers, oracle)
        )
        truth = labels.astype(np.float64)
        tables = {"qmdp": learned, "true": truth, "true_975": 0.95 * truth + 0.025}
        problems = {key: Problem(table, np.ones(n)) for key, table in tables.items()}
        plans = {key: QMDP().plan(problem) for key, problem in problems.items()}
        for t in range(len(setting.types)):
            user = SimulatedUser.of(labels[t])
            runs = {key: (problems[key], plans[key]) for key in plans}
            for key, table in (("oracle", perfect), ("clairvoyant", truth)):
                alone = Problem(table[t : t + 1], np.ones(n))
                runs[key] = alone, QMDP().plan(alone)
            for key, (problem, plan) in runs.items():
                cost = explain(problem, CachedPolicy(plan), user, IndependentLabels()).cost
                found.setdefault(key, []).append(cost)
    return {key: float(np.mean(costs)) for key, costs in found.items()}


def identify(seeds: int, maps: list[str], each: int) -> pd.DataFrame:
    """Measures the number of questions to one person until the posterior is 0.95, and the share of
    right results: once per seed for every fact set that questions can distinguish (or for one in
    ``each``)."""
    rows = []
    for name, seed, error in product(maps, range(FIRST_SEED, FIRST_SEED + seeds), (0.0, 0.05)):
        hypotheses = hypotheses_of(domain_of(name, seed), None)
        for held in np.unique(hypotheses.essential).tolist()[::each]:
            rng = stream(seed, "benchmark", "person", int(held))
            questions = Questionnaire(hypotheses, max(error, 0.01), seed=seed * 64 + int(held))
            row = int(hypotheses.row(np.array(held)))
            while not questions.done and len(questions.asked) < 200:
                t, told = questions.next()
                label = int(hypotheses.label([t], told)[0, row, 0])  # type: ignore[list-item]
                questions.answer(label ^ int(rng.random() < error))
            count, right = len(questions.asked), questions.best == held
            values = (name, seed, error, count, right)
            rows.append(dict(zip(IDENTIFIED, values, strict=True)))
    return pd.DataFrame(rows)


def speed(sizes: Sequence[tuple[int, int]]) -> pd.DataFrame:
    """Measures the seconds to choose a question, by candidates and transitions; two to four random
    facts decide about each transition. Figures are medians over one person's first twelve
    questions; the first question's time includes listing all questions."""
    rows = []
    for n, count in sizes:
        rng = stream(0, "benchmark", "speed", n)
        sets = np.arange(1 << n)
        labels = np.empty((1 << n, count), dtype=np.uint8)
        for t in range(count):
            chosen = rng.choice(n, rng.integers(2, 5), replace=False)
            inner = (sets[:, None] >> chosen & 1) @ (1 << np.arange(len(chosen)))
            labels[:, t] = (rng.random(1 << len(chosen)) < 0.5)[inner]
            labels[inner == 0, t] = 1  # people without incorrect beliefs find it explicable
        questions = Questionnaire(labels)
        held, seconds = int(rng.integers(1 << n)), []
        for _ in range(12):
            began = time.perf_counter()
            t, told = questions.next()
            seconds.append(time.perf_counter() - began)
            label = int(labels[held & ~told, t])  # type: ignore[call-overload]
            questions.answer(label ^ int(rng.random() < 0.05))
        rows.append((n, count, seconds[0] * 1e3, float(np.median(seconds[1:])) * 1e3))
    return pd.DataFrame(rows, columns=["facts", "transitions", "first (ms)", "later (ms)"])


def grid(cells: list[tuple[Any, ...]], traces: int, kept: Path | None) -> pd.DataFrame:
    """Makes the rows of these cells, except those in ``kept``."""
    known = pd.read_csv(kept) if kept and kept.exists() else pd.DataFrame(columns=KEY)
    done = set(known[KEY].itertuples(index=False, name=None))
    made = []
    for cell in cells:
        if cell in done:
            continue
        try:
            made.append(row_of(*cell, traces=traces))
        except XplainError as error:  # with other values, the types do not differ
            print(*cell, error)
            continue
        if kept:
            kept.parent.mkdir(parents=True, exist_ok=True)
            line = pd.DataFrame(made[-1:])
            line.to_csv(kept, mode="a", header=not kept.exists(), index=False, float_format="%.5g")
    return pd.concat([known, pd.DataFrame(made)]) if len(known) else pd.DataFrame(made)


def in_order(rows: pd.DataFrame) -> pd.DataFrame:
    """Makes categories of maps, ways and people, in the order above."""
    orders = {"map": MAPS, "way": tuple(WAYS), "people": KINDS}
    orders = {key: order for key, order in orders.items() if key in rows}
    return rows.assign(**{key: pd.Categorical(rows[key], orders[key]) for key in orders})


def summary(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Returns means, and costs as ratios of means, by maps, ways and people in the order above."""
    cells = in_order(rows).groupby(by, observed=True)
    table = cells[["ari", "accuracy", "none"]].mean()
    mean = cells[["qmdp", "true", "true_975", "oracle", "clairvoyant"]].mean()
    table["qmdp / true"] = mean["qmdp"] / mean["true"]
    table["qmdp / true .975"] = mean["qmdp"] / mean["true_975"]
    table["oracle / clairvoyant"] = mean["oracle"] / mean["clairvoyant"]
    table["cost"] = mean["qmdp"]
    table["floor"] = mean["clairvoyant"]
    table.insert(0, "seeds", cells["seed"].nunique())
    return table.reset_index()


def comparable(rows: pd.DataFrame) -> pd.DataFrame:
    """Returns the data sets that have all ways with the same number of labels, because costs differ
    more between types than between designs."""
    rows = rows[(rows["people"] == AS_ASSUMED) & (rows["error"] == 0.05)]
    rows = rows[rows["way"].isin(DRAWN)]
    tried = rows.groupby("points")["way"].transform("nunique")
    return rows[rows.groupby(["map", "points", "seed"])["way"].transform("nunique") == tried]


def picture(rows: pd.DataFrame) -> Figure:
    """Draws the cost of an explanation against the number of questions, by design, as a multiple of
    the cost with true labels (ratio of means over seeds, with its 95 % bootstrap interval)."""
    shown = [name for name in MAPS if name in set(rows["map"])]
    figure, axes = plt.subplots(
        *(1, len(shown)),
        figsize=(3.2 * len(shown) + 0.4, 4.0),
        layout="constrained",
        squeeze=False,
        sharey=True,
    )
    for axis, name in zip(axes[0], shown, strict=True):
        part = rows[rows["map"] == name]
        for i, way in enumerate(DRAWN):
            cells = part[part["way"] == way].groupby("points")
            if not len(cells):
                continue
            ratio, low, high = np.array([multiple(own) for _, own in cells]).T
            points = np.array(sorted(cells.groups))
            style = {"color": COLOURS[i], "marker": MARKERS[i], "linestyle": STYLES[i]}
            axis.plot(points, ratio, label=way, markersize=5, **style)
            axis.fill_between(points, low, high, color=COLOURS[i], alpha=0.15, linewidth=0)
        axis.axhline(1, color="black", linewidth=1)
        axis.set(title=name.replace("_", " "), xscale="log", yscale="log")
        axis.set_xlabel("labels asked of each person")
        axis.set_xticks(sorted(part["points"].unique()), sorted(part["points"].unique()))
        axis.minorticks_off()
    axes[0, 0].set_ylabel("cost of an explanation,\ndivided by the cost with true labels")
    ticks = [t for t in (1, 2, 5, 10, 20, 50, 100) if t <= axes[0, 0].get_ylim()[1]]
    axes[0, 0].set_yticks(ticks, [f"{t}×" for t in ticks])
    axes[0, 0].set_ylim(bottom=0.85)
    axes[0, 0].text(POINTS[0], 0.98, "true labels known", fontsize=8, va="top")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    figure.suptitle("What an explanation costs against what was asked (one answer in 20 wrong)")
    return figure


def multiple(cell: pd.DataFrame) -> tuple[float, float, float]:
    """Returns the mean cost divided by the cost with true labels, and the 95 % bootstrap interval
    over data sets."""
    costs = cell[["qmdp", "true"]].to_numpy()
    drawn = stream(0, "benchmark", "bootstrap").integers(0, len(costs), (1000, len(costs)))
    learned, true = costs[drawn].sum(axis=1).T
    low, high = np.quantile(learned / true, [0.025, 0.975])
    return float(costs[:, 0].sum() / costs[:, 1].sum()), float(low), float(high)


def picture_of_people(rows: pd.DataFrame) -> Figure:
    """Draws the cost of an explanation by kind of people: people as the hypotheses assume, and
    others; and for the same people the cost after random questions, without hypotheses."""
    shown = [name for name in MAPS if name in set(rows["map"])]
    kinds = [kind for kind in KINDS if kind in set(rows["people"])]
    figure, axes = plt.subplots(
        *(1, len(shown)),
        figsize=(3.2 * len(shown) + 0.4, 0.42 * len(kinds) + 1.9),
        layout="constrained",
        squeeze=False,
        sharex=True,
        sharey=True,
    )
    compared = [(way, count) for way, counts in COMPARED.items() for count in counts]
    for axis, name in zip(axes[0], shown, strict=True):
        part = rows[rows["map"] == name]
        for i, (way, count) in enumerate(compared):
            cells = part[(part["way"] == way) & (part["points"] == count)].groupby("people")
            for kind, own in cells:
                ratio, low, high = multiple(own)
                y = kinds.index(str(kind)) + 0.2 * (i - (len(compared) - 1) / 2)
                axis.plot([low, high], [y, y], color=COLOURS[i], linewidth=1.5)
                axis.plot(ratio, y, MARKERS[i], color=COLOURS[i], markersize=5, linestyle="none")
        axis.axvline(1, color="black", linewidth=1)
        axis.set(title=name.replace("_", " "), xscale="log")
        axis.set_yticks(range(len(kinds)), [IN_WORDS.get(kind, kind) for kind in kinds])
    axes[0, 0].invert_yaxis()
    ticks = [t for t in (1, 2, 5, 10, 20, 50, 100) if t <= axes[0, 0].get_xlim()[1]]
    for axis in axes[0]:
        axis.set_xticks(ticks, [f"{t}×" for t in ticks])
        axis.minorticks_off()
    handles = [
        Line2D([], [], color=COLOURS[i], marker=MARKERS[i], label=f"{count} labels: {way}")
        for i, (way, count) in enumerate(compared)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    title = "What an explanation costs by what people believe, times that with true labels"
    figure.suptitle(f"{title} (one answer in 20 wrong)")
    return figure


def stored(name: str, columns: list[str]) -> pd.DataFrame:
    """Reads the table that was written before; empty if there is none with these columns."""
    path = RESULTS / f"{name}.md"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else [""]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    if cells[0] != columns:
        return pd.DataFrame(columns=columns)
    return pd.DataFrame(cells[2:], columns=columns)


def written(table: pd.DataFrame, name: str, by: list[str], quick: bool) -> None:
    """Prints a table and saves it; rows with other keys (``by``) in the file stay."""
    shown = table.round(3).assign(measured=str(date.today())).astype(str)
    if not quick:
        before = stored(name, list(shown.columns))
        other = ~before.set_index(by).index.isin(shown.set_index(by).index)
        shown = in_order(pd.concat([before[other], shown]))
        number = {key: pd.to_numeric(shown[key]) for key in ("points", "error") if key in shown}
        order = shown.assign(**number).reset_index(drop=True).sort_values(by).index
        shown = shown.iloc[order]
    lines = [" | ".join(shown.columns), " | ".join("---" for _ in shown.columns)]
    lines += [" | ".join(map(str, row)) for row in shown.itertuples(index=False)]
    text = "\n".join(f"| {line} |" for line in lines) + "\n"
    print(text)
    if not quick:
        (RESULTS / f"{name}.md").write_text(text, encoding="utf-8")


def labels_that_differ(maps: Sequence[str], seeds: int) -> None:
    """Prints the shares of labels that differ from the hypotheses, and from the nearest variant."""
    print("| labels that differ from | " + " | ".join(maps) + " |")
    print("|---" * (len(maps) + 1) + "|")
    for people in (*BY_A_VARIANT, *OTHER_VALUES):
        cells = []
        for name in maps:
            every = range(FIRST_SEED, FIRST_SEED + seeds)
            found = [differing(domain_of(name, seed), people, seed) for seed in every]
            assumed, nearest = np.mean(found, axis=0)
            cells.append(f"{assumed:.1%} / {nearest:.1%}")
        print(f"| {people}: as assumed / nearest variant | " + " | ".join(cells) + " |")


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="?", choices=PARTS)
    parser.add_argument("--quick", action="store_true", help="a little of each, nothing written")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--traces", type=int, default=10)
    parser.add_argument("--points", type=int, nargs="+", default=list(POINTS))
    parser.add_argument("--errors", type=float, nargs="+", default=[0.05, 0.0])
    parser.add_argument("--maps", nargs="+", default=list(MAPS))
    parser.add_argument("--ways", nargs="+", default=list(DRAWN))
    parser.add_argument("--people", nargs="+", default=list(KINDS), choices=KINDS)
    given = parser.parse_args()
    each, compared = 1, COMPARED
    if given.quick:
        given.seeds, given.traces, given.points, given.errors = 1, 1, [5], [0.05]
        given.maps, given.people, each = ["random rooms"], ["unwritten", "misread clips"], 32
        compared = dict.fromkeys(COMPARED, (5,))
    every = range(FIRST_SEED, FIRST_SEED + given.seeds)
    if given.part in ("identify", None):
        rows = identify(given.seeds, given.maps, each)
        table = rows.groupby(by := ["map", "error"], sort=False)[["questions", "right"]].mean()
        written(table.reset_index(), "questions_identify", by, given.quick)
    if given.part in ("grid", None):
        cells = [
            (name, way, count, error, AS_ASSUMED, seed)
            for seed, error, count, name, way in product(
                every, given.errors, given.points, given.maps, given.ways
            )
        ]
        rows = grid(cells, given.traces, None if given.quick else ROWS)
        by = ["map", "way", "points", "error"]
        written(summary(rows, by), "questions_grid", by, given.quick)
        if given.quick:
            picture(comparable(rows))
    if given.part in ("people", None):
        cells = [
            (name, way, count, 0.05, who, seed)
            for seed, who, name in product(every, given.people, given.maps)
            for way, counts in compared.items()
            for count in counts
        ]
        rows = grid(cells, given.traces, None if given.quick else PEOPLE)
        by = ["people", "way", "points", "map"]
        written(summary(rows, by), "questions_people", by, given.quick)
        if given.quick:
            picture_of_people(rows)
    if given.part in ("labels", None):
        labels_that_differ(*((MAPS[2:3], 1) if given.quick else (given.maps, given.seeds)))
    if given.part in ("speed", None):
        rows = speed(SPEEDS[:1] if given.quick else SPEEDS)
        written(rows, "questions_speed", ["facts", "transitions"], given.quick)
    if given.part in ("plot", "grid", "people") and not given.quick:
        drawings = {
            "grid": (ROWS, comparable, picture),
            "people": (PEOPLE, in_order, picture_of_people),
        }
        for name, (path, chosen, draw) in drawings.items():
            if path.exists() and len(rows := chosen(pd.read_csv(path))):
                draw(rows).savefig(RESULTS / f"questions_{name}.png", dpi=150)


if __name__ == "__main__":
    main()
