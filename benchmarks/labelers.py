"""Compares labelers at equal budgets: predictions, calibration, and costs of explanations.

    python benchmarks/labelers.py            some minutes
    python benchmarks/labelers.py --quick    some seconds, nothing written
    python benchmarks/labelers.py --maps random --seeds 8
        the comparison that chose the default: random maps for each seed (from 8110), with 2 to 5
            random types; nothing written

The true types are given (perfect clustering), so that only labelers differ. There are three
observers of each type, each with different questions. ``right`` and ``brier`` are measured on
questions drawn like the training questions, but with a (transition, message set) that no training
label has, and without noise. ``oracle`` and ``qmdp`` are the mean costs of explanations (λ = 1)
with the type known and unknown, minus the cost of the clairvoyant, who knows the labels. Results go
to benchmarks/results/.
"""

import argparse
from itertools import product
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import people
import questions
from discovery import FIRST_SEED, RESULTS, setting_of, shown
from joblib import Parallel, delayed
from matplotlib.figure import Figure
from sklearn.ensemble import GradientBoostingClassifier, RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures
from sklearn.tree import DecisionTreeClassifier

from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting
from xplain.explanation.belief import Independent
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.learning.data import queries
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations, SimulatedObservers
from xplain.learning.data.queries import sample_trace
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.user_types import Perfect, UserTypes, label_table, learn_types
from xplain.randomness import stream
from xplain.report.plots import series_style
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP

LABELERS = {
    "tree (paper)": LabelerTrainer(),
    "tree, leaf confidence": LabelerTrainer(confidence="leaf"),
    "tree, pruned": LabelerTrainer(DecisionTreeClassifier(ccp_alpha=0.004), confidence="leaf"),
    "forest": LabelerTrainer(RandomForestClassifier(100), confidence="leaf"),
    "boosting": LabelerTrainer(GradientBoostingClassifier(), confidence="leaf"),
    "logistic, interactions": LabelerTrainer(
        make_pipeline(
            MinMaxScaler(),
            PolynomialFeatures(2, interaction_only=True),
            LogisticRegression(C=10, max_iter=2000),
        ),
        confidence="leaf",
    ),
}
MAPS = {
    "shipped": [("rescue", None), ("four_rooms", 3)],
    "random": [("random rescue", None), ("random rooms", None)],
}
BINS = np.linspace(0, 1, 11)


def unseen(setting: Setting, dataset: Dataset, seed: int) -> tuple[Dataset, np.ndarray]:
    """Draws fresh on-policy questions that are not in the dataset, with the true type of the
    observer."""
    observed = SimulatedObservers(1, 1500).collect(setting, queries.Independent(), seed + 10**6)
    fresh, truth = observed.dataset, observed.truth
    asked = {
        (dataset.features[t].tobytes(), int(given))
        for t, given in zip(dataset.transition, dataset.message_set, strict=True)
    }
    new = [
        row
        for row in range(len(fresh))
        if (fresh.features[fresh.transition[row]].tobytes(), int(fresh.message_set[row]))
        not in asked
    ]
    return fresh.take(np.array(new)), truth


def costs(setting: Setting, types: UserTypes, traces: int, seed: int) -> dict[str, float]:
    """Returns mean costs above the clairvoyant's."""
    cost: dict[str, list[float]] = {"oracle": [], "qmdp": [], "clairvoyant": []}
    n = setting.n_messages
    for index in range(traces):
        rng = stream(seed, "traces", index)
        trace = sample_trace(setting.models[0], setting.domain.starts, rng, 40)
        labels = setting.label_table(trace)
        p = label_table(types.labelers, transition_features(setting.domain, trace)).array(n)
        unknown = Problem(p, np.ones(n))
        policy = QMDP().plan(unknown)
        for t in range(len(setting.types)):
            user = SimulatedUser.of(labels[t])
            cost["qmdp"].append(explain(unknown, CachedPolicy(policy), user, Independent()).cost)
            for key, one in (("oracle", p[t : t + 1]), ("clairvoyant", labels[t : t + 1])):
                known = Problem(one.astype(float), np.ones(n))
                plan = QMDP().plan(known)
                cost[key].append(explain(known, CachedPolicy(plan), user, Independent()).cost)
    floor = np.mean(cost["clairvoyant"])
    return {key: float(np.mean(cost[key]) - floor) for key in ("oracle", "qmdp")}


