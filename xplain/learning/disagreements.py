"""Disagreements of a clustering (paper, Definition 1), from counts.

Two labels disagree when they are of one cluster, transition and message set, and differ. Within a
*cell* (transition, message set) a cluster with z zeros and o ones has z · o such pairs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.learning.labelers import points
from xplain.numba_kernels import kernel


@dataclass(frozen=True)
class Cells:
    """The labels of a dataset, sorted by cell; made once, used for every clustering.

    Attributes:
        start: [C + 1] int64 first label of each cell.
        observer: [P] int64.
        label: [P] uint8.
        observers: O.
    """

    start: NDArray[np.int64]
    observer: NDArray[np.int64]
    label: NDArray[np.uint8]
    observers: int

    @classmethod
    def of(cls, dataset: Dataset) -> Cells:
        """Sorts by cell. Cells whose labels all agree never count and are left out."""
        cell = points(dataset)
        ones = np.bincount(cell, weights=dataset.label)
        split = (ones > 0) & (ones < np.bincount(cell))
        rows = np.flatnonzero(split[cell])
        rows = rows[np.argsort(cell[rows], kind="stable")]
        size = np.bincount(cell)[split]
        start = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
        return cls(start, dataset.observer[rows], dataset.label[rows], len(dataset.observers))

    def disagreements(self, assignment: NDArray[np.int64]) -> int:
        """Of one clustering [O], in time linear in the labels."""
        zeros = np.zeros((2, int(assignment.max()) + 1), dtype=np.int64)
        return int(_count(self.start, assignment[self.observer], self.label, zeros))

    def curve(self, assignments: Iterable[NDArray[np.int64]]) -> NDArray[np.int64]:
        """Of several clusterings, one after the other."""
        return np.array([self.disagreements(one) for one in assignments], dtype=np.int64)

    def along(self, merges: NDArray[np.int64]) -> NDArray[np.int64]:
        """Of all cuts of a hierarchy at once: [O], entry k − 1 for k clusters.

        Args:
            merges: [O − 1, 2] as scipy's linkage: the clusters joined at each step; observers are
                0 … O − 1, the cluster made at step i is O + i.
        """
        position, height = _leaf_order(self.observers, merges.astype(np.int64))
        added = np.zeros(self.observers, dtype=np.int64)
        own = _along(self.start, self.observer, self.label, position, _highest(height), added)
        # After step i (from 0) there are O − 1 − i clusters.
        return np.concatenate([[own], own + np.cumsum(added[:-1])])[::-1].astype(np.int64)


def disagreements(dataset: Dataset, assignment: NDArray[np.int64]) -> int:
    """Disagreements of one clustering: ``assignment`` [O] is the cluster of each observer."""
    return Cells.of(dataset).disagreements(assignment)


@kernel
def _count(start, cluster, label, counts):  # type: ignore[no-untyped-def]
    """``counts`` [2, k]: zeros and ones by cluster in the current cell, all 0 between cells."""
    total = 0
    for c in range(len(start) - 1):
        for i in range(start[c], start[c + 1]):
            # Each label meets the other labels of its cluster that came before it.
            total += counts[1 - label[i], cluster[i]]
            counts[label[i], cluster[i]] += 1
        for i in range(start[c], start[c + 1]):
            counts[:, cluster[i]] = 0
    return total


def _leaf_order(
    leaves: int, merges: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """An order of the leaves in which every cluster is an interval, and what joins neighbours.

    Returns:
        position [O] of each leaf; step [O − 1] that joins positions i and i + 1.
    """
    # head and tail: first and last leaf of each cluster; after: the leaf that follows in the order.
    head, tail = np.arange(leaves + len(merges)), np.arange(leaves + len(merges))
    after, step = np.full(leaves, -1), np.zeros(leaves, dtype=np.int64)
    for i, (a, b) in enumerate(merges):
        after[tail[a]], step[tail[a]] = head[b], i
        head[leaves + i], tail[leaves + i] = head[a], tail[b]
    position, joined = np.empty(leaves, dtype=np.int64), np.empty(max(leaves - 1, 0), np.int64)
    leaf = int(head[-1])
    for place in range(leaves):
        position[leaf] = place
        if place < leaves - 1:
            joined[place] = step[leaf]
        leaf = int(after[leaf])
    return position, joined


def _highest(height: NDArray[np.int64]) -> NDArray[np.int64]:
    """Range maxima in constant time: row r holds the maxima of 2^r neighbours."""
    rows = [height]
    while 2 * (width := 1 << (len(rows) - 1)) <= len(height):
        row = rows[-1].copy()
        row[:-width] = np.maximum(row[:-width], row[width:])
        rows.append(row)
    return np.stack(rows)


@kernel
def _along(start, observer, label, position, highest, added):  # type: ignore[no-untyped-def]
    """Adds to ``added`` [step] the pairs that each step brings together; returns those of single
    observers. Within a cell the labels, by leaf position, are joined like the leaves of the
    hierarchy: a stack of intervals, the step that joins neighbours rising to the bottom."""
    alone = 0
    longest = 0
    for c in range(len(start) - 1):
        longest = max(longest, start[c + 1] - start[c])
    zeros = np.empty(longest + 1, dtype=np.int64)
    ones = np.empty(longest + 1, dtype=np.int64)
    step = np.empty(longest + 1, dtype=np.int64)  # that joins an interval to the one above it
    for c in range(len(start) - 1):
        places = position[observer[start[c] : start[c + 1]]]
        order = np.argsort(places)
        top = -1
        last = -1
        for i in order:
            place = places[i]
            is_one = label[start[c] + i]
            if place == last:
                alone += zeros[top] if is_one else ones[top]
            else:
                if top >= 0:
                    row = 0
                    while (2 << row) <= place - last:
                        row += 1
                    join = max(highest[row, last], highest[row, place - (1 << row)])
                    while top > 0 and step[top - 1] < join:
                        added[step[top - 1]] += (
                            zeros[top - 1] * ones[top] + ones[top - 1] * zeros[top]
                        )
                        zeros[top - 1] += zeros[top]
                        ones[top - 1] += ones[top]
                        top -= 1
                    step[top] = join
                top += 1
                zeros[top] = 0
                ones[top] = 0
                last = place
            zeros[top] += 1 - is_one
            ones[top] += is_one
        while top > 0:
            added[step[top - 1]] += zeros[top - 1] * ones[top] + ones[top - 1] * zeros[top]
            zeros[top - 1] += zeros[top]
            ones[top - 1] += ones[top]
            top -= 1
    return alone
