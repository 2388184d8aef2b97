"""Hierarchical clustering of the message-set vectors, and rules that say where to stop."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.errors import InputError
from xplain.learning.clustering import Clustering
from xplain.learning.cross_validation import folds, log_likelihoods
from xplain.learning.disagreements import Cells
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.message_vectors import vectors
from xplain.message_sets import bits_of
from xplain.randomness import stream

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Tree:
    """A hierarchy of observers.

    Attributes:
        merges: [O − 1, 2] int64 as scipy's linkage, equal vectors first.
        distinct: distinct vectors; finer cuts would part equal ones.
        bits: [O, n] uint8 the vectors.
        curve: [O] int64 disagreements for k = 1 … O.
    """

    merges: NDArray[np.int64]
    distinct: int
    bits: NDArray[np.uint8]
    curve: NDArray[np.int64]

    def cut(self, k: int) -> NDArray[np.int64]:
        """k clusters: [O]."""
        observers = len(self.bits)
        parent = np.arange(observers + len(self.merges))
        for step, pair in enumerate(self.merges[: observers - k]):
            parent[pair] = observers + step
        for node in range(len(parent) - 1, -1, -1):
            parent[node] = parent[parent[node]]
        return np.unique(parent[:observers], return_inverse=True)[1].astype(np.int64)


class Stop(Protocol):
    """Chooses the number of clusters."""

    def choose(
        self, tree: Tree, dataset: Dataset, trainer: LabelerTrainer, seed: int
    ) -> tuple[int, str]:
        """k, and the rule that chose it in a few words."""
        ...


@dataclass(frozen=True)
class Hierarchy:
    """Agglomerative clustering of observers by the Hamming distance of their vectors.

    Attributes:
        stop: where to cut.
        linkage: average, complete or single.
    """

    stop: Stop
    linkage: str = "average"

    def __post_init__(self) -> None:
        if self.linkage not in ("average", "complete", "single"):
            raise InputError("clusterer.linkage", self.linkage, "average, complete or single")

    def cluster(
        self,
        dataset: Dataset,
        trainer: LabelerTrainer,
        seed: int,
        truth: NDArray[np.int64] | None,
    ) -> Clustering:
        """The cut of the hierarchy that the rule chooses; disagreements of all cuts at once."""
        masks = vectors(dataset, trainer, seed)
        bits = bits_of(masks, dataset.n_messages)
        merges = _merges(masks, bits, self.linkage)
        tree = Tree(merges, len(np.unique(masks)), bits, Cells.of(dataset).along(merges))
        k, rule = self.stop.choose(tree, dataset, trainer, seed)
        log.info("%d user types by the rule %s", k, rule)
        return Clustering(tree.cut(k), "hierarchy", rule, tree.curve, masks)


@dataclass(frozen=True)
class Share:
    """The fewest clusters that leave at most a share of the disagreements of one cluster."""

    few: float = 0.01

    def __post_init__(self) -> None:
        if not 0 <= self.few < 1:
            raise InputError("clusterer.stop.few", self.few, "a share in [0, 1)")

    def choose(
        self, tree: Tree, dataset: Dataset, trainer: LabelerTrainer, seed: int
    ) -> tuple[int, str]:
        """The last cut tried keeps equal vectors together, whatever it leaves."""
        curve = tree.curve[: tree.distinct]
        enough = np.flatnonzero(curve <= self.few * curve[0])
        k = int(enough[0]) + 1 if len(enough) else tree.distinct
        return k, f"disagreements ≤ {self.few:g}" if len(enough) else "distinct vectors"


@dataclass(frozen=True)
class Gap:
    """The gap statistic (Tibshirani, Walther & Hastie 2001): the first k whose dispersion is below
    that of reference data by as much as that of k + 1, less its standard error.

    Reference data: bits drawn one by one with the frequencies of the vectors' bits.
    """

    references: int = 20
    max_types: int = 20

    def __post_init__(self) -> None:
        if self.references < 2:
            raise InputError("clusterer.stop.references", self.references, "a number ≥ 2")

    def choose(
        self, tree: Tree, dataset: Dataset, trainer: LabelerTrainer, seed: int
    ) -> tuple[int, str]:
        """Compares the cuts of the vectors with cuts of reference vectors."""
        rng = stream(seed, "gap")
        most = min(self.max_types, len(tree.bits))
        own = _dispersions(tree.bits, tree.cut, most)
        drawn = []
        for _ in range(self.references):
            bits = (rng.random(tree.bits.shape) < tree.bits.mean(axis=0)).astype(np.uint8)
            masks = (bits.astype(np.int64) << np.arange(bits.shape[1])).sum(axis=1)
            merges = _merges(masks, bits, "average")
            drawn.append(_dispersions(bits, Tree(merges, 0, bits, tree.curve).cut, most))
        reference = np.array(drawn)
        gap = reference.mean(axis=0) - own
        error = reference.std(axis=0) * np.sqrt(1 + 1 / self.references)
        for k in range(1, most):
            if gap[k - 1] >= gap[k] - error[k]:
                return min(k, tree.distinct), "gap statistic"
        return min(most, tree.distinct), "gap statistic, no k sufficed"


@dataclass(frozen=True)
class HeldOut:
    """The number of clusters whose labelers foretell held-out labels best."""

    folds: int = 3
    max_types: int = 20
    patience: int = 3

    def choose(
        self, tree: Tree, dataset: Dataset, trainer: LabelerTrainer, seed: int
    ) -> tuple[int, str]:
        """Cross-validated by distinct point; ends when ``patience`` more have not helped."""
        parts = [
            (dataset.take(np.flatnonzero(~test)), dataset.take(np.flatnonzero(test)))
            for test in folds(dataset, self.folds, seed)
        ]
        best, best_k = -np.inf, 1
        for k in range(1, min(self.max_types, tree.distinct) + 1):
            cut = tree.cut(k)
            value = sum(
                float(log_likelihoods(train, test, cut, trainer, seed).sum())
                for train, test in parts
            )
            if value > best:
                best, best_k = value, k
            elif k >= best_k + self.patience:
                break
        return best_k, "held-out likelihood"


def _merges(masks: NDArray[np.int64], bits: NDArray[np.uint8], linkage: str) -> NDArray[np.int64]:
    """Linkage over observers [O − 1, 2]: equal vectors joined first, then the distinct ones (each
    counted once, so that 10,000 observers cost no more than their distinct vectors)."""
    from scipy.cluster.hierarchy import linkage as link

    observers = len(masks)
    merges: list[tuple[int, int]] = []
    distinct, first, where = np.unique(masks, return_index=True, return_inverse=True)
    head = first.astype(np.int64)
    for o in range(observers):
        group = where[o]
        if o != first[group]:
            merges.append((int(head[group]), o))
            head[group] = observers + len(merges) - 1
    if len(distinct) > 1:
        upper = link(bits[first].astype(np.float64), method=linkage, metric="hamming")
        names = [*head.tolist(), *(observers + len(merges) + np.arange(len(upper))).tolist()]
        merges.extend((names[int(a)], names[int(b)]) for a, b in upper[:, :2])
    return np.array(merges, dtype=np.int64).reshape(-1, 2)


def _dispersions(
    bits: NDArray[np.uint8], cut: Callable[[int], NDArray[np.int64]], most: int
) -> NDArray[np.float64]:
    """Dispersion of the cuts into 1 … most clusters: half the mean distance of an observer to its
    cluster's members, which for bits is a sum of p (1 − p)."""
    result = np.empty(most)
    for k in range(1, most + 1):
        groups = cut(k)
        size = np.bincount(groups)
        ones = np.stack([np.bincount(groups, weights=column) for column in bits.T], axis=1)
        share = ones / size[:, None]
        result[k - 1] = (size[:, None] * share * (1 - share)).sum() / len(bits)
    return result
