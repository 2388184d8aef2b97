"""Clusterings of observers into user types (docs/method.md, section 4).

A *clusterer* is a component with one method (this signature is what other stages build on)::

    cluster(dataset, trainer, seed, truth) -> Clustering

``trainer`` fits labelers where the method needs them; ``truth`` [O] is the true type of each
observer where it is known (simulated observers), and only :class:`Perfect` may look at it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError
from xplain.learning.answer_model import AnswerModel
from xplain.learning.data.dataset import Dataset
from xplain.learning.labelers import LabelerTrainer


@dataclass(frozen=True)
class Clustering:
    """Which observers are taken to be of one type.

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
        """Observers are of one type who hold the same facts [O] wrong, as a Dirichlet process says;
        ``about`` are the other attributes."""
        _, first = np.unique(facts, return_index=True)
        return cls(facts, "dirichlet", rule, needs=facts[np.sort(first)], **about)

    @property
    def n_types(self) -> int:
        """N: how many types were found."""
        return int(self.assignment.max()) + 1

    @property
    def shares(self) -> NDArray[np.float64]:
        """[N] of the observers."""
        return np.bincount(self.assignment) / len(self.assignment)

    def members(self, cluster: int) -> NDArray[np.int64]:
        """Indices of the observers of a cluster, ascending."""
        return np.flatnonzero(self.assignment == cluster)


class Clusterer(Protocol):
    """Groups observers by user type: the interface of every component ``clusterer``."""

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """One cluster a user type.

        Args:
            dataset: labels of O observers.
            trainer: fits labelers where the method needs them.
            seed: of every draw.
            truth: [O] the true types, where they are known; only :class:`Perfect` reads them.

        Raises:
            InputError: the method needs what the data do not have.
            TooLargeError: the data, or the messages, are too many for the method.
        """
        ...


@runtime_checkable
class KnowsFactSets(Protocol):
    """A trainer with hypotheses of what people hold wrong (docs/what-to-ask.md)."""

    def find_types(self, dataset: Dataset, concentration: float) -> Clustering | None:
        """The types by a Dirichlet process with this concentration, fact sets being those of the
        hypotheses; None where they know nothing of the dataset."""
        ...


@dataclass(frozen=True)
class Perfect:
    """The true types: perfect clustering, the source of the oracle's labelers (docs/method.md,
    section 6)."""

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """Raises InputError where the truth is not known."""
        if truth is None:
            raise InputError(
                "clusterer", "perfect", "needs simulated observers, whose type is known"
            )
        return Clustering(np.asarray(truth), "perfect", "truth")


@dataclass(frozen=True)
class Single:
    """Everybody is of one type (the paper's baseline)."""

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """All O observers in cluster 0."""
        return Clustering(np.zeros(len(dataset.observers), dtype=np.int64), "single", "one type")


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
