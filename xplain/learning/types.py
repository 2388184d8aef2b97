"""Types of observers, and the users as agents know them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import TooLargeError
from xplain.explanation.belief import OPEN
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.learning.answers import AnswerModel


@dataclass(frozen=True)
class Clustering:
    """A grouping of the observers: one cluster a type.

    Attributes:
        assignment: [O] int64 cluster of each observer, numbered by first appearance.
        method: how it was found, in a word.
        rule: what chose the number of clusters.
        curve: [K] disagreements for k = 1 … K; None where the method draws no such curve.
        vectors: [O] int64 smallest message set of each observer; None where not computed.
        posterior: P(number of types = k) by k; None where the method gives no posterior.
        needs: [N] int64 messages that people of each type need to be told; None where the method
            does not say.
        expected: [O, T] P(answer 1) of each observer about each transition of the dataset, where
            the method predicts answers itself; else None.
        answers: how labels became answers, of the dataset's transitions and observers; None where
            the method does not say.
    """

    assignment: NDArray[np.int64]
    method: str
    rule: str
    curve: NDArray[np.int64] | None = None
    vectors: NDArray[np.int64] | None = None
    posterior: Mapping[int, float] | None = None
    needs: NDArray[np.int64] | None = None
    expected: NDArray[np.float64] | None = None
    answers: AnswerModel | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "assignment", by_first_appearance(self.assignment))

    @classmethod
    def by_facts(cls, facts: NDArray[np.int64], rule: str, **about: Any) -> Clustering:
        """Observers who believe the same facts [O] incorrectly are of one type (a Dirichlet
        process); ``about`` are the other attributes."""
        _, first = np.unique(facts, return_index=True)
        return cls(facts, "dirichlet", rule, needs=facts[np.sort(first)], **about)

    @property
    def n_types(self) -> int:
        """N: how many types were found."""
        return int(self.assignment.max()) + 1

    @property
    def shares(self) -> NDArray[np.float64]:
        """Shares [N] of the observers by type."""
        return np.bincount(self.assignment) / len(self.assignment)

    @property
    def new(self) -> float:
        """P(the next person is of a new type): at least OPEN, and as often as observers were alone
        of their type (Good 1953)."""
        alone = int((np.bincount(self.assignment) == 1).sum())
        return max(OPEN, alone / (len(self.assignment) + 1))

    def members(self, cluster: int) -> NDArray[np.int64]:
        """Indices of the observers of a cluster, ascending."""
        return np.flatnonzero(self.assignment == cluster)


class TraceTables(NamedTuple):
    """P(label is 1) of a trace's m transitions under every message set.

    Attributes:
        learned: of N types that solvers plan with.
        everyone: of one labeler for everybody; None where it looks at too many messages.
        perfect: of M true types, what the oracle knows of each; None where there is no oracle.
        everything: of one type, who believes every fact incorrectly; None where facts are unknown.
    """

    learned: LabelTable
    everyone: LabelTable | None
    perfect: LabelTable | None
    everything: LabelTable | None = None


def unless_too_large(make: Callable[[], LabelTable]) -> LabelTable | None:
    """The table, or None where it would be too large: a labeler for everybody looks at what any
    type looks at, and few runs ask for it."""
    try:
        return make()
    except TooLargeError:
        return None


TablesOf = Callable[[NDArray[np.float64], NDArray[np.int64]], TraceTables]


@dataclass(frozen=True)
class KnownTypes:
    """The users as agents know them.

    Attributes:
        names: N of the types.
        matched_true_type: [N] for each the ``distinct`` number of the true type it stands for,
            −1 unknown.
        shares: [N] of the observers.
        figures: of the learning stage, by name.
        curve: disagreements for k = 1 … (empty where there are none).
        rule: what decided the number of types.
        tables: what follows for a trace, by the features [m, F] of its transitions [m, 3].
        habits: how people err, as far as their answers tell.
        wrong: [N, n] P(a user of the type believes a fact incorrectly); None if that is unknown.
        new: P(a user is of none of the types).
    """

    names: tuple[str, ...]
    matched_true_type: NDArray[np.int64]
    shares: NDArray[np.float64]
    figures: dict[str, float]
    curve: NDArray[np.float64]
    rule: str
    tables: TablesOf
    habits: Habits | None = None
    wrong: NDArray[np.float64] | None = None
    new: float = OPEN


def shares_of(drawn: ArrayLike) -> dict[int, float]:
    """P(number of types = k) by k, of numbers that were drawn."""
    number, times = np.unique(drawn, return_counts=True)
    return dict(zip(number.tolist(), (times / times.sum()).tolist(), strict=True))


def by_first_appearance(assignment: NDArray[np.int64]) -> NDArray[np.int64]:
    """The same groups, numbered 0, 1, … in the order in which they first appear."""
    _, first, number = np.unique(assignment, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[number.ravel()], dtype=np.int64)
