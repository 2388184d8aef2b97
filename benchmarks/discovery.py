"""How well the types of simulated observers are found again, by method and kind of data.

    python benchmarks/discovery.py goals         the settings that the project set itself as goals
    python benchmarks/discovery.py grid          domains × questions × noise × points × types
    python benchmarks/discovery.py growth        time against observers and labels
    python benchmarks/discovery.py --quick       a little of each, nothing written

Every method has one setting for all rows (conf/clusterer/<method>.yaml). Seeds from 1000 on are
kept for this benchmark. The truth: types that label all reachable questions alike are one. The
held-out log-likelihood is of labelers fitted to the clusters found, on a held-out quarter of the
distinct questions. Results go to benchmarks/results/.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from hydra.utils import instantiate
from joblib import Parallel, delayed

from xplain.command_line import compose_for
from xplain.domains.base import transition_features
from xplain.evaluation.episode import SimulatedUser, explain
from xplain.explanation.belief import Independent
from xplain.explanation.problem import Problem
from xplain.learning.clustering import Clustering, Perfect
from xplain.learning.disagreements import Cells
from xplain.learning.heldout import log_likelihoods
from xplain.learning.labelers import LabelerTrainer, split
from xplain.learning.types import learn_types
from xplain.randomness import derived_seed, stream
from xplain.report.plots import series_style
from xplain.solvers.qmdp import QMDP
from xplain.users.observers import SimulatedObservers
from xplain.users.setting import Setting
from xplain.users.traces import sample_trace
from xplain.users.types import RandomCover

RESULTS = Path(__file__).parent / "results"
FIRST_SEED = 1000
GOALS = [  # domain, types, questions, points, noise, goal
    ("rescue", None, "shared", 300, 0.0, 1.0),
    ("rescue", None, "independent", 300, 0.0, 0.95),
    ("rescue", None, "independent", 300, 0.05, 0.85),
    ("four_rooms", 2, "independent", 100, 0.0, 0.9),
    ("four_rooms", 3, "independent", 100, 0.0, 0.9),
    ("four_rooms", 4, "independent", 100, 0.0, 0.9),
]


def setting_of(domain: str, types: int | None, seed: int) -> Setting:
    """The domain's own types, or so many drawn at random."""
    cfg = compose_for("observe", [f"domain={domain}"])
    made = instantiate(cfg.domain)
    source = instantiate(cfg.users) if types is None else RandomCover(types)
    return Setting.build(made, source.types(made, stream(seed, "users")))


def clusterer(method: str) -> Any:
    """As conf/clusterer/<method>.yaml says."""
    return instantiate(compose_for("discover", [f"clusterer={method}"]).clusterer)


def measure(
    domain: str, types: int | None, queries: str, points: int, noise: float, method: str, seed: int
) -> dict[str, Any]:
    """One data set, one method."""
    setting = setting_of(domain, types, seed)
    observers = SimulatedObservers(points=points, queries=queries, label_noise=noise)  # type: ignore[arg-type]
    dataset, truth = observers.collect(setting, seed)
    trainer = LabelerTrainer()
    began = time.perf_counter()
    found = clusterer(method).cluster(dataset, trainer, derived_seed(seed, "clusterer"), None)
    seconds = time.perf_counter() - began
    test = split(dataset, 0.25, seed)
    train, held = dataset.take(np.flatnonzero(~test)), dataset.take(np.flatnonzero(test))
    alike = setting.distinct[truth]
    return {
        "domain": domain,
        "types": len(np.unique(alike)),
        "queries": queries,
        "points": points,
        "noise": noise,
        "method": method,
        "seed": seed,
        "ari": _score(alike, found.assignment),
        "found": found.n_types,
        "held_out": float(log_likelihoods(train, held, found.assignment, trainer, seed).mean()),
        "seconds": seconds,
    }


