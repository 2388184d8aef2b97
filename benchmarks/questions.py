"""What well-chosen questions save: labels, and what explanations cost with them.

    python benchmarks/questions.py identify      questions until it is known what one holds wrong
    python benchmarks/questions.py grid          labels × design × labeler × errors → types, costs
    python benchmarks/questions.py wrong         people whom the hypotheses do not fit
    python benchmarks/questions.py plot          the grid's picture, from its rows
    python benchmarks/questions.py speed         how long a choice of a question takes
    python benchmarks/questions.py --quick       a little of each, nothing written

Both shipped domains, and per seed two maps drawn at random (a rescue map whose cells all are
starts, a four-rooms map with goals, penalties and what people hold wrong drawn at random), on
which nothing was tuned. Types are drawn at random, two to five of them, by the seed; three
observers each. Explanations: QMDP at λ = 1; costs are means over traces and types.

Results go to benchmarks/results/. Rows of the grid are kept one by one in outputs/benchmarks/, and
a run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from hydra.utils import instantiate
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import OmegaConf
from sklearn.metrics import adjusted_rand_score

from xplain import Hypotheses, Questionnaire
from xplain.config import composed
from xplain.data.observers import SimulatedObservers
from xplain.data.queries import Answer, Independent, Queries
from xplain.domains.base import Domain, transition_features
from xplain.domains.four_rooms import FourRooms
from xplain.domains.rescue import Rescue
from xplain.errors import XplainError
from xplain.evaluation.episode import SimulatedUser, explain
from xplain.experiment.pipeline import (
    Observed,
    References,
    draw_trace,
    learn,
    learn_references,
)
from xplain.explanation.belief import Independent as IndependentLabels
from xplain.explanation.problem import Problem
from xplain.learning.user_types import UserTypes, p_explicable
from xplain.message_sets import indices
from xplain.questions.designs import Adaptive, Battery, hypotheses_of
from xplain.questions.labeler import HypothesisTrainer
from xplain.randomness import stream
from xplain.report.plots import COLOURS, MARKERS, STYLES
from xplain.solvers.qmdp import QMDP
from xplain.users.setting import Setting, UserType
from xplain.users.types import RandomCover

RESULTS = Path(__file__).parent / "results"
ROWS = Path("outputs/benchmarks/questions_grid.csv")
FIRST_SEED = 7200
MAPS = ("rescue", "four_rooms", "random rescue", "random rooms")
WAYS = {
    "random questions, trees": ("independent", "tree"),
    "by what was learned, trees": ("committee", "tree"),
    "random questions, hypotheses": ("independent", "hypotheses"),
    "battery, hypotheses": ("battery", "hypotheses"),
    "adaptive, hypotheses": ("adaptive", "hypotheses"),
    "adaptive in turn, hypotheses": ("in turn", "hypotheses"),
}
DRAWN = tuple(WAYS)[:5]
"""In the picture, and tried where no others are named."""
WRONG = (
    *("half", "double", "half or double", "tenth"),
    *("unwritten", "tire", "misread", "misread clips"),
)
MISREAD, CLIP = 0.15, 4
"""Share of the questions that are misread; transitions in a row where they are clips."""
FITTED, ALONE = "adaptive, hypotheses", "by what was learned, trees"
"""Of ``wrong``: what hypotheses make of people whom they do not fit, and labels alone."""
POINTS = (5, 10, 20, 40, 80, 320)
IDENTIFIED = ("map", "seed", "error", "questions", "right")
KEY = ["map", "way", "points", "error", "people", "seed"]


@cache
def domain_of(name: str, seed: int) -> Domain:
    """A shipped domain, or the random map of this seed."""
    kind = "rescue" if "rescue" in name else "four_rooms"
    cfg = composed("observe", [f"domain={kind}"]).domain
    if not name.startswith("random"):
        made: Domain = instantiate(cfg)
        return made
    rng = stream(seed, "benchmark", name)
    values: Any = OmegaConf.to_container(cfg, resolve=True)
    while True:
        try:
            drawn = _rescue(values, rng) if kind == "rescue" else _rooms(values, rng)
            matters = np.bitwise_or.reduce(hypotheses_of(drawn, None).matters)
        except XplainError:  # no way to the shelter, or ambiguous ties
            continue
        if int(matters) == (1 << len(drawn.parameters)) - 1:
            return drawn


def _rescue(values: Any, rng: np.random.Generator) -> Domain:
    """6 × 6, a fifth of it walls, two cells of each obstacle; every free cell is a start."""
    cells = np.full(36, ".", dtype="<U1")
    cells[rng.random(36) < 0.2] = "#"
    for symbol, cell in zip("SVAFUrrppff", rng.permutation(36), strict=False):
        cells[cell] = symbol
    text = "\n".join("".join(row) for row in cells.reshape(6, 6))
    return Rescue(text, values["parameters"], values["rescue_reward"], values["discount"])


def _rooms(values: Any, rng: np.random.Generator) -> Domain:
    """The four rooms, two goals, four penalty cells, all drawn; every free cell is a start."""
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


def setting_of(domain: Domain, people: str, seed: int) -> Setting:
    """Two to five types drawn at random; ``people`` says in what their values differ."""
    rng = stream(seed, "benchmark", "types")
    count = 2 + seed % 4
    types = RandomCover(count).types(domain, rng)
    scales = {"half": (0.5,), "double": (2.0,), "tenth": (0.1,), "half or double": (0.5, 2.0)}
    if people not in scales:
        return Setting.build(domain, types)
    accurate = {parameter.name: parameter.accurate for parameter in domain.parameters}

    def scaled(name: str, value: Any) -> Any:
        if not isinstance(value, (int, float)):
            return value
        other = value * float(rng.choice(scales[people]))
        try:
            domain.model(accurate | {name: other})
        except XplainError:
            return value
        return other

    own = [
        UserType(one.name, {name: scaled(name, value) for name, value in one.inaccurate.items()})
        for one in types
    ]
    return Setting.build(domain, tuple(own))


def design_of(way: str, path: str | None, error: float, people: str) -> tuple[Queries, Any]:
    """The query design and the trainer of a way."""
    asked, labeler = WAYS[way]
    clips = {"clip": CLIP, "misread": MISREAD} if people == "misread clips" else {}
    designs: dict[str, Queries] = {
        "independent": Independent(),
        "battery": Battery(hypotheses=path),
        "adaptive": Adaptive(error=max(error, 0.01), hypotheses=path, **clips),  # type: ignore[arg-type]
        "in turn": Adaptive(error=max(error, 0.01), hypotheses=path, in_turn=True),
        "committee": Adaptive(hypotheses="none"),
    }
    if labeler == "hypotheses":
        return designs[asked], None
    return designs[asked], instantiate(composed("discover", [f"labeler={labeler}"]).labeler)


@dataclass(frozen=True)
class Altered:
    """Asks through observers whose answers are altered."""

    queries: Queries
    alter: Callable[[Answer], Answer]

    def ask(self, setting: Setting, sizes: Any, answer: Answer, seed: int) -> Any:
        """As the queries."""
        return self.queries.ask(setting, sizes, self.alter(answer), seed)


def observed_by(
    setting: Setting, queries: Queries, points: int, error: float, people: str, seed: int
) -> Observed:
    """Labels of three observers a type, with their errors."""
    if people == "tire":
        error, queries = 0.0, Altered(queries, lambda answer: tired(answer, points, seed))
    elif people.startswith("misread"):
        queries = Altered(queries, lambda answer: misreading(answer, setting, seed))
    crowd = SimulatedObservers(3, points, error)
    return Observed(setting, *crowd.collect(setting, queries, seed))


def tired(answer: Answer, points: int, seed: int) -> Answer:
    """Errors rise from 2 to 15 % over an observer's labels."""
    asked: dict[int, int] = {}

    def worse(observer: int, transitions: Any, told: Any) -> NDArray[np.uint8]:
        before = asked.get(observer, 0)
        asked[observer] = before + len(told)
        rate = 0.02 + 0.13 * (before + np.arange(len(told))) / max(points - 1, 1)
        flip = stream(seed, "tire", observer, before).random(len(told)) < rate
        return answer(observer, transitions, told) ^ flip.astype(np.uint8)

    return worse


