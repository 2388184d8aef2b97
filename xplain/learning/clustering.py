"""Clusterings of observers, and the paper's way to one (SPEC §4).

A *clusterer* is a component with one method (this signature is what other stages build on)::

    cluster(dataset, trainer, seed, truth) -> Clustering

``trainer`` fits labelers where the method needs them; ``truth`` [O] is the true type of each
observer where it is known (simulated observers), and only :class:`Perfect` may look at it.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.errors import InputError
from xplain.learning.disagreements import Cells
from xplain.learning.elbow import elbow
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.message_vectors import vectors
from xplain.message_sets import bits_of
from xplain.randomness import derived_seed

log = logging.getLogger(__name__)


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
    """

    assignment: NDArray[np.int64]
    method: str
    rule: str
    curve: NDArray[np.int64] | None = None
    vectors: NDArray[np.int64] | None = None
    posterior: Mapping[int, float] | None = None
    needs: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "assignment", by_first_appearance(self.assignment))

    @property
    def n_types(self) -> int:
        """Clusters found."""
        return int(self.assignment.max()) + 1

    def members(self, cluster: int) -> NDArray[np.int64]:
        """The observers of a cluster."""
        return np.flatnonzero(self.assignment == cluster)


class Clusterer(Protocol):
    """Finds the observers' types."""

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """One cluster a user type."""
        ...


class Partition(Protocol):
    """The plug-in of :class:`Elbow`: any clustering into a given number of groups."""

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Groups [O] of the vectors [O, n], at most k of them, equal vectors together."""
        ...


@dataclass(frozen=True)
class Perfect:
    """The true types (SPEC: perfect clustering, the source of L_pc)."""

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
        """One cluster."""
        return Clustering(np.zeros(len(dataset.observers), dtype=np.int64), "single", "one type")


@dataclass(frozen=True)
class Elbow:
    """The paper's learner: observers as smallest message sets, partitioned into k = 1, 2, …
    groups, k at the elbow of the disagreements.

    Attributes:
        partition: how the vectors are grouped.
        few: see :func:`xplain.learning.elbow.elbow`.
        max_types: largest k tried; None is the number of observers (the paper).
    """

    partition: Partition
    few: float = 0.01
    max_types: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.few < 1:
            raise InputError("clusterer.few", self.few, "a share in [0, 1)")
        if self.max_types is not None and self.max_types < 1:
            raise InputError("clusterer.max_types", self.max_types, "null or a number ≥ 1")

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """Vectors, partitions, disagreements, elbow."""
        masks = vectors(dataset, trainer, seed)
        bits = bits_of(masks, dataset.n_messages)
        longest = min(len(masks), self.max_types or len(masks))
        distinct = min(len(np.unique(masks)), longest)
        found = [
            self.partition.partition(bits, k, derived_seed(seed, "partition", k))
            for k in range(1, distinct + 1)
        ]
        # More groups than distinct vectors cannot be told apart: the last partition stays.
        curve = Cells.of(dataset).curve(found)
        curve = np.concatenate([curve, np.full(longest - distinct, curve[-1])])
        k, rule = elbow(curve, self.few)
        name = type(self.partition).__name__.lower()
        return Clustering(found[min(k, distinct) - 1], name, rule, curve, masks)


@dataclass(frozen=True)
class KMeans:
    """Lloyd's k-means on the vectors (the paper), best of several starts."""

    starts: int = 10

    def __post_init__(self) -> None:
        if self.starts < 1:
            raise InputError("clusterer.partition.starts", self.starts, "a number ≥ 1")

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Groups [O] of the vectors [O, n]."""
        from sklearn.cluster import KMeans as Lloyd
        from threadpoolctl import threadpool_limits

        # Equal vectors are one point with a weight: the same answer at the size of the distinct.
        distinct, where, weight = np.unique(
            vectors, axis=0, return_inverse=True, return_counts=True
        )
        model = Lloyd(min(k, len(distinct)), n_init=self.starts, random_state=seed & 0xFFFFFFFF)
        with threadpool_limits(1):  # a few points: threads would cost more than the work
            groups = model.fit_predict(distinct.astype(np.float64), sample_weight=weight)
        return np.asarray(groups[where.ravel()], dtype=np.int64)


@dataclass(frozen=True)
class Agglomerative:
    """Hierarchical clustering of the vectors by Hamming distance."""

    linkage: str = "average"

    def __post_init__(self) -> None:
        if self.linkage not in ("average", "complete", "single"):
            raise InputError(
                "clusterer.partition.linkage", self.linkage, "average, complete or single"
            )

    def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
        """Groups [O] of the vectors [O, n]."""
        from scipy.cluster.hierarchy import fcluster, linkage

        distinct, where = np.unique(vectors, axis=0, return_inverse=True)
        if len(distinct) == 1:
            return np.zeros(len(vectors), dtype=np.int64)
        tree = linkage(distinct.astype(np.float64), method=self.linkage, metric="hamming")
        groups = fcluster(tree, min(k, len(distinct)), criterion="maxclust") - 1
        return np.asarray(groups[where.ravel()], dtype=np.int64)


def by_first_appearance(assignment: NDArray[np.int64]) -> NDArray[np.int64]:
    """The same groups, numbered 0, 1, … in the order in which they first appear."""
    _, first, number = np.unique(assignment, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[number.ravel()], dtype=np.int64)
