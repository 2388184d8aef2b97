"""The search tree of :mod:`xplain.solvers.pomcp.kernel`: flat arrays, made before the search.

A node is a history that ends in a belief: k transitions shown, messages H given, exact belief b.
:mod:`xplain.solvers.pomcp.growth` adds nodes and edges.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.solvers.inquiry import NO_ROOM, Room
from xplain.solvers.pomcp.growth import CLOSED

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
        ("visits", np.int32),
        ("given", np.int64),  # H
        ("untried", np.int64),  # bitmask of actions
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
INQUIRED = 4
"""Questions that a search tries at a belief, at most: the most telling."""
FIRST_TABLE = 1 << 12
"""Entries of the table that a search begins with."""
REMEMBERED = 1 << 11
"""Most observations whose likelihoods a search remembers: they stay in the processor's cache."""

Roots = tuple[NDArray[np.float64], NDArray[np.float64]]


class Options(NamedTuple):
    """How to search.

    Attributes:
        depth: where simulations end.
        message_depth: what a message adds to the depth, 0 or 1; *explain* adds 1.
        exploration: in the problem's unit of cost.
        backup: see :class:`xplain.solvers.pomcp.solver.POMCP`; numbered as in
            :mod:`xplain.solvers.pomcp.kernel`.
    """

    depth: int
    message_depth: int
    exploration: float
    backup: int


class SearchRoot(NamedTuple):
    """Where a search starts: k; H, or where messages may be said again those that may not be now; a
    belief; the bitmask of questions asked; whether one may be asked now, as none may between a
    step's messages; and, as far as it matters, what was said at earlier steps."""

    step: int
    given: int
    belief: NDArray[np.float64]
    asked: int = 0
    may_ask: bool = True
    before: int = 0


