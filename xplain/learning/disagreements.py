"""Disagreements of a clustering (paper, Definition 1), from counts.

Two labels disagree when they are of one cluster, transition and message set, and differ. Within a
*cell* (transition, message set) a cluster with z zeros and o ones has z · o such pairs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset, query_index
from xplain.numba_kernels import lean_kernel


@dataclass(frozen=True)
class LabelCells:
    """The labels of a dataset, sorted by cell; made once, used for every clustering.

    Attributes:
        start: [C + 1] int64 first label of each cell.
        observer: [P] int64.
        label: [P] uint8.
    """

    start: NDArray[np.int64]
    observer: NDArray[np.int64]
    label: NDArray[np.uint8]

    @classmethod
    def of(cls, dataset: Dataset) -> LabelCells:
        """Sorts by cell. Cells whose labels all agree never count and are left out."""
        cell = query_index(dataset)
        ones = np.bincount(cell, weights=dataset.label)
        split = (ones > 0) & (ones < np.bincount(cell))
        rows = np.flatnonzero(split[cell])
        rows = rows[np.argsort(cell[rows], kind="stable")]
        size = np.bincount(cell)[split]
        start = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
        return cls(start, dataset.observer[rows], dataset.label[rows])

    def disagreements(self, assignment: NDArray[np.int64]) -> int:
        """Of one clustering [O], in time linear in the labels."""
        zeros = np.zeros((2, int(assignment.max()) + 1), dtype=np.int64)
        return int(_count(self.start, assignment[self.observer], self.label, zeros))

    def curve(self, assignments: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
        """Of several clusterings, one after the other."""
        return np.array([self.disagreements(one) for one in assignments], dtype=np.int64)


def disagreements(dataset: Dataset, assignment: NDArray[np.int64]) -> int:
    """Disagreements of one clustering: ``assignment`` [O] is the cluster of each observer."""
    return LabelCells.of(dataset).disagreements(assignment)


@lean_kernel
def _count(start, cluster, label, counts):  # type: ignore[no-untyped-def]
    """``counts`` [2, k]: zeros and ones by cluster in the current cell, all 0 between cells."""
    total = 0
    for c in range(len(start) - 1):
        for i in range(start[c], start[c + 1]):
            # Each label meets the other labels of its cluster that came before it.
            total += counts[1 - label[i], cluster[i]]
            counts[label[i], cluster[i]] += 1
        for i in range(start[c], start[c + 1]):
            counts[0, cluster[i]] = counts[1, cluster[i]] = 0
    return total
