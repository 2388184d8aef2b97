"""Measures how well methods find the types of simulated observers, by kind of data.

    python benchmarks/discovery.py goals      the settings with goals of the project
    python benchmarks/discovery.py grid       domains × questions × noise × points × types
    python benchmarks/discovery.py growth     time against observers and labels
    python benchmarks/discovery.py --quick    a little of each, nothing written

Every method has one setting for all rows (conf/clusterer/<method>.yaml). Seeds from 5000 on are
kept for this benchmark; methods were made and tuned on other seeds. Types with the same labels for
all reachable questions count as one. The held-out log-likelihood (nats per label) is for the
paper's trees, fitted to the clusters found, on a held-out quarter of the distinct questions. The
clusters were found from all labels. Times are CPU seconds to find the types.

Results go to benchmarks/results/. The grid takes long: each row is saved in outputs/benchmarks/,
and a stopped run continues there.
"""

import argparse
import hashlib
import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from hydra.utils import instantiate
from joblib import Parallel, delayed
from matplotlib.figure import Figure
from numpy.typing import NDArray
from omegaconf import OmegaConf
from sklearn.metrics import adjusted_rand_score

from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting
from xplain.domains.users.types import RandomCover
from xplain.experiment.config import compose_config
from xplain.explanation.belief import Independent
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.learning.data import queries as designs
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations, SimulatedObservers
from xplain.learning.data.queries import sample_trace
from xplain.learning.labelers import LabelerTrainer, split
from xplain.learning.prediction import log_likelihoods
from xplain.learning.types import Clustering
from xplain.learning.user_types import Perfect, UserTypes, label_table, learn_types
from xplain.randomness import stream
from xplain.report.plots import COLOURS, MARKERS, STYLES
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP

RESULTS = Path(__file__).parent / "results"
ROWS = Path("outputs/benchmarks/discovery_grid.csv")
FIRST_SEED = 5000
QUERIES = {"shared": designs.Shared(), "independent": designs.Independent()}
DATA = ["domain", "types", "queries", "points", "noise"]
FIGURES = ["ari", "found", "held_out", "cpu_seconds"]
GOALS = [  # domain, types, questions, points, noise, goal
    ("rescue", None, "shared", 300, 0.0, 1.0),
    ("rescue", None, "independent", 300, 0.0, 0.95),
    ("rescue", None, "independent", 300, 0.05, 0.85),
    ("four_rooms", 2, "independent", 100, 0.0, 0.9),
    ("four_rooms", 3, "independent", 100, 0.0, 0.9),
    ("four_rooms", 4, "independent", 100, 0.0, 0.9),
]


@lru_cache(maxsize=8)
def setting_of(domain: str, types: int | None, seed: int) -> Setting:
    """Returns the domain's own types, or this number of random types."""
    cfg = compose_config("observe", [f"domain={domain}"])
    made = instantiate(cfg.domain)
    source = instantiate(cfg.users) if types is None else RandomCover(types)
    return Setting.build(made, source.types(made, stream(seed, "users")))


@cache
def clusterer(method: str) -> Any:
    """Makes the clusterer of conf/clusterer/<method>.yaml."""
    return instantiate(compose_config("discover", [f"clusterer={method}"]).clusterer)


@dataclass(frozen=True)
class Found:
    """The result of one method on one data set."""

    setting: Setting
    dataset: Dataset
    truth: NDArray[np.int64]
    clustering: Clustering
    row: dict[str, Any]


