"""HSVI (Smith & Simmons 2004): certified bounds of the optimum, tightened until they meet, on a
finite lattice as AO* does.

A node is a belief at (k, H). Between two *explains* nothing is learned, so a decision is one
choice of a message set, the cheapest messages first, then *explain*; its answers lead to nodes at
k + 1. Every node carries an upper and a lower bound of its optimal value:

- above, QMDP: Σ_t b(t) V*_t, at a visited node the best set's Σ_t b(t) Q*_t. (The fast informed
  bound is the same here: with a type that never changes it has nothing to add.)
- below, the exact value of the best of N + 1 plans that heed no answer: each type's optimal one,
  and silence.

What is found at one belief serves all at its (k, H): :mod:`xplain.solvers.hsvi.shared_bounds`.

A trial walks from the root: at each node it takes the set with the best upper bound, then the
answer with the largest probability-weighted gap, until the gap is small enough there, and backs
both bounds up. Unlikely answers stay coarse, and the unlikeliest are not even told apart. Now and
then everything is backed up: many nodes can then profit by what was published since.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.numba_kernels import inlined, lean_kernel
from xplain.solvers.count_lattice import copy
from xplain.solvers.hsvi.nodes import (
    back_up,
    expand,
    gap_of,
    make_node,
    open_node,
)
from xplain.solvers.hsvi.shared_bounds import ROUNDING, publish, tighten_by_shared
from xplain.solvers.hsvi.tree import ANSWERS, NODES, NONE, OPENED, ROOT, WORK, find, rehash

DONE, WORKING, FULL = 0, 1, 2
"""How a call of :func:`sample` ends."""
CLOSED, NO_ROOM = -1, -2
"""Instead of an action: the gap is small enough, the store is full."""
TAIL = 0.6
"""Share of the gap that may come from answers not told apart."""
NEWS = 0.01
"""Share of the gap by which a bound must improve to be published."""


class Start(NamedTuple):
    """Where a search starts: k, H, a belief [N], and words that tell which questions were asked."""

    step: int
    given: int
    belief: NDArray[np.float64]
    asked: NDArray[np.int64] = np.empty(0, np.int64)


class SearchLimits(NamedTuple):
    """When :func:`sample` returns.

    Attributes:
        gap: upper − lower at the root.
        tail_gap: what answers not told apart may widen an action's gap by.
        opened: nodes.
        work: between two calls.
    """

    gap: float
    tail_gap: float
    opened: int
    work: int


class Path(NamedTuple):
    """A trial, level by level.

    Attributes:
        nodes: [levels] visited.
        gaps: [levels] of these nodes, before.
        actions: [levels] taken; CLOSED or NO_ROOM at the last.
    """

    nodes: NDArray[np.int64]
    gaps: NDArray[np.float64]
    actions: NDArray[np.int64]


def make_path(levels: int) -> Path:
    """Room for a trial of so many levels."""
    return Path(np.empty(levels, np.int64), np.empty(levels), np.empty(levels, np.int64))


@lean_kernel
def sample(tables, store, start, limits, path, answers):  # type: ignore[no-untyped-def]
    """Trials until the root's gap is closed, the nodes are spent, or the work is done; the first
    call only makes the root. ``answers`` is room for those of one action, ``path`` for a trial.

    Returns:
        DONE, WORKING (call again), or FULL (grow the store and the answers, call again).
    """
    rehash(store)
    if store.used[NODES] == 0:
        copy(start.belief, answers.weight[0])
        for t in range(len(start.belief)):
            answers.evidence[0, t] = 0
        for w in range(len(start.asked)):
            answers.evidence[0, len(start.belief) + w] = start.asked[w]
        slot = find(store, start.step, start.given, answers.evidence[0])
        make_node(tables, store, slot, start.step, start.given, answers, ROOT)
        return WORKING
    stop = store.used[WORK] + limits.work
    root = store.nodes[ROOT]
    while root.first_action < 0 or (
        gap_of(root) > limits.gap and store.used[OPENED] < limits.opened
    ):
        if store.used[WORK] >= stop:
            return WORKING
        found = store.used[OPENED] + store.used[ANSWERS]
        last = _walk_down(tables, store, limits, path, answers)
        moved = _walk_up(tables, store, path, last, NEWS * limits.gap)
        if path.actions[last] == NO_ROOM:
            return FULL
        moved = moved or found != store.used[OPENED] + store.used[ANSWERS]
        if not moved:
            return DONE  # rounding is all that is left
    return DONE


@inlined
def _walk_down(tables, store, limits, path, answers):  # type: ignore[no-untyped-def]
    """A trial from the root; returns the last level visited."""
    level, index, allowed = 0, ROOT, limits.gap
    while True:
        path.nodes[level], path.gaps[level] = index, gap_of(store.nodes[index])
        a = _settle(tables, store, index, allowed, limits.tail_gap, answers)
        path.actions[level] = a
        if a < 0:
            return level
        action = store.actions[a]
        # What the answers may leave open: all that the tail does not.
        allowed -= action.tail_upper - action.tail_lower
        allowed /= action.later
        index = _widest_answer(store, a, allowed)
        if index < 0:
            return level
        level += 1


@inlined
def _walk_up(tables, store, path, last, least):  # type: ignore[no-untyped-def]
    """Backs up a trial, and publishes what improved by ``least``. Returns whether any bound
    moved."""
    moved = False
    for level in range(last, -1, -1):
        index, a = path.nodes[level], path.actions[level]
        node = store.nodes[index]
        if a >= 0:
            upper, lower, action_upper = node.upper, node.lower, store.actions[a].upper
            back_up(store.used, store.nodes, store.actions, store.answers, index, a)
            # What others at its (k, H) published may hide that a node's action has moved.
            moved = moved or store.actions[a].upper < action_upper
            if node.upper < upper - least or node.lower > lower + least:
                publish(tables, store, index, upper, lower, least)
        moved = moved or gap_of(node) < path.gaps[level]
    return moved


@inlined
def _settle(tables, store, index, allowed, tail_gap, answers):  # type: ignore[no-untyped-def]
    """Opens a node, and expands its best action until one that is expanded is the best.

    Returns:
        That action; CLOSED where the gap is small enough, NO_ROOM where the store is full.
    """
    node = store.nodes[index]
    if node.first_action < 0 and not open_node(tables, store, index):
        return NO_ROOM
    tighten_by_shared(tables.optimal, store, index)
    last = node.step == len(tables.explain) - 1
    while gap_of(node) > allowed + ROUNDING and (not last or len(tables.room.asked) > 0):
        a = _best_action(store, index)
        if store.actions[a].first_answer >= 0:
            return a
        if last and store.actions[a].messages >= 0:
            return CLOSED  # nothing comes after it
        if not expand(tables, store, index, a, tail_gap, answers):
            return NO_ROOM
        back_up(store.used, store.nodes, store.actions, store.answers, index, a)
    return CLOSED


@inlined
def _best_action(store, index):  # type: ignore[no-untyped-def]
    best = store.nodes[index].first_action
    for a in range(best, best + store.nodes[index].n_actions):
        if store.actions[a].upper > store.actions[best].upper:
            best = a
    return best


@inlined
def _widest_answer(store, a, allowed):  # type: ignore[no-untyped-def]
    """The answer whose node exceeds the allowed gap the most, by probability; NONE if none does."""
    worst, widest = ROUNDING, NONE
    action = store.actions[a]
    for o in range(action.first_answer, action.first_answer + action.n_answers):
        answer = store.answers[o]
        excess = answer.weight * (gap_of(store.nodes[answer.node]) - allowed)
        if excess > worst:
            worst, widest = excess, answer.node
    store.used[WORK] += action.n_answers
    return widest


@lean_kernel
def back_up_all(tables, store, order, least):  # type: ignore[no-untyped-def]
    """Backs up all that is open, and lets every node profit by what others at its (k, H) published
    since it was last visited: a trial visits one node a step. ``order`` is that of all nodes, the
    last step first; ``least`` as in :func:`publish`."""
    for index in order:
        node = store.nodes[index]
        upper, lower = node.upper, node.lower
        tighten_by_shared(tables.optimal, store, index)
        for a in range(node.first_action, node.first_action + node.n_actions):
            if store.actions[a].first_answer >= 0:
                back_up(store.used, store.nodes, store.actions, store.answers, index, a)
        improved = node.upper < upper - least or node.lower > lower + least
        if node.first_action >= 0 and improved:
            publish(tables, store, index, upper, lower, least)