def misreading(answer: Answer, setting: Setting, seed: int) -> Answer:
    """A share of the questions is misread: one message is overlooked, or the label is that of what
    the robot may do next (at the end: of another way there)."""
    rng = stream(seed, "misread")
    reachable = setting.reachable

    def neighbour(transition: NDArray[np.int64]) -> NDArray[np.int64]:
        beside = reachable[reachable[:, 0] == transition[2]]
        if not len(beside):
            beside = reachable[reachable[:, 2] == transition[2]]
        chosen: NDArray[np.int64] = rng.choice(beside)
        return chosen

    def misread(observer: int, transitions: Any, told: Any) -> NDArray[np.uint8]:
        if rng.random() >= MISREAD:
            return answer(observer, transitions, told)
        messages = indices(int(told[0]))
        if messages and rng.random() < 0.5:
            return answer(observer, transitions, told & ~(1 << int(rng.choice(messages))))
        return answer(observer, np.array([neighbour(one) for one in transitions]), told)

    return misread


def row_of(
    name: str, way: str, points: int, error: float, people: str, seed: int, traces: int
) -> dict[str, Any]:
    """One data set: types found, labels learned, what explanations cost with them."""
    domain = domain_of(name, seed)
    setting = setting_of(domain, people, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = _without_a_fact(domain, seed, Path(folder)) if people == "unwritten" else None
        queries, trainer = design_of(way, path, error, people)
        trainer = trainer or HypothesisTrainer(domain=domain, path=path)
        observed = observed_by(setting, queries, points, error, people, seed)
        clusterer = instantiate(composed("discover", ["clusterer=dirichlet"]).clusterer)
        types = learn(observed.dataset, trainer, clusterer, seed)
        none = _none(observed, types, hypotheses_of(domain, path), error)
        references = learn_references(observed, trainer, seed)
    assert observed.truth is not None
    alike = setting.distinct[observed.truth]
    row = dict(zip(KEY, (name, way, points, error, people, seed), strict=True))
    row |= {
        "types": len(np.unique(alike)),
        "found": types.clustering.n_types,
        "ari": float(adjusted_rand_score(alike, types.clustering.assignment)),
        "none": none,
        "accuracy": _accuracy(setting, references),
    }
    return row | _costs(setting, types, references, traces, seed)


def _without_a_fact(domain: Domain, seed: int, folder: Path) -> str:
    """Hypotheses of somebody who never thought of one of the facts."""
    full = hypotheses_of(domain, None)
    fact = int(stream(seed, "benchmark", "unwritten").integers(full.n_messages))
    rows = np.flatnonzero(full.facts >> fact & 1 == 0)
    path = folder / "hypotheses.npz"
    Hypotheses.of(
        full.labels[rows],
        full.facts[rows],
        full.messages,
        features=full.features,
        feature_names=full.feature_names,
        states=full.states,
        variants=full.variants[:, rows] if len(full.variants) else full.variants,
    ).save(path)
    return str(path)


def _none(observed: Observed, types: UserTypes, hypotheses: Hypotheses, error: float) -> float:
    """Share of the observers whom rather no hypothesis fits: by their own questionnaires, or as
    their type holds something wrong that no hypothesis does."""
    dataset, needs = observed.dataset, types.clustering.needs
    unwritten = ~int(np.bitwise_or.reduce(hypotheses.facts))
    odd = np.zeros(0) if needs is None else needs[types.clustering.assignment] & unwritten
    hypotheses = hypotheses.told_apart_by_features()
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


def _accuracy(setting: Setting, references: References) -> float:
    """Labels predicted right, of all transitions and message sets, true types given."""
    assert references.oracle is not None
    features = transition_features(setting.domain, setting.reachable)
    table = p_explicable(references.oracle, features, setting.n_messages, setting.reachable)
    return float(((table >= 0.5) == setting.label_table(setting.reachable)).mean())


def _costs(
    setting: Setting, types: Any, references: References, traces: int, seed: int
) -> dict[str, float]:
    """Mean costs: QMDP with what was learned, with true types and labels (as they are, and with a
    confidence of .975, as people err), the learned oracle, the clairvoyant."""
    found: dict[str, list[float]] = {}
    n = setting.n_messages
    for index in range(traces):
        trace = draw_trace(setting, 40, seed, index)
        features, labels = transition_features(setting.domain, trace), setting.label_table(trace)
        assert references.oracle is not None
        learned, perfect = (
            p_explicable(labelers, features, n, trace)
            for labelers in (types.labelers, references.oracle)
        )
        truth = labels.astype(np.float64)
        tables = {"qmdp": learned, "true": truth, "true_975": 0.95 * truth + 0.025}
        problems = {key: Problem(table, np.ones(n)) for key, table in tables.items()}
        plans = {key: QMDP().plan(problem) for key, problem in problems.items()}
        for t in range(len(setting.types)):
            user = SimulatedUser(labels[t])
            runs = {key: (problems[key], plans[key]) for key in plans}
            for key, table in (("oracle", perfect), ("clairvoyant", truth)):
                alone = Problem(table[t : t + 1], np.ones(n))
                runs[key] = alone, QMDP().plan(alone)
            for key, (problem, plan) in runs.items():
                cost = explain(problem, plan, user, IndependentLabels()).cost
                found.setdefault(key, []).append(cost)
    return {key: float(np.mean(costs)) for key, costs in found.items()}


def identify(seeds: int, maps: list[str], each: int) -> pd.DataFrame:
    """Questions that one person is asked until the posterior of .95, and how often it is right:
    every fact set that some question tells from the others (or one in ``each``), once a seed."""
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


def speed() -> pd.DataFrame:
    """Seconds to choose a question, by candidates and transitions; two to four facts, drawn at
    random, decide about each transition. Medians over one person's first twelve questions, the
    first of which also works out which questions there are."""
    rows = []
    for n, count in ((6, 150), (12, 500)):
        rng = stream(0, "benchmark", "speed", n)
        sets = np.arange(1 << n)
        labels = np.empty((1 << n, count), dtype=np.uint8)
        for t in range(count):
            chosen = rng.choice(n, rng.integers(2, 5), replace=False)
            inner = (sets[:, None] >> chosen & 1) @ (1 << np.arange(len(chosen)))
            labels[:, t] = (rng.random(1 << len(chosen)) < 0.5)[inner]
            labels[inner == 0, t] = 1  # who holds nothing wrong finds it explicable
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


def grid(cells: list[tuple[Any, ...]], traces: int, quick: bool) -> pd.DataFrame:
    """The rows of these cells; one done before is not made again."""
    known = pd.DataFrame(columns=KEY)
    if ROWS.exists() and not quick:
        known = pd.read_csv(ROWS)
    done = set(known[KEY].itertuples(index=False, name=None))
    made = []
    for cell in cells:
        if cell in done:
            continue
        try:
            made.append(row_of(*cell, traces))
        except XplainError as error:  # types at other values may tie ambiguously
            print(*cell, error)
            continue
        if not quick:
            ROWS.parent.mkdir(parents=True, exist_ok=True)
            line = pd.DataFrame(made[-1:])
            line.to_csv(ROWS, mode="a", header=not ROWS.exists(), index=False, float_format="%.5g")
    return pd.concat([known, pd.DataFrame(made)]) if len(known) else pd.DataFrame(made)


def summary(rows: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Means, and costs as ratios of means, by maps, ways and people in the order of above."""
    orders = {"map": MAPS, "way": tuple(WAYS), "people": ("as assumed", *WRONG)}
    rows = rows.assign(**{key: pd.Categorical(rows[key], orders[key]) for key in orders})
    cells = rows.groupby(by, observed=True)
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
    """The data sets to which every way was applied that was tried with as many labels: costs
    differ more between types drawn than between designs."""
    rows = rows[(rows["people"] == "as assumed") & (rows["error"] == 0.05)]
    rows = rows[rows["way"].isin(DRAWN)]
    tried = rows.groupby("points")["way"].transform("nunique")
    return rows[rows.groupby(["map", "points", "seed"])["way"].transform("nunique") == tried]


def picture(rows: pd.DataFrame) -> Figure:
    """What an explanation costs against what was asked, by design: as a multiple of what it costs
    with true labels (ratio of means over seeds, 95 % of its bootstrap)."""
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
    axes[0, 0].set_ylabel("cost of an explanation,\ntimes that with true labels")
    ticks = [t for t in (1, 2, 5, 10, 20, 50, 100) if t <= axes[0, 0].get_ylim()[1]]
    axes[0, 0].set_yticks(ticks, [f"{t}×" for t in ticks])
    axes[0, 0].set_ylim(bottom=0.85)
    axes[0, 0].text(POINTS[0], 0.98, "true labels known", fontsize=8, va="top")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    figure.suptitle("What an explanation costs against what was asked (one answer in 20 wrong)")
    return figure


def multiple(cell: pd.DataFrame) -> tuple[float, float, float]:
    """Mean cost over that with true labels, and 95 % of its bootstrap over data sets."""
    costs = cell[["qmdp", "true"]].to_numpy()
    drawn = stream(0, "benchmark", "bootstrap").integers(0, len(costs), (1000, len(costs)))
    learned, true = costs[drawn].sum(axis=1).T
    low, high = np.quantile(learned / true, [0.025, 0.975])
    return float(costs[:, 0].sum() / costs[:, 1].sum()), float(low), float(high)


def written(table: pd.DataFrame, name: str, quick: bool) -> None:
    """Prints a table, and keeps it."""
    shown = table.round(3)
    lines = [" | ".join(shown.columns), " | ".join("---" for _ in shown.columns)]
    lines += [" | ".join(map(str, row)) for row in shown.itertuples(index=False)]
    text = "\n".join(f"| {line} |" for line in lines) + "\n"
    print(text)
    if not quick:
        (RESULTS / f"{name}.md").write_text(text, encoding="utf-8")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="?", choices=["identify", "grid", "wrong", "plot", "speed"])
    parser.add_argument("--quick", action="store_true", help="a little of each, nothing written")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--traces", type=int, default=10)
    parser.add_argument("--points", type=int, nargs="+", default=list(POINTS))
    parser.add_argument("--errors", type=float, nargs="+", default=[0.05, 0.0])
    parser.add_argument("--maps", nargs="+", default=list(MAPS))
    parser.add_argument("--ways", nargs="+", default=list(DRAWN))
    given = parser.parse_args()
    people, each, asked = WRONG, 1, 40
    if given.quick:
        given.seeds, given.traces, given.points, given.errors = 1, 2, [10], [0.05]
        given.maps, people, each = ["random rescue"], ("unwritten", "misread clips"), 32
        asked = 10
    every = range(FIRST_SEED, FIRST_SEED + given.seeds)
    if given.part in ("identify", None):
        rows = identify(given.seeds, given.maps, each)
        table = rows.groupby(["map", "error"], sort=False)[["questions", "right"]].mean()
        written(table.reset_index(), "questions_identify", given.quick)
    if given.part in ("grid", None):
        cells = [
            (name, way, count, error, "as assumed", seed)
            for seed, error, count, name, way in product(
                every, given.errors, given.points, given.maps, given.ways
            )
        ]
        rows = grid(cells, given.traces, given.quick)
        rows = rows[rows["people"] == "as assumed"]
        written(summary(rows, ["map", "way", "points", "error"]), "questions_grid", given.quick)
        if given.quick:
            picture(comparable(rows))
    if given.part in ("wrong", None):
        cells = [
            (name, way, asked, 0.05, who, seed)
            for seed, who, name in product(every, people, given.maps[2:] or given.maps)
            for way in (FITTED, ALONE)[: 2 if who == "unwritten" else 1]
        ]
        rows = grid(cells, given.traces, given.quick)
        rows = rows[(rows["people"] != "as assumed") & (rows["points"] == asked)]
        written(summary(rows, ["people", "way", "map"]), "questions_wrong", given.quick)
    if given.part in ("speed", None):
        written(speed(), "questions_speed", given.quick)
    if given.part in ("plot", "grid") and not given.quick and ROWS.exists():
        rows = comparable(pd.read_csv(ROWS))
        if len(rows):
            picture(rows).savefig(RESULTS / "questions_grid.png", dpi=150)


if __name__ == "__main__":
    main()
