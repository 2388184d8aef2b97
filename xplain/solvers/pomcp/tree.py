"""The arrays that :mod:`xplain.solvers.pomcp.kernel` searches in.

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
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import kernel
from xplain.solvers.model import explain_costs, optimal_values, table_bytes
from xplain.solvers.model import model_of as reduced_model
from xplain.solvers.pomcp.kernel import GOLDEN, SETTLED, mix

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
        ("visits", np.int32),
        ("child", np.int32),  # after a message, or the last after *explain*; 0 until known
    ],
    align=True,
)
ENTRY = np.dtype([("node", np.int32), ("tag", np.uint32)])
LIKELIEST = np.dtype([("probability", np.float64), ("code", np.uint64)])
FIRST_TABLE = 1 << 12
"""Entries of the table that a search begins with."""
REMEMBERED = 1 << 11
"""Most observations whose likelihoods a search remembers: they stay in the processor's cache."""


class Model(NamedTuple):
    """A problem as the search wants it.

    Attributes:
        optimal: [m + 1, 2^n, N] V*_t(k, H).
        explain_cost: [2^n, m, N] C_inexp Σ_{i ≤ k + 1} (1 − P[t, i, H]).
        informative: [2^n, m] how many of the first k + 1 labels types answer differently.
        p: [2^n, m, N] P of the informative labels, in order.
        weight: [2^n, m] their w.
        likeliest: [2^n, m, N] LIKELIEST, where each of the first k + 1 informative labels is the
            likelier of the two: its probability (≥ ½ a label), and its code.
        wanted: [2^n, m] bitmask of the messages that some type should be given next rather than
            *explain*; SETTLED where no type should from here to the end.
        price: [n] λ C_e.
        discount, message_discount: γ of *explain* and of a message.
    """

    optimal: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    informative: NDArray[np.int32]
    p: NDArray[np.float64]
    weight: NDArray[np.uint64]
    likeliest: NDArray[np.void]
    wanted: NDArray[np.int32]
    price: NDArray[np.float64]
    discount: float
    message_discount: float


class Options(NamedTuple):
    """How to search, as numbers of :mod:`xplain.solvers.pomcp.kernel`.

    Attributes:
        depth: where simulations end.
        message_depth: what a message adds to the depth, 0 or 1; *explain* adds 1.
        exploration: in the problem's unit of cost.
        leaf, rollout, backup: see :class:`xplain.solvers.pomcp.solver.POMCP`.
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
        edges: [(S + 2) · (n + 1)] EDGE; a node's are those of the messages not yet given, in
            order, then *explain*. The first n + 1 are unused, so that 0 means none.
        beliefs: [S + 1, N], filled for nodes that begin a step.
        table: [a power of two > 2 S + 2] ENTRY, nodes by hash; 0 is none (the root is no child).
            Only the first ``used[2] + 1`` entries are in use; they double as nodes come.
        seen: [a power of two] hashes of observations, 0 is none, and
        likelihoods: [.., N] what they are for each type.
        zero: [m] labels drawn, and
        now: [N] a belief: room for a rollout.
        path: [3, n + m + 1] nodes, edges and actions of a simulation.
        used: [3] nodes and edges taken, and the table's mask.
        counter: [1] of the random stream.
    """

    nodes: NDArray[np.void]
    edges: NDArray[np.void]
    beliefs: NDArray[np.float64]
    table: NDArray[np.void]
    seen: NDArray[np.uint64]
    likelihoods: NDArray[np.float64]
    zero: NDArray[np.bool_]
    now: NDArray[np.float64]
    path: NDArray[np.int64]
    used: NDArray[np.int64]
    counter: NDArray[np.uint64]

    @classmethod
    def rooted(
        cls,
        simulations: int,
        n_messages: int,
        n_steps: int,
        step: int,
        given: int,
        belief: NDArray[np.float64],
        seed: int,
    ) -> Tree:
        """A tree of one node. Memory that no simulation reaches is never touched."""
        size, actions = simulations + 1, n_messages + 1
        remembered = min(_table_size(simulations), REMEMBERED)
        tree = cls(
            _in_lines(size, NODE),
            np.empty((size + 1) * actions, EDGE),
            np.empty((size, len(belief))),
            np.zeros(_table_size(simulations), ENTRY),
            np.zeros(remembered, np.uint64),
            np.empty((remembered, len(belief))),
            np.empty(n_steps, np.bool_),
            np.empty(len(belief)),
            np.empty((3, n_messages + n_steps + 1), np.int64),
            np.array([1, actions, FIRST_TABLE - 1]),
            np.array([seed], np.uint64),
        )
        tree.nodes[0] = (0, np.nan, 0.0, 0.0, 0, 0, 0, step, given, 0, 0)
        tree.beliefs[0] = belief
        return tree

    def root_edges(self) -> NDArray[np.void]:
        """The edges of the root, [n + 1]: one a message, the last for *explain*."""
        root, actions = self.nodes[0], len(self.edges) // (len(self.nodes) + 1)
        edges = np.array([(-np.inf, 0, 0)] * actions, EDGE)
        available = [a for a in range(actions) if not int(root["given"]) >> a & 1]
        edges[available] = self.edges[root["edges"] : root["edges"] + len(available)]
        return edges


