"""Disagreements of a clustering (paper, Definition 1), from counts.

Two labels disagree when they are of one cluster, transition and message set, and differ. Within a
*cell* (transition, message set) a cluster with z zeros and o ones has z · o such pairs.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset, query_index


def disagreements(dataset: Dataset, assignments: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Of each of K clusterings [O]: [K]."""
    cell = query_index(dataset)
    ones, size = np.bincount(cell, weights=dataset.label), np.bincount(cell)
    rows = np.flatnonzero(((ones > 0) & (ones < size))[cell])  # all others agree, and never count
    cell, observer, label = cell[rows], dataset.observer[rows], dataset.label[rows]
    found = []
    for assignment in assignments:
        both = cell * len(assignment) + assignment[observer]
        own = np.unique(both, return_inverse=True)[1]
        one = np.bincount(own, weights=label)
        found.append(int(one @ (np.bincount(own) - one)))
    return np.array(found, dtype=np.int64)