def find(
    domain: str, types: int | None, queries: str, points: int, noise: float, method: str, seed: int
) -> Found:
    """Finds the types in one data set with one method."""
    setting = setting_of(domain, types, seed)
    observers = SimulatedObservers(points=points, label_noise=noise)
    observed = observers.collect(setting, QUERIES[queries], seed)
    dataset, truth = observed.dataset, observed.truth
    trainer = LabelerTrainer()
    began = time.process_time()
    found = clusterer(method).cluster(observed, seed)
    seconds = time.process_time() - began
    test = split(dataset, 0.25, seed)
    train, held = dataset.take(np.flatnonzero(~test)), dataset.take(np.flatnonzero(test))
    alike = setting.distinct[truth]
    row = {
        "domain": domain,
        "types": len(np.unique(alike)),
        "queries": queries,
        "points": points,
        "noise": noise,
        "method": method,
        "seed": seed,
        "ari": score(alike, found.assignment),
        "found": found.n_types,
        "held_out": float(
            log_likelihoods(train, held, learn_types(train, found, trainer, seed)).mean()
        ),
        "cpu_seconds": seconds,
    }
    return Found(setting, dataset, truth, found, row)


def regrets(found: Found, seed: int, traces: int) -> dict[str, float]:
    """Returns QMDP's mean cost above the oracle's (λ = 1) with the types found, and with the true
    types."""
    setting, dataset, trainer = found.setting, found.dataset, LabelerTrainer()

    def learned(clustering: Clustering) -> UserTypes:
        return learn_types(dataset, clustering, trainer, seed)

    perfect = learned(Perfect().cluster(Observations(dataset, found.truth), 0))
    plans = {"found": learned(found.clustering), "true": perfect}
    cost: dict[str, list[float]] = {"found": [], "true": [], "oracle": []}
    for index in range(traces):
        rng = stream(seed, "traces", index)
        trace = sample_trace(setting.models[0], setting.domain.starts, rng, 40)
        features, labels = transition_features(setting.domain, trace), setting.label_table(trace)
        n = setting.n_messages
        problems = {
            key: Problem(label_table(one.labelers, features), np.ones(n))
            for key, one in plans.items()
        }
        true = problems["true"]
        policies = {key: QMDP().plan(problem) for key, problem in problems.items()}
        for t in range(len(setting.types)):
            user = SimulatedUser.of(labels[t])
            alone = true.with_types(true.table.of_types([t]), ("alone",))
            runs = {key: (problems[key], policies[key]) for key in plans}
            runs["oracle"] = alone, QMDP().plan(alone)
            for key, (problem, policy) in runs.items():
                cost[key].append(explain(problem, CachedPolicy(policy), user, Independent()).cost)
    mean = {key: float(np.mean(values)) for key, values in cost.items()}
    return {
        "regret_found": mean["found"] - mean["oracle"],
        "regret_true": mean["true"] - mean["oracle"],
    }


def goals(
    chosen: Sequence[Any], seeds: int, traces: int, jobs: int, methods: Sequence[str]
) -> pd.DataFrame:
    """Measures one row for each goal, method and seed."""

    def one(goal: Any, method: str, seed: int) -> dict[str, Any]:
        domain, types, queries, points, noise, wanted = goal
        found = find(domain, types, queries, points, noise, method, seed)
        return found.row | regrets(found, seed, traces) | {"goal": wanted}

    rows = Parallel(n_jobs=jobs)(
        delayed(one)(goal, method, FIRST_SEED + seed)
        for goal, method, seed in product(chosen, methods, range(seeds))
    )
    return pd.DataFrame(rows)


