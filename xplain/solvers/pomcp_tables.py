"""The arrays that :mod:`xplain.solvers.pomcp_kernel` searches in.

A node is a history that ends in a belief: k transitions shown, messages H given, exact belief b.
Children are found in one open-addressing table, by (node, labels) after *explain* and by (node
where the step began, H) after a message: orders of the same messages lead to one node.

What every type answers alike is no news and is not drawn. Labels with the same column P[:, i, H]
are exchangeable, so an observation is known by Σ_i [l_i = 0] · w_i, with one 64-bit hash w a
distinct column (two different observations of a node are taken for one with probability 2^-64).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.solvers.dynamic_programming import (
    message_discount,
    message_price,
    optimal_values,
    table_bytes,
)
from xplain.solvers.pomcp_kernel import GOLDEN, mix

NODE = np.dtype(
    [
        ("code", np.uint64),  # of the labels that led here; H after a message
        ("leaf", np.float64),  # QMDP's value at the belief, NaN until asked for
        ("value", np.float64),  # of the best action so far, or of the only rollout
        ("reward", np.float64),  # expected, of *explain*
        ("edges", np.int64),  # its first edge; 0 until it is visited a second time
        ("parent", np.int32),  # node before *explain*; ~base after a message
        ("base", np.int32),  # node where the step began; its belief is this node's
        ("step", np.int32),  # k
        ("given", np.int32),  # H
        ("untried", np.int32),  # bitmask of actions
        ("visits", np.int32),
    ],
    align=True,
)
EDGE = np.dtype(
    [
        ("value", np.float64),  # estimated return; −inf until tried
        ("width", np.float64),  # exploration / sqrt(visits)
        ("visits", np.int32),
        ("child", np.int32),  # after a message; 0 until known
    ],
    align=True,
)


class Model(NamedTuple):
    """A problem as the search wants it.

    Attributes:
        optimal: [m + 1, 2^n, N] V*_t(k, H).
        explain_cost: [2^n, m, N] C_inexp Σ_{i ≤ k + 1} (1 − P[t, i, H]).
        informative: [2^n, m] how many of the first k + 1 labels types answer differently.
        p: [2^n, m, N] P of the informative labels, in order.
        weight: [2^n, m] their w.
        price: [n] λ C_e.
        discount, message_discount: γ of *explain* and of a message.
    """

    optimal: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    informative: NDArray[np.int32]
    p: NDArray[np.float64]
    weight: NDArray[np.uint64]
    price: NDArray[np.float64]
    discount: float
    message_discount: float


class Options(NamedTuple):
    """How to search, as numbers of :mod:`xplain.solvers.pomcp_kernel`.

    Attributes:
        depth: where simulations end.
        message_depth: what a message adds to the depth, 0 or 1; *explain* adds 1.
        exploration: in the problem's unit of cost.
        leaf, rollout, backup: see :class:`xplain.solvers.pomcp.POMCP`.
    """

    depth: int
    message_depth: int
    exploration: float
    leaf: int
    rollout: int
    backup: int


class Tree(NamedTuple):
    """Room for a search of S simulations: each adds at most one node.

    Attributes:
        nodes: [S + 1] NODE.
        edges: [(S + 2) · (n + 1)] EDGE; the first n + 1 are unused, so that 0 means none.
        beliefs: [S + 1, N], filled for nodes that begin a step.
        table: [a power of two ≥ 2 S + 2] nodes by hash; 0 is none (the root is no child).
        used: [2] nodes and edges taken.
        counter: [1] of the random stream.
    """

    nodes: NDArray[np.void]
    edges: NDArray[np.void]
    beliefs: NDArray[np.float64]
    table: NDArray[np.int32]
    used: NDArray[np.int64]
    counter: NDArray[np.uint64]

    @classmethod
    def rooted(
        cls,
        simulations: int,
        n_messages: int,
        step: int,
        given: int,
        belief: NDArray[np.float64],
        seed: int,
    ) -> Tree:
        """A tree of one node. Memory that no simulation reaches is never touched."""
        size, actions = simulations + 1, n_messages + 1
        tree = cls(
            np.empty(size, NODE),
            np.empty((size + 1) * actions, EDGE),
            np.empty((size, len(belief))),
            np.zeros(_table_size(simulations), np.int32),
            np.array([1, actions]),
            np.array([seed], np.uint64),
        )
        tree.nodes[0] = (0, np.nan, 0.0, 0.0, 0, 0, 0, step, given, 0, 0)
        tree.beliefs[0] = belief
        return tree

    def root_edges(self) -> NDArray[np.void]:
        """The edges of the root: one a message, the last for *explain*."""
        root = self.nodes[0]["edges"]
        actions = len(self.edges) // (len(self.nodes) + 1)
        return self.edges[root : root + actions]


def _table_size(simulations: int) -> int:
    return 1 << (2 * simulations + 1).bit_length()


def tree_bytes(problem: Problem, simulations: int) -> int:
    """The most that a tree takes."""
    node = NODE.itemsize + 8 * problem.n_types + EDGE.itemsize * (problem.n_messages + 1)
    return (simulations + 2) * node + 4 * _table_size(simulations)


def model_bytes(problem: Problem) -> int:
    """What :func:`model_of` takes."""
    sets, steps = 1 << problem.n_messages, problem.n_steps
    return table_bytes(problem) + sets * steps * (16 * problem.n_types + 12)


def model_of(problem: Problem) -> Model:
    """Lays a problem out for the search."""
    p = problem.p_explicable
    types, steps, sets = p.shape
    model = Model(
        optimal_values(problem),
        np.empty((sets, steps, types)),
        np.empty((sets, steps), np.int32),
        np.empty((sets, steps, types)),
        np.empty((sets, steps), np.uint64),
        message_price(problem),
        problem.discount,
        message_discount(problem),
    )
    cost = problem.inexplicability_cost
    _lay_out(p, p.view(np.uint64), cost, *model[1:5])
    return model


@njit(cache=True, nogil=True)
def _lay_out(p, bits, inexplicability, explain_cost, informative, news, weight):  # type: ignore[no-untyped-def]
    types, steps, sets = p.shape
    for given in range(sets):
        found = 0
        for i in range(steps):
            differs = False
            code = GOLDEN
            for t in range(types):
                shown_before = explain_cost[given, i - 1, t] if i > 0 else 0.0
                explain_cost[given, i, t] = shown_before + inexplicability * (1.0 - p[t, i, given])
                differs |= p[t, i, given] != p[0, i, given]
                code = mix((code + GOLDEN) ^ bits[t, i, given])
            if differs:
                news[given, found] = p[:, i, given]
                weight[given, found] = code
                found += 1
            informative[given, i] = found