def regrets(
    domain: str,
    types: int | None,
    queries: str,
    points: int,
    noise: float,
    method: str,
    seed: int,
    traces: int,
) -> dict[str, float]:
    """Mean cost above the oracle's of QMDP (λ = 1) with the types found, and with the true ones."""
    setting = setting_of(domain, types, seed)
    observers = SimulatedObservers(points=points, queries=queries, label_noise=noise)  # type: ignore[arg-type]
    dataset, truth = observers.collect(setting, seed)
    trainer = LabelerTrainer()

    def learned(clustering: Clustering) -> Any:
        return learn_types(dataset, clustering, trainer, seed, prior="uniform")

    found = clusterer(method).cluster(dataset, trainer, derived_seed(seed, "clusterer"), None)
    perfect = learned(Perfect().cluster(dataset, trainer, 0, truth))
    plans = {"found": learned(found), "true": perfect}
    cost: dict[str, list[float]] = {"found": [], "true": [], "oracle": []}
    for index in range(traces):
        rng = stream(seed, "traces", index)
        trace = sample_trace(setting.models[0], setting.optimal[0], setting.domain.starts, rng, 40)
        features, labels = transition_features(setting.domain, trace), setting.label_table(trace)
        n = setting.n_messages
        problems = {
            key: Problem(one.p_explicable(features, n), np.ones(n)) for key, one in plans.items()
        }
        policies = {key: QMDP().plan(problem) for key, problem in problems.items()}
        for t in range(len(setting.types)):
            user = SimulatedUser(labels[t])
            alone = problems["true"].with_types(
                problems["true"].p_explicable[t : t + 1], ("alone",)
            )
            runs = {key: (problems[key], policies[key]) for key in plans}
            runs["oracle"] = alone, QMDP().plan(alone)
            for key, (problem, policy) in runs.items():
                cost[key].append(explain(problem, policy, user, Independent()).cost)
    mean = {key: float(np.mean(values)) for key, values in cost.items()}
    return {
        "regret_found": mean["found"] - mean["oracle"],
        "regret_true": mean["true"] - mean["oracle"],
    }


def interval(values: pd.Series) -> str:  # type: ignore[type-arg]
    """Mean and half of its 95 % interval."""
    half = 1.96 * values.std(ddof=1) / max(len(values), 1) ** 0.5 if len(values) > 1 else np.nan
    return f"{values.mean():.3f} ± {half:.3f}"


def goals(seeds: int, traces: int, jobs: int, methods: list[str]) -> pd.DataFrame:
    """One row a goal and method."""

    def one(goal: tuple[Any, ...], method: str, seed: int) -> dict[str, Any]:
        row = measure(*goal[:5], method, seed)
        return row | regrets(*goal[:5], method, seed, traces) | {"goal": goal[5]}

    rows = Parallel(n_jobs=jobs)(
        delayed(one)(goal, method, FIRST_SEED + seed)
        for goal, method, seed in product(GOALS, methods, range(seeds))
    )
    return pd.DataFrame(rows)


def grid(seeds: int, jobs: int, quick: bool) -> pd.DataFrame:
    """Domains × questions × noise × points × types × methods."""
    cells = product(
        ("rescue", "four_rooms"),
        (3,) if quick else (2, 4, 6, 8),
        ("shared", "independent"),
        (100,) if quick else (50, 100, 300),
        (0.0, 0.05) if quick else (0.0, 0.05, 0.1),
        ("dirichlet", "kmeans"),
    )
    rows = Parallel(n_jobs=jobs)(
        delayed(measure)(domain, types, queries, points, noise, method, FIRST_SEED + seed)
        for domain, types, queries, points, noise, method in cells
        for seed in range(seeds)
    )
    return pd.DataFrame(rows)