def _table_size(simulations: int) -> int:
    return max(FIRST_TABLE, 1 << (2 * simulations + 2).bit_length())


def _in_lines(size: int, kind: np.dtype[np.void]) -> NDArray[np.void]:
    """An empty array that begins with a cache line (64 bytes), as each of its nodes then does."""
    room = np.empty(size * kind.itemsize + 64, np.uint8)
    start = -room.ctypes.data % 64
    return room[start : start + size * kind.itemsize].view(kind)


def tree_bytes(problem: Problem, simulations: int) -> int:
    """The most that a tree takes."""
    node = NODE.itemsize + 8 * problem.n_types + EDGE.itemsize * (problem.n_messages + 1)
    table = _table_size(simulations)
    remembered = min(table, REMEMBERED) * 8 * (problem.n_types + 1)
    return (simulations + 2) * node + ENTRY.itemsize * table + remembered


def model_bytes(problem: Problem) -> int:
    """What :func:`model_of` takes."""
    sets, steps = 1 << problem.n_messages, problem.n_steps
    return table_bytes(problem) + sets * steps * (32 * problem.n_types + 16)


def model_of(problem: Problem) -> Model:
    """Lays a problem out for the search."""
    p = problem.p_explicable
    types, steps, sets = p.shape
    reduced = reduced_model(problem)
    model = Model(
        optimal_values(reduced),
        np.ascontiguousarray(explain_costs(reduced).transpose(1, 0, 2)),
        np.empty((sets, steps), np.int32),
        np.empty((sets, steps, types)),
        np.empty((sets, steps), np.uint64),
        np.empty((sets, steps, types), LIKELIEST),
        np.empty((sets, steps), np.int32),
        reduced.price,
        reduced.discount,
        reduced.message_discount,
    )
    _lay_out(p, p.view(np.uint64), *model[2:6])
    _want(model.optimal, model.explain_cost, *model[6:])
    return model


@kernel
def _lay_out(p, bits, informative, news, weight, likeliest):  # type: ignore[no-untyped-def]
    types, steps, sets = p.shape
    for given in range(sets):
        found = 0
        for i in range(steps):
            differs = False
            code = GOLDEN
            for t in range(types):
                differs |= p[t, i, given] != p[0, i, given]
                code = mix((code + GOLDEN) ^ bits[t, i, given])
            if differs:
                for t in range(types):  # a slice would compile for two seconds longer
                    news[given, found, t] = p[t, i, given]
                weight[given, found] = code
                found += 1
            informative[given, i] = found
            for t in range(types):
                usual = likeliest[given, i, t]
                before = likeliest[given, max(i - 1, 0), t]
                usual.probability = before.probability if i > 0 else 1.0
                usual.code = before.code if i > 0 else np.uint64(0)
                if differs:
                    yes = p[t, i, given]
                    usual.probability *= max(yes, 1.0 - yes)
                    usual.code += code if yes < 0.5 else np.uint64(0)


@kernel
def _want(optimal, explain_cost, wanted, price, discount, message_discount):  # type: ignore[no-untyped-def]
    sets, steps, types = explain_cost.shape
    for given in range(sets):
        for k in range(steps - 1, -1, -1):
            mask = 0
            for t in range(types):
                silent = discount * optimal[k + 1, given, t] - explain_cost[given, k, t]
                if optimal[k, given, t] > silent:
                    for j in range(len(price)):
                        if not given >> j & 1:
                            said = message_discount * optimal[k, given | 1 << j, t] - price[j]
                            mask |= (said > silent) << j
            settled = mask == 0 and (k + 1 == steps or wanted[given, k + 1] == SETTLED)
            wanted[given, k] = SETTLED if settled else mask
