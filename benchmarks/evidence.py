"""Compares hypotheses with labels alone if hypotheses are guesses.

    python benchmarks/evidence.py                            measures, and keeps each data set
    python benchmarks/evidence.py --table                    the table of the kept data sets
    python benchmarks/evidence.py --first 7300 --seeds 101   the same for other seeds
    python benchmarks/evidence.py --quick                    one data set, nothing written

Nothing was tuned on the seeds from 7500 on; smaller seeds were used during development.

Maps and people are those of questions.py, with 40 labels for each person, one in twenty wrong.
There are three ways: *weighed*, the default (queries=adaptive labeler=hypotheses: hypotheses are
weighed, and given up if labels alone predict better), *believed* (the same, but hypotheses are
always believed), and *labels alone* (queries=independent labeler=practice). Costs are QMDP's at λ =
1 on five traces. *scrambled* people have hypotheses that give each transition the labels of another
transition.
"""

import argparse
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from people import scrambled, setting_of, without_a_fact
from questions import MAPS, domain_of

from xplain.domains.base import transition_features
from xplain.domains.users.setting import Setting
from xplain.errors import XplainError
from xplain.experiment.config import compose_config
from xplain.experiment.pipeline import draw_trace
from xplain.explanation.belief import Independent as IndependentLabels
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.learning import evidence
from xplain.learning.data.observers import SimulatedObservers
from xplain.learning.data.queries import Independent, Queries
from xplain.learning.mixture import labeler as hypothesis_labeler
from xplain.learning.user_types import label_table
from xplain.questions.designs import Adaptive
from xplain.randomness import stream
from xplain.solvers.base import CachedPolicy
from xplain.solvers.greedy import QMDP

KEPT = Path(__file__).parent / "results/evidence.csv"
PEOPLE = ("as assumed", "half", "opposite", "x .3 to 3", "unwritten", "half a bonus", "scrambled")
FILES = {"unwritten": without_a_fact, "scrambled": scrambled}
WAYS = ("weighed", "believed", "labels alone")
KEY = ["map", "people", "seed"]


@contextmanager
def believing() -> Iterator[None]:
    """Opens a context in which hypotheses are never doubted or replaced."""
    never = [
        (evidence, "BEATEN", np.inf),
        (hypothesis_labeler, "DOUBTED", 1.0),
    ]
    with patch.object(*never[0]), patch.object(*never[1]):
        yield


def learned(way: str, setting: Setting, path: str | None, seed: int) -> Any:
    """Finds the types in one of the ways."""
    name = "practice" if way == "labels alone" else "hypotheses"
    trainer = instantiate(compose_config("discover", [f"labeler={name}"]).labeler)
    clusterer = instantiate(
        compose_config("discover", ["clusterer=dirichlet"]).clusterer, _partial_=True
    )
    if name == "practice":
        queries: Queries = Independent()
    else:
        queries = Adaptive(hypotheses=path)
        object.__setattr__(trainer, "path", path)
    observed = SimulatedObservers(3, 40, 0.05).collect(setting, queries, seed)
    return clusterer(labeler=trainer).find(observed, seed)


def costs(setting: Setting, types: Any, traces: int, seed: int) -> tuple[float, float]:
    """Returns mean costs with learned labels, and with true labels."""
    found, n = [], setting.n_messages
    for index in range(traces):
        trace = draw_trace(setting, 40, seed, index)
        truth = setting.label_table(trace)
        features = transition_features(setting.domain, trace)
        own = label_table(types.labelers, features, trace).array(n)
        tables: list[Any] = [own, truth.astype(float)]
        plans = [
            (problem, CachedPolicy(QMDP().plan(problem)))
            for problem in (Problem(t, np.ones(n)) for t in tables)
        ]
        for labels in truth:
            user = SimulatedUser.of(labels)
            found.append([explain(*one, user, IndependentLabels()).cost for one in plans])
    learned_cost, true_cost = np.mean(found, axis=0).tolist()
    return learned_cost, true_cost


def row_of(name: str, people: str, seed: int, traces: int) -> dict[str, Any]:
    """Measures one data set."""
    domain: Any = domain_of(name, seed)
    row: dict[str, Any] = dict(zip(KEY, (name, people, seed), strict=True))
    setting = setting_of(domain, people, seed)
    with tempfile.TemporaryDirectory() as folder:
        path = FILES[people](domain, seed, Path(folder)) if people in FILES else None
        types = {way: learned(way, setting, path, seed) for way in WAYS if way != "believed"}
        with believing():
            types["believed"] = learned("believed", setting, path, seed)
    for way in WAYS:
        row[way], row["true"] = costs(setting, types[way], traces, seed)
    found = types["weighed"].evidence
    row["given up"] = found is None
    row["warned"] = found is None or found.lost
    return row


def table(rows: pd.DataFrame) -> str:
    """Returns means by people, and the ratio to the better way, with its 95 % bootstrap interval
    over data sets."""
    lines = ["| people | data sets | weighed / true | believed / true | labels alone / true | "
             "weighed / better of both | warned | given up |", "|---" * 8 + "|"]  # fmt: skip
    for people in (one for one in PEOPLE if one in set(rows["people"])):
        own = rows[rows["people"] == people]
        drawn = stream(0, "benchmark", "bootstrap").integers(0, len(own), (2000, len(own)))
        sums = {key: own[key].to_numpy()[drawn].sum(axis=1) for key in WAYS}
        low, high = np.quantile(
            sums["weighed"] / np.minimum(sums["believed"], sums["labels alone"]), [0.025, 0.975]
        )
        mean = own[[*WAYS, "true"]].mean()
        gate = mean["weighed"] / min(mean["believed"], mean["labels alone"])
        figures = " | ".join(f"{mean[way] / mean['true']:.2f}" for way in WAYS)
        shares = f"{own['warned'].mean():.0%} | {own['given up'].mean():.0%}"
        lines.append(
            f"| {people} | {len(own)} | {figures} | {gate:.2f} [{low:.2f}, {high:.2f}] | {shares} |"
        )
    loses = rows[rows["believed"] > 1.1 * rows["labels alone"]]
    said = f"warned in {int(loses['warned'].sum())} of the {len(loses)} data sets"
    return "\n".join([*lines, "", f"{said} in which believed hypotheses cost over a tenth more"])


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one data set, nothing written")
    parser.add_argument("--table", action="store_true", help="nothing is measured")
    parser.add_argument("--first", type=int, default=7500)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--people", nargs="+", default=list(PEOPLE), choices=PEOPLE)
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    if given.quick:
        print(table(pd.DataFrame([row_of("random rooms", "scrambled", 300, 1)])))
        return
    done = set(pd.read_csv(KEPT)[KEY].itertuples(index=False, name=None)) if KEPT.exists() else ()
    seeds = range(given.first, given.first + given.seeds)
    every = product(seeds, given.people, MAPS)
    for seed, people, name in () if given.table else every:
        if (name, people, seed) in done:
            continue
        try:
            row = pd.DataFrame([row_of(name, people, seed, 5)])
        except XplainError as error:  # with other values, the types do not differ
            print(name, people, seed, error)
            continue
        row.to_csv(KEPT, mode="a", header=not KEPT.exists(), index=False, float_format="%.5g")
    print(table(pd.read_csv(KEPT).query("seed in @seeds")))


if __name__ == "__main__":
    main()