def grid(
    seeds: int, jobs: int, quick: bool, domains: Sequence[str], methods: Sequence[str]
) -> pd.DataFrame:
    """Measures domains × questions × noise × points × types × methods, without rows that are
    already saved.

    It goes seed by seed, so that all cells have equally many rows if it is stopped.
    """
    cells = product(
        range(FIRST_SEED, FIRST_SEED + seeds),
        domains,
        (2,) if quick else range(2, 9),
        ("shared", "independent"),
        (20,) if quick else (50, 100, 300),
        (0.05,) if quick else (0.0, 0.05, 0.1),
        methods,
    )
    key = [*DATA, "method", "seed"]
    known = pd.DataFrame(columns=key)
    if ROWS.exists() and not quick:
        known = pd.read_csv(ROWS, dtype={"meant": str})
        means = zip(known["domain"], known["method"], known["meant"], strict=True)
        known = known[[meaning(domain, method) == meant for domain, method, meant in means]]
    done = set(known[key].itertuples(index=False, name=None))

    def one(cell: Any) -> dict[str, Any]:
        return find(*cell).row | {"meant": meaning(cell[0], cell[5])}

    left = [cell for seed, *rest in cells if (cell := (*rest, seed)) not in done]
    made = []
    for row in Parallel(n_jobs=jobs, return_as="generator")(delayed(one)(cell) for cell in left):
        made.append(row)
        if not quick:
            ROWS.parent.mkdir(parents=True, exist_ok=True)
            line = pd.DataFrame([row])
            line.to_csv(ROWS, mode="a", header=not ROWS.exists(), index=False, float_format="%.5g")
    return pd.concat([known, pd.DataFrame(made)]) if len(known) else pd.DataFrame(made)


