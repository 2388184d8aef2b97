"""Handmade values that stages pass to one another."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Item, Scene
from xplain.experiment.pipeline import Case, PreparedData
from xplain.explanation.label_table import LabelTable
from xplain.interaction.episode import Episode


def a_case(seed: int, steps: int = 2, perfect: bool = True) -> Case:
    """Makes a trace with this number of transitions, two messages, two learned types and three true
    types."""
    rng = np.random.default_rng(seed)
    return Case(
        transitions=rng.integers(0, 9, (steps, 3)),
        phrases=tuple(f"moves to ({k}, {seed})" for k in range(steps)),
        positions=tuple((k, seed) for k in range(steps + 1)),
        learned=LabelTable.dense(rng.uniform(0.05, 0.95, (2, steps, 4))),
        everyone=LabelTable.dense(rng.uniform(0.05, 0.95, (1, steps, 4))),
        perfect=LabelTable.dense(rng.uniform(0.05, 0.95, (3, steps, 4))) if perfect else None,
        labels=LabelTable.dense(rng.integers(0, 2, (3, steps, 4))),
    )


def a_prepared(
    perfect: bool = True, seed: int = 0, steps: tuple[int, ...] = (2, 3)
) -> PreparedData:
    """Makes a trace of each of these lengths. The second and third true type behave alike, and the
    second learned type matches them; a third of the observers have the first type."""
    goal = Item("goal", "G", ((1, 2),))
    return PreparedData(
        domain="grid",
        messages=("a", "b"),
        sentences=("A is 1.", "B is 2."),
        types=("T1", "T2", "T3"),
        distinct=np.array([0, 1, 1]),
        learned_types=("F1", "F2"),
        matched_true_type=np.array([0, 1]),
        type_shares=np.array([1 / 3, 2 / 3]),
        learning={"types_found": 2.0, "unknown": float("nan")},
        curve=np.array([5.0, 0.1, 0.0]),
        rule="kneedle",
        scene=Scene(2, 3, ((0, 0),), (goal,)) if perfect else None,
        cases=tuple(a_case(7 * seed + i, m, perfect) for i, m in enumerate(steps)),
    )


def with_cases(prepared: PreparedData, *cases: Case) -> PreparedData:
    """Returns the same data with these traces."""
    return replace(prepared, cases=cases)


def an_episode(rng: np.random.Generator, steps: int, types: int = 2) -> Episode:
    """Makes a random record of an episode, whose figures are not consistent."""
    labels = np.full((steps, steps), -1, dtype=np.int8)
    for k in range(steps):
        labels[k, : k + 1] = rng.integers(0, 2, k + 1)
    beliefs: NDArray[np.float64] = rng.dirichlet(np.full(types, 0.3), steps + 1)
    return Episode(
        messages=rng.integers(0, 4, steps),
        labels=labels,
        thoughts=labels,
        beliefs=beliefs,
        seconds=rng.uniform(0, 0.1, steps),
        communication=float(rng.uniform(0, 5)),
        inexplicability=float(rng.uniform(0, 5)),
        cost=float(rng.uniform(0, 10)),
    )


def a_file(path: Path, content: Any) -> Path:
    """Writes arrays by name, one array, or bytes; None writes nothing."""
    if isinstance(content, dict):
        with path.open("wb") as file:
            np.savez(file, **content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content)
    return path