def growth(quick: bool) -> pd.DataFrame:
    """Time of the disagreements along a whole hierarchy, and of whole discoveries."""
    setting = setting_of("rescue", None, 0)
    rows = []
    for observers in (30, 100) if quick else (100, 1000, 10_000):
        crowd = SimulatedObservers(observers // 5, points=100, queries="independent")
        dataset, truth = crowd.collect(setting, FIRST_SEED)
        joined = observers + np.arange(observers - 2)
        merges = np.stack([np.concatenate([[0], joined]), np.arange(1, observers)], axis=1)
        began = time.perf_counter()
        Cells.of(dataset).along(merges)
        curve = time.perf_counter() - began
        for method in ("dirichlet", "hierarchy_share", "kmeans"):
            began = time.perf_counter()
            found = clusterer(method).cluster(dataset, LabelerTrainer(), 0, None)
            rows.append(
                {
                    "observers": observers,
                    "labels": len(dataset),
                    "method": method,
                    "curve_seconds": curve,
                    "seconds": time.perf_counter() - began,
                    "ari": _score(truth, found.assignment),
                }
            )
    return pd.DataFrame(rows)


def _score(truth: np.ndarray, assignment: np.ndarray) -> float:
    from sklearn.metrics import adjusted_rand_score

    return float(adjusted_rand_score(truth, assignment))


def picture(rows: pd.DataFrame, path: Path) -> None:
    """Adjusted Rand index by noise, one panel a domain and kind of question, one line a method and
    number of points; mean over types and seeds with its 95 % interval."""
    panels = list(product(("rescue", "four_rooms"), ("shared", "independent")))
    figure, axes = plt.subplots(1, len(panels), figsize=(12, 3.4), sharey=True)
    for axis, (domain, queries) in zip(axes, panels, strict=True):
        part = rows[(rows["domain"] == domain) & (rows["queries"] == queries)]
        for index, ((method, points), own) in enumerate(part.groupby(["method", "points"])):
            stats = own.groupby("noise")["ari"].agg(["mean", "sem"])
            axis.errorbar(
                100 * stats.index + 0.15 * index,
                stats["mean"],
                1.96 * stats["sem"],
                capsize=2,
                label=f"{method}, {points} points",
                **series_style(index),
            )
        axis.set(title=f"{domain}, {queries}", xlabel="labels flipped (%)", ylim=(-0.05, 1.05))
    axes[0].set_ylabel("adjusted Rand index")
    axes[-1].legend(fontsize=7, loc="lower left")
    figure.savefig(path)
    plt.close(figure)


def shown(rows: pd.DataFrame, by: list[str], measures: list[str]) -> str:
    """Means with intervals, as a table in Markdown."""
    table = rows.groupby(by, sort=False)[measures].agg(interval).reset_index()
    head = [*by, *measures]
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    lines += [
        " | ".join(str(value) for value in row) for row in table[head].itertuples(index=False)
    ]
    return "\n".join(f"| {line} |" for line in lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="?", choices=["goals", "grid", "growth"])
    parser.add_argument("--quick", action="store_true", help="a little of each, nothing written")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--traces", type=int, default=5, help="for the regret of each seed")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    quick = arguments.quick
    seeds = 2 if quick else arguments.seeds
    data = ["domain", "types", "queries", "points", "noise", "method"]
    figures = ["ari", "found", "held_out", "seconds"]
    parts: dict[str, tuple[Callable[[], pd.DataFrame], list[str], list[str]]] = {
        "goals": (
            lambda: goals(
                seeds,
                1 if quick else arguments.traces,
                arguments.jobs,
                ["dirichlet"] if quick else ["dirichlet", "em", "kmeans"],
            ),
            [*data, "goal"],
            [*figures, "regret_found", "regret_true"],
        ),
        "grid": (lambda: grid(seeds, arguments.jobs, quick), data, figures),
        "growth": (
            lambda: growth(quick),
            ["observers", "labels", "method"],
            ["curve_seconds", "seconds", "ari"],
        ),
    }
    for name in [arguments.part] if arguments.part else list(parts):
        make, by, measures = parts[name]
        rows = make()
        text = shown(rows, by, measures)
        print(f"## {name}\n\n{text}\n")
        if not quick:
            RESULTS.mkdir(exist_ok=True)
            rows.to_csv(RESULTS / f"discovery_{name}.csv", index=False, float_format="%.5g")
            (RESULTS / f"discovery_{name}.md").write_text(text + "\n", encoding="utf-8")
            if name == "grid":
                picture(rows, RESULTS / "discovery_grid.png")


if __name__ == "__main__":
    main()