@cache
def meaning(domain: str, method: str) -> str:
    """Computes a digest of the values of the domain and the method. Rows with another digest are
    out of date."""
    cfg = compose_config("observe", [f"domain={domain}"]).domain
    chosen = compose_config("discover", [f"clusterer={method}"]).clusterer
    text = OmegaConf.to_yaml(cfg) + OmegaConf.to_yaml(chosen)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def growth(quick: bool) -> pd.DataFrame:
    """Measures time and success of whole discoveries, by the number of observers."""
    setting = setting_of("rescue", None, 0)
    rows = []
    for observers in (10,) if quick else (100, 1000, 10_000):
        crowd = SimulatedObservers(observers // 5, points=100)
        observed = crowd.collect(setting, designs.Independent(), FIRST_SEED)
        dataset, truth = observed.dataset, observed.truth
        for method in ("dirichlet", "kmeans"):
            began = time.process_time()
            found = clusterer(method).cluster(Observations(dataset), 0)
            learn_types(dataset, found, LabelerTrainer(), 0)
            rows.append(
                {
                    "observers": observers,
                    "labels": len(dataset),
                    "method": method,
                    "cpu_seconds": time.process_time() - began,
                    "ari": score(truth, found.assignment),
                    "found": found.n_types,
                }
            )
    return pd.DataFrame(rows)


def score(truth: NDArray[np.int64], assignment: NDArray[np.int64]) -> float:
    """Returns the adjusted Rand index: 1 for equal partitions, 0 on average by chance."""
    return float(adjusted_rand_score(truth, assignment))


def picture(rows: pd.DataFrame) -> Figure:
    """Draws the adjusted Rand index by points (above; lines: noise, mean over types) and by number
    of types (below; lines: points, mean over noise), as means over seeds with 95 % intervals."""
    panels = list(product(("rescue", "four_rooms"), ("shared", "independent")))
    figure, axes = plt.subplots(
        2, len(panels), figsize=(12, 6.4), sharey=True, layout="constrained"
    )
    methods = list(dict.fromkeys(rows["method"]))
    for line, (x, second, unit) in enumerate(
        [("points", "noise", "{:.0%} flipped"), ("types", "points", "{} labels")]
    ):
        for axis, (domain, queries) in zip(axes[line], panels, strict=True):
            part = rows[(rows["domain"] == domain) & (rows["queries"] == queries)]
            for (method, value), own in part.groupby(["method", second]):
                at = sorted(rows[second].unique()).index(value)
                stats = own.groupby(x)["ari"].agg(["mean", "sem"])
                axis.errorbar(
                    stats.index,
                    stats["mean"],
                    1.96 * stats["sem"],
                    capsize=2,
                    markersize=4,
                    label=f"{method}, {unit.format(value)}",
                    color=COLOURS[methods.index(method)],
                    marker=MARKERS[at],
                    linestyle=STYLES[at],
                )
            axis.set(ylim=(-0.1, 1.05))
            axis.set_title(f"{domain.replace('_', ' ')}, {queries} questions", fontsize=9)
            axis.set_xlabel("labels per observer" if x == "points" else "user types")
            if x == "points":
                axis.set_xscale("log")
                axis.set_xticks(sorted(part[x].unique()), sorted(part[x].unique()))
                axis.minorticks_off()
        axes[line, 0].set_ylabel("adjusted Rand index")
        handles, labels = axes[line, 0].get_legend_handles_labels()
        axes[line, -1].legend(handles, labels, fontsize=7, bbox_to_anchor=(1, 1), loc="upper left")
    return figure


def interval(values: pd.Series) -> str:
    """Returns the mean and, if there are several values, half of its 95 % interval."""
    if len(values) == 1:
        return f"{values.mean():.3f}"
    return f"{values.mean():.3f} ± {1.96 * values.std() / len(values) ** 0.5:.3f}"


def by_cell(rows: pd.DataFrame) -> pd.DataFrame:
    """Returns one row for each cell of the grid: means over its seeds, and half of the score's 95 %
    interval."""
    cells = rows.groupby([*DATA, "method"])
    table = cells[FIGURES].mean()
    table.insert(0, "seeds", cells.size())
    table.insert(2, "ari_half_interval", 1.96 * cells["ari"].sem())
    return table.reset_index()


def shown(rows: pd.DataFrame, by: list[str], measures: list[str]) -> str:
    """Writes means with intervals as a table in Markdown."""
    table = rows.groupby(by, sort=False)[measures].agg(interval).reset_index()
    head = [*by, *measures]
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    lines += [
        " | ".join(str(value) for value in row) for row in table[head].itertuples(index=False)
    ]
    return "\n".join(f"| {line} |" for line in lines)


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="?", choices=["goals", "grid", "growth"])
    parser.add_argument("--quick", action="store_true", help="a little of each, nothing written")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--traces", type=int, default=5, help="for the regret of each seed")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument(
        "--domains", nargs="+", default=["rescue", "four_rooms"], help="of the grid"
    )
    parser.add_argument("--methods", nargs="+", default=["dirichlet", "kmeans"], help="of the grid")
    arguments = parser.parse_args()
    quick = arguments.quick
    seeds, jobs, traces = arguments.seeds, arguments.jobs, arguments.traces
    if quick:
        seeds, jobs, traces, arguments.domains = 1, 1, 1, arguments.domains[-1:]
    compared = ["dirichlet"] if quick else ["dirichlet", "kmeans"]
    parts: dict[str, tuple[Callable[[], pd.DataFrame], list[str], list[str]]] = {
        "goals": (
            lambda: goals(GOALS[3:4] if quick else GOALS, seeds, traces, jobs, compared),
            [*DATA, "method", "goal"],
            [*FIGURES, "regret_found", "regret_true"],
        ),
        "grid": (
            lambda: grid(seeds, jobs, quick, arguments.domains, arguments.methods),
            ["domain", "queries", "points", "noise", "method"],
            FIGURES,
        ),
        "growth": (
            lambda: growth(quick),
            ["observers", "labels", "method"],
            ["cpu_seconds", "ari", "found"],
        ),
    }
    for name in [arguments.part] if arguments.part else list(parts):
        make, by, measures = parts[name]
        rows = make()
        text = shown(rows, by, measures)
        print(f"## {name}\n\n{text}\n")
        kept, drawn = (by_cell(rows), picture(rows)) if name == "grid" else (rows, None)
        if not quick:
            RESULTS.mkdir(exist_ok=True)
            kept.to_csv(RESULTS / f"discovery_{name}.csv", index=False, float_format="%.4g")
            (RESULTS / f"discovery_{name}.md").write_text(text + "\n", encoding="utf-8")
            if drawn is not None:
                drawn.savefig(RESULTS / "discovery_grid.png")


if __name__ == "__main__":
    # Workers find cached functions by their module's name; "__main__" is another module there.
    importlib.import_module("discovery").main()
