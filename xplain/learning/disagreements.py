"""Disagreements of a clustering (paper, Definition 1), from counts.

Two labels disagree when they are of one cluster, transition and message set, and differ. Within a
*cell* (transition, message set) a cluster with z zeros and o ones has z · o such pairs.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset, query_index
from xplain.numba_kernels import lean_kernel


def disagreements(dataset: Dataset, assignments: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Of each of K clusterings [O], in time linear in the labels: [K]."""
    cell = query_index(dataset)
    ones, size = np.bincount(cell, weights=dataset.label), np.bincount(cell)
    # Cells whose labels all agree never count and are left out.
    split = (ones > 0) & (ones < size)
    rows = np.flatnonzero(split[cell])
    rows = rows[np.argsort(cell[rows], kind="stable")]
    start = np.concatenate([[0], np.cumsum(size[split])]).astype(np.int64)
    observer, label = dataset.observer[rows], dataset.label[rows]
    found = []
    for assignment in assignments:
        counts = np.zeros((2, int(assignment.max()) + 1), dtype=np.int64)
        found.append(_count(start, assignment[observer], label, counts))
    return np.array(found, dtype=np.int64)


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