class Tree(NamedTuple):
    """Room for a search of S simulations: each adds at most one node.

    Attributes:
        nodes: [S + 1] NODE.
        edges: [(S + 2) · (n + 1 + B)] EDGE; a node's are those of the messages not yet given, in
            order, then *explain*, then at most B questions. The first n + 1 + B are unused, so that
            0 means none.
        beliefs: [S + 1, N], filled for nodes that begin a step.
        table: [a power of two > 2 S + 2] ENTRY, nodes by hash; 0 is none (the root is no child).
            Only the first ``used[MASK] + 1`` entries are in use; they double as nodes come.
        seen: [a power of two] hashes of observations, 0 is none, and
        likelihoods: [.., N] what they are for each type.
        zero: [m] which of the labels drawn last are 0, where not all were the likelier.
        rollout_belief: [N] a rollout keeps its belief here.
        rows: [N] of a history, and
        gain: [n] what QMDP finds messages worth.
        path: [3, (n + 1) m + 1 + Q] nodes, edges and actions of a simulation, and
        paid: what its messages cost.
        used: [3] how many nodes and edges are taken (NODES, EDGES), and the table's MASK.
        counter: [1] of the random stream.
        inquired: [S + 1, B + 2] of nodes that a question may be asked at: its questions, how many
            these are, and the question that led there, −1 for none. [1, 2] without questions.
        asked: [Q] bool, before the root, and
        room: to look at questions in.
        before: [S + 1] of nodes that begin a step, what was said at earlier ones, as far as it
            matters.
    """

    nodes: NDArray[np.void]
    edges: NDArray[np.void]
    beliefs: NDArray[np.float64]
    table: NDArray[np.void]
    seen: NDArray[np.uint64]
    likelihoods: NDArray[np.float64]
    zero: NDArray[np.bool_]
    rollout_belief: NDArray[np.float64]
    rows: NDArray[np.int64]
    gain: NDArray[np.float64]
    path: NDArray[np.int64]
    paid: NDArray[np.float64]
    used: NDArray[np.int64]
    counter: NDArray[np.uint64]
    inquired: NDArray[np.int32]
    asked: NDArray[np.bool_]
    room: Room
    before: NDArray[np.int64]

    @classmethod
    def rooted(
        cls,
        simulations: int,
        n_messages: int,
        n_steps: int,
        start: SearchRoot,
        seed: int,
        room: Room = NO_ROOM,
    ) -> Tree:
        """A tree of one node. Memory that no simulation reaches is never touched. ``room`` knows
        the questions asked before."""
        types = len(start.belief)
        slots, questions = len(room.found), len(room.asked)
        size, actions = simulations + 1, n_messages + 1 + slots
        length = (n_messages + 1) * n_steps + 1 + questions
        remembered = min(_table_size(simulations), REMEMBERED)
        tree = cls(
            _in_lines(size, NODE),
            np.empty((size + 1) * actions, EDGE),
            np.empty((size, types)),
            np.zeros(_table_size(simulations), ENTRY),
            np.zeros(remembered, np.uint64),
            np.empty((remembered, types)),
            np.empty(n_steps, np.bool_),
            np.empty(types),
            np.empty(types, np.int64),
            np.zeros(n_messages),
            np.empty((3, length), np.int64),
            np.empty(length),
            np.array([1, actions, FIRST_TABLE - 1]),
            np.array([seed], np.uint64),
            np.empty((size if slots else 1, slots + 2), np.int32),
            room.asked.copy(),
            room,
            np.empty(size, np.int64),
        )
        tree.before[0] = start.before
        tree.inquired[0, -2:] = 0 if start.may_ask else CLOSED, -1
        tree.nodes[0] = (0, np.nan, 0.0, 0.0, 0, 0, 0, start.step, 0, start.given, 0)
        tree.beliefs[0] = start.belief
        return tree

    def root_edges(self) -> NDArray[np.void]:
        """The edges of the root, [n + 1 + B]: one a message, *explain*, one a question."""
        root, actions = self.nodes[0], len(self.edges) // (len(self.nodes) + 1)
        edges = np.array([(-np.inf, 0, 0)] * actions, EDGE)
        asking = max(int(self.inquired[0, -2]), 0) if len(self.room.found) else 0
        within = actions - len(self.room.found) + asking
        available = [a for a in range(within) if not int(root["given"]) >> a & 1]
        edges[available] = self.edges[root["edges"] : root["edges"] + len(available)]
        return edges


def slots_for(problem: Problem) -> int:
    """How many questions a search tries at a belief: no more than a mask has room for."""
    questions = len(problem.questions) if problem.questions else 0
    return min(INQUIRED, questions, 61 - problem.n_messages)


@lru_cache(maxsize=4)
def make_roots(size: int) -> Roots:
    """sqrt(log v) and 1 / sqrt(v) for v = 0 … size (0 for 0), once a size."""
    v = np.maximum(np.arange(size + 1), 1)
    inverse = 1 / np.sqrt(v)
    inverse[0] = 0.0
    return np.sqrt(np.log(v)), inverse


def _table_size(simulations: int) -> int:
    return max(FIRST_TABLE, 1 << (2 * simulations + 2).bit_length())


def _in_lines(size: int, kind: np.dtype[np.void]) -> NDArray[np.void]:
    """An empty array that begins with a cache line (64 bytes), as each of its nodes then does."""
    room = np.empty(size * kind.itemsize + 64, np.uint8)
    start = -room.ctypes.data % 64
    return room[start : start + size * kind.itemsize].view(kind)


def tree_bytes(problem: Problem, simulations: int) -> int:
    """The most that a tree takes."""
    slots = slots_for(problem)
    node = (
        NODE.itemsize
        + 8 * (problem.start.size + 1)
        + EDGE.itemsize * (problem.n_messages + 1 + slots)
        + (4 * (slots + 2) if slots else 0)
    )
    table = _table_size(simulations)
    remembered = min(table, REMEMBERED) * 8 * (problem.start.size + 1)
    return (simulations + 2) * node + ENTRY.itemsize * table + remembered