def measure(
    domain: str, types: int | None, points: int, noise: float, name: str, seed: int, traces: int
) -> tuple[dict[str, Any], np.ndarray]:
    """Returns the figures of one fit, and its reliability: [10, 3] number of labels, number of
    ones, and sum of P, by tenths of P."""
    setting = (
        people.setting_of(questions.domain_of(domain, seed), "right", seed)
        if domain.startswith("random")
        else setting_of(domain, types, seed)
    )
    observers = SimulatedObservers(3, points, label_noise=noise)
    observed = observers.collect(setting, queries.Independent(), seed)
    dataset, truth = observed.dataset, observed.truth
    clustering = Perfect().cluster(Observations(dataset, truth), 0)
    learned = learn_types(dataset, clustering, LABELERS[name], seed)
    p, y = [], []
    for t, labeler in enumerate(learned.labelers):
        fresh, who = unseen(setting, dataset.of(clustering.members(t)), seed)
        own = fresh.of(np.flatnonzero(who == t))
        p.append(labeler.probability(own.features[own.transition], own.message_set))
        y.append(own.label)
    said, label = np.concatenate(p), np.concatenate(y)
    where = np.clip(np.digitize(said, BINS) - 1, 0, 9)
    reliability = np.stack(
        [np.bincount(where, weight, 10) for weight in (np.ones(len(said)), label, said)], axis=1
    )
    row = {
        "domain": domain,
        "points": points,
        "noise": noise,
        "labeler": name,
        "seed": seed,
        "right": float(((said > 0.5) == label).mean()),
        "brier": float(((said - label) ** 2).mean()),
    }
    return row | costs(setting, learned, traces, seed), reliability


def picture(names: list[str], reliability: dict[str, np.ndarray]) -> Figure:
    """Draws the share of labels 1 against the predicted probability, and the number of labels."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 4))
    axes[0].plot([0, 1], [0, 1], color="0.6", linewidth=1)
    for index, name in enumerate(names):
        count, ones, said = reliability[name].T
        some = count >= 30
        axes[0].plot(said[some] / count[some], ones[some] / count[some], label=name,
                     **series_style(index))  # fmt: skip
        axes[1].plot((BINS[:-1] + BINS[1:]) / 2, count / count.sum(), **series_style(index))
    axes[0].set(xlabel="P(label = 1) predicted", ylabel="share of labels that are 1")
    axes[1].set(xlabel="P(label = 1) predicted", ylabel="share of all labels", yscale="log")
    figure.legend(loc="upper center", ncol=4, fontsize=8, bbox_to_anchor=(0.5, 1.08))
    return figure


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a little, nothing written")
    parser.add_argument("--maps", choices=("shipped", "random"), default="shipped")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--traces", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    arguments = parser.parse_args()
    names = list(LABELERS)[:2] if arguments.quick else list(LABELERS)
    seeds = 1 if arguments.quick else arguments.seeds
    first = FIRST_SEED if arguments.maps == "shipped" else 8110
    cells = product(
        MAPS[arguments.maps],
        (50,) if arguments.quick else (50, 100, 300),
        (0.0,) if arguments.quick else (0.0, 0.05),
        names,
        range(first, first + seeds),
    )
    found = Parallel(n_jobs=1 if arguments.quick else arguments.jobs)(
        delayed(measure)(
            *domain, points, noise, name, seed, 1 if arguments.quick else arguments.traces
        )
        for domain, points, noise, name, seed in cells
    )
    rows = pd.DataFrame([row for row, _ in found])
    text = shown(
        rows, ["domain", "points", "noise", "labeler"], ["right", "brier", "oracle", "qmdp"]
    )
    print(text)
    if arguments.quick or arguments.maps == "random":
        return
    reliability = {name: np.zeros((10, 3)) for name in names}
    for row, bins in found:
        reliability[row["labeler"]] += bins
    RESULTS.mkdir(exist_ok=True)
    rows.to_csv(RESULTS / "labelers.csv", index=False, float_format="%.5g")
    (RESULTS / "labelers.md").write_text(text + "\n", encoding="utf-8")
    picture(names, reliability).savefig(RESULTS / "labelers_reliability.png")


if __name__ == "__main__":
    main()
