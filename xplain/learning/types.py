"""Types of observers, and the user types that agents know."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import TooLargeError
from xplain.explanation.belief import OPEN
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.learning.answers import AnswerModel


@dataclass(frozen=True)
class Clustering:
    """A grouping of the observers: one cluster for each type.

    Attributes:
        assignment: [O] int64 cluster of each observer, numbered by first appearance.
        method: name of the method.
        rule: the rule that chose the number of clusters.
        curve: [K] disagreements for k = 1 … K; None if the method has no such curve.
        vectors: [O] int64 smallest message set of each observer; None if not computed.
        posterior: P(number of types = k) by k; None if the method gives no posterior.
        needs: [N] int64 messages that people of each type need; None if unknown.
        expected: [O, T] P(answer 1) of each observer about each transition of the dataset; None if
            the method does not predict answers itself.
        answers: error model for the dataset's transitions and observers; None if unknown.
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
        """Makes the clustering of a Dirichlet process: observers who believe the same facts [O]
        incorrectly form one type. ``about`` holds the other attributes."""
        _, first = np.unique(facts, return_index=True)
        return cls(facts, "dirichlet", rule, needs=facts[np.sort(first)], **about)

    @property
    def n_types(self) -> int:
        """N, the number of types."""
        return int(self.assignment.max()) + 1

    @property
    def shares(self) -> NDArray[np.float64]:
        """[N] share of the observers in each type."""
        return np.bincount(self.assignment) / len(self.assignment)

    @property
    def new(self) -> float:
        """P(the next person has a new type): the share of observers who are alone in their type
        (Good 1953), but at least the constant OPEN."""
        alone = int((np.bincount(self.assignment) == 1).sum())
        return max(OPEN, alone / (len(self.assignment) + 1))

    def members(self, cluster: int) -> NDArray[np.int64]:
        """Returns the indices of the observers of a cluster, ascending."""
        return np.flatnonzero(self.assignment == cluster)


@dataclass(frozen=True, kw_only=True)
class TraceTables:
    """The label tables of a trace's m transitions.

    Attributes:
        learned: P(label is 1) for the N types that solvers plan with.
        everyone: P(label is 1) by one labeler for all observers; None if it tests too many
            messages.
        perfect: P(label is 1) for the M true types, as the oracle knows them; None if there is no
            oracle.
        everything: P(label is 1) for a type that believes every fact incorrectly; None if facts are
            unknown.
    """

    learned: LabelTable
    everyone: LabelTable | None
    perfect: LabelTable | None
    everything: LabelTable | None = None


def unless_too_large(make: Callable[[], LabelTable]) -> LabelTable | None:
    """Returns the table that ``make`` returns, or None if it raises TooLargeError. (A labeler for
    all observers tests the messages of every type, and few runs need its table.)"""
    try:
        return make()
    except TooLargeError:
        return None


TablesOf = Callable[[NDArray[np.float64], NDArray[np.int64]], TraceTables]
"""Makes the tables of a trace from the features [m, F] of its transitions [m, 3]."""


@dataclass(frozen=True, kw_only=True)
class KnownTypes:
    """The N user types that agents know.

    Attributes:
        learned_types: N names.
        matched_true_type: [N] the true type that each type represents, as the number in
            ``Setting.distinct`` that most of its observers have; −1 if unknown.
        type_shares: [N] each type's share of the observers.
        learning: figures of the learning stage, by name.
        curve: disagreements with k = 1, 2, … types; empty if the method computes none.
        rule: the rule that chose the number of types.
        habits: people's error model, learned from the observers' answers; None if unknown.
        wrong: [N, n] P(a user of the type believes a fact incorrectly); None if unknown.
        new: P(a user has none of the types).
        doubted: [K, 3] facts and ways of K observers, as in
            :func:`xplain.learning.mixture.partition.learn_ways`, if the types are doubtful.
    """

    learned_types: tuple[str, ...]
    matched_true_type: NDArray[np.int64]
    type_shares: NDArray[np.float64]
    learning: dict[str, float]
    curve: NDArray[np.float64]
    rule: str
    habits: Habits | None = None
    wrong: NDArray[np.float64] | None = None
    new: float = OPEN
    doubted: NDArray[np.int64] | None = None


def shares_of(drawn: ArrayLike) -> dict[int, float]:
    """Computes the share of each value among sampled numbers of types: {k: P(number of types =
    k)}."""
    number, times = np.unique(drawn, return_counts=True)
    return dict(zip(number.tolist(), (times / times.sum()).tolist(), strict=True))


def by_first_appearance(assignment: NDArray[np.int64]) -> NDArray[np.int64]:
    """Renumbers the groups 0, 1, … in the order in which they first appear."""
    _, first, number = np.unique(assignment, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return np.asarray(rank[number.ravel()], dtype=np.int64)
