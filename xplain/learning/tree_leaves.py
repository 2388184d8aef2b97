"""What a decision tree says about whole families of message sets at once.

A path of the tree fixes some message bits and leaves the others free: for a given transition the
tree's leaves are disjoint *cubes* of message sets. Whatever must be known for all 2^n message
sets is read off these cubes, without a prediction for each of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.message_sets import packed
from xplain.numba_kernels import lean_kernel


@dataclass(frozen=True)
class Cubes:
    """The leaves that each transition can reach, C in all, ordered by transition.

    A message set H reaches leaf c of its transition when ``H & ones[c] == ones[c]`` and
    ``H & zeros[c] == 0``; for each transition exactly one leaf does.

    Attributes:
        transition: [C] int64 index of the transition.
        ones: [C] int64, messages that must be given.
        zeros: [C] int64, messages that must not be given.
        leaf: [C] int64 node of the tree.
    """

    transition: NDArray[np.int64]
    ones: NDArray[np.int64]
    zeros: NDArray[np.int64]
    leaf: NDArray[np.int64]

    def over(self, messages: Sequence[int]) -> Cubes:
        """The same leaves for message sets that are masks over some messages alone; no leaf asks
        for others."""
        ones, zeros = packed(self.ones, messages), packed(self.zeros, messages)
        return Cubes(self.transition, ones, zeros, self.leaf)

    def table(self, value: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
        """``value`` [nodes] of the leaf that each (transition, message set) reaches: [T, 2^n]."""
        result = np.empty(shape)
        _fill(self.transition, self.ones, self.zeros, value[self.leaf], result)
        return result


def cubes(tree: Any, features: NDArray[np.float64], n_messages: int) -> Cubes:
    """The leaves that transitions can reach in a fitted tree (``DecisionTreeClassifier.tree_``).

    Args:
        tree: fitted on :func:`xplain.learning.data.dataset.inputs`.
        features: [T, F].
        n_messages: n ≤ 62.
    """
    nodes = (tree.feature, tree.threshold, tree.children_left, tree.children_right)
    # The tree compares single precision inputs with double precision thresholds.
    single = np.ascontiguousarray(features, dtype=np.float32)
    stack = np.empty((tree.max_depth + 2, 3), dtype=np.int64)
    nothing = np.empty((4, 0), dtype=np.int64)
    found = np.empty((4, _walk(*nodes, single, stack, nothing)), dtype=np.int64)
    _walk(*nodes, single, stack, found)
    return Cubes(*found)


@lean_kernel
def _walk(feature, threshold, left, right, features, stack, out):  # type: ignore[no-untyped-def]
    """Counts the cubes; writes them where ``out`` [4, C] has room. ``stack`` [depth + 2, 3] is room
    for the nodes still to visit, each with its ones and zeros."""
    room = out.shape[1]
    width = features.shape[1]
    count = 0
    for t in range(len(features)):
        stack[0, 0], stack[0, 1], stack[0, 2] = 0, 0, 0
        top = 1
        while top > 0:
            top -= 1
            node, ones, zeros = stack[top, 0], stack[top, 1], stack[top, 2]
            if left[node] < 0:
                if count < room:
                    out[0, count] = t
                    out[1, count] = ones
                    out[2, count] = zeros
                    out[3, count] = node
                count += 1
            elif feature[node] < width:
                below = features[t, feature[node]] <= threshold[node]
                stack[top, 0] = left[node] if below else right[node]  # its cube is in place
                top += 1
            else:
                bit = np.int64(1) << (feature[node] - width)
                if not ones & bit:
                    stack[top, 0], stack[top, 1], stack[top, 2] = left[node], ones, zeros | bit
                    top += 1
                if not zeros & bit:
                    stack[top, 0], stack[top, 1], stack[top, 2] = right[node], ones | bit, zeros
                    top += 1
    return count


@lean_kernel
def _fill(transition, ones, zeros, value, table):  # type: ignore[no-untyped-def]
    everything = table.shape[1] - 1
    for c in range(len(transition)):
        free = everything & ~(ones[c] | zeros[c])
        subset = free
        while True:
            table[transition[c], ones[c] | subset] = value[c]
            if subset == 0:
                break
            subset = (subset - 1) & free
