"""HSVI (Smith & Simmons 2004): certified bounds of the optimum, tightened until they meet, on a
finite lattice as AO* does.

A node is a belief at (k, H). Between two *explains* nothing is learned, so a decision is one
choice of a message set, the cheapest messages first, then *explain*; its answers lead to nodes at
k + 1. Every node carries an upper and a lower bound of its optimal value:

- above, QMDP: Σ_t b(t) V*_t, at a visited node the best set's Σ_t b(t) Q*_t. (The fast informed
  bound is the same here: with a type that never changes it has nothing to add.) Long searches
  have a tighter one: :mod:`xplain.solvers.hsvi.pair_bounds`.
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
from xplain.solvers.count_lattice import branch, copy
from xplain.solvers.hsvi.pair_bounds import NO_SWEEP, SWEEPS, mix, mixed
from xplain.solvers.hsvi.shared_bounds import ROUNDING, list_candidates, publish, tighten_by_shared
from xplain.solvers.hsvi.tree import (
    ACTIONS,
    ANSWERS,
    HASHED,
    NODES,
    NONE,
    OPENED,
    ROOT,
    WORK,
    find,
    rehash,
)
from xplain.solvers.model import expected

DONE, WORKING, FULL = 0, 1, 2
"""How a call of :func:`sample` ends."""
CLOSED, NO_ROOM = -1, -2
"""Instead of an action: the gap is small enough, the store is full."""
TAIL = 0.6
"""Share of the gap that may come from answers not told apart."""
NEWS = 0.01
"""Share of the gap by which a bound must improve to be published."""


class Start(NamedTuple):
    """Where a search starts: k, H, and a belief [N]."""

    step: int
    given: int
    belief: NDArray[np.float64]


class Limits(NamedTuple):
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
        nodes: [m] visited.
        gaps: [m] of these nodes, before.
        actions: [m] taken; CLOSED or NO_ROOM at the last.
    """

    nodes: NDArray[np.int64]
    gaps: NDArray[np.float64]
    actions: NDArray[np.int64]


def make_path(steps: int) -> Path:
    """Room for a trial."""
    return Path(np.empty(steps, np.int64), np.empty(steps), np.empty(steps, np.int64))


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
        slot = find(store, start.step, start.given, answers.evidence[0])
        _make_node(tables, store, slot, start.step, start.given, answers, ROOT)
        return WORKING
    stop = store.used[WORK] + limits.work
    root = store.nodes[ROOT]
    while root.first_action < 0 or (_gap(root) > limits.gap and store.used[OPENED] < limits.opened):
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
        path.nodes[level], path.gaps[level] = index, _gap(store.nodes[index])
        a = _settle(tables, store, index, allowed, limits.tail_gap, answers)
        path.actions[level] = a
        if a < 0:
            return level
        action = store.actions[a]
        # What the answers may leave open: all that the tail does not.
        allowed -= action.tail_upper - action.tail_lower
        allowed /= tables.sets.discount[action.messages] * tables.model.discount
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
            _back_up(store.used, store.nodes, store.actions, store.answers, index, a)
            # What others at its (k, H) published may hide that a node's action has moved.
            moved = moved or store.actions[a].upper < action_upper
            if node.upper < upper - least or node.lower > lower + least:
                publish(tables, store, index, upper, lower, least)
        moved = moved or _gap(node) < path.gaps[level]
    return moved


@inlined
def _settle(tables, store, index, allowed, tail_gap, answers):  # type: ignore[no-untyped-def]
    """Opens a node, and expands its best action until one that is expanded is the best.

    Returns:
        That action; CLOSED where the gap is small enough, NO_ROOM where the store is full.
    """
    node = store.nodes[index]
    if node.first_action < 0 and not _open(tables, store, index):
        return NO_ROOM
    tighten_by_shared(tables.optimal, store, index)
    while _gap(node) > allowed + ROUNDING and node.step < len(tables.explain) - 1:
        a = _best_action(store, index)
        if store.actions[a].first_answer >= 0:
            return a
        if not _expand(tables, store, index, a, tail_gap, answers):
            return NO_ROOM
        _back_up(store.used, store.nodes, store.actions, store.answers, index, a)
    return CLOSED


@inlined
def _gap(node):  # type: ignore[no-untyped-def]
    return node.upper - node.lower


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
        excess = answer.weight * (_gap(store.nodes[answer.node]) - allowed)
        if excess > worst:
            worst, widest = excess, answer.node
    store.used[WORK] += action.n_answers
    return widest


@inlined
def _make_node(tables, store, slot, step, given, answers, o):  # type: ignore[no-untyped-def]
    """Makes the node of an answer, with its first bounds, and enters it into the hash table.
    False where the store is full."""
    index = store.used[NODES]
    if index == len(store.nodes):
        return False
    store.used[NODES] += 1
    store.used[HASHED] += 1
    store.hash_table[slot] = index
    node, belief = store.nodes[index], store.belief[index]
    node.step, node.given, node.first_action, node.n_actions = step, given, NONE, 0
    copy(answers.evidence[o], store.evidence[index])
    total = 0.0
    for t in range(len(belief)):
        total += answers.weight[o, t]
    for t in range(len(belief)):
        belief[t] = answers.weight[o, t] / total
    upper = expected(belief, tables.explain[step, given])
    for j in range(len(tables.model.price)):
        more = given | (1 << j)
        if more != given:
            later = tables.model.message_discount * expected(belief, tables.optimal[step, more])
            upper = max(upper, later - tables.model.price[j])
    if len(tables.pairs.cell) > 0 and mix(tables.pairs, step, given, belief, NO_SWEEP):
        upper = min(upper, mixed(tables.pairs, tables.pairs.optimal[step], given))
    plans = tables.plans[step, given]
    copy(plans[_best_plan(plans, belief)], store.alpha[index])
    node.upper = upper
    node.lower = min(expected(belief, store.alpha[index]), upper)
    tighten_by_shared(tables.optimal, store, index)
    return True


@inlined
def _best_plan(plans, weight):  # type: ignore[no-untyped-def]
    """Which of ``plans`` [N + 1, N] is worth the most at a belief."""
    best, chosen = -np.inf, 0
    for u in range(len(plans)):
        value = expected(weight, plans[u])
        if value > best:
            best, chosen = value, u
    return chosen


@inlined
def _open(tables, store, index):  # type: ignore[no-untyped-def]
    """Lists the sets of messages that may be optimal at a node. False where the store is full."""
    node = store.nodes[index]
    place = store.places[node.step, node.given]
    if place.shared < 0 and not list_candidates(tables, store, node.step, node.given):
        return False
    begin = store.used[ACTIONS]
    if begin + place.n_candidates > len(store.actions):
        return False
    best, end = _list_actions(tables, store, index, begin)
    lower = node.lower
    for a in range(begin, end):
        lower = max(lower, store.actions[a].lower)
    kept = begin
    for a in range(begin, end):
        action = store.actions[a]
        if action.upper >= lower or action.upper == best:
            store.actions[kept].messages = action.messages
            store.actions[kept].base = action.base
            store.actions[kept].lower = action.lower
            store.actions[kept].upper = action.upper
            store.actions[kept].first_answer = NONE
            kept += 1
    node.first_action = begin
    node.n_actions = kept - begin
    store.used[ACTIONS] = kept
    store.used[OPENED] += 1
    store.used[WORK] += place.n_candidates
    node.upper = min(node.upper, max(best, lower))
    node.lower = min(lower, node.upper)
    return True


@inlined
def _list_actions(tables, store, index, begin):  # type: ignore[no-untyped-def]
    """Bounds all candidate sets at a node, and enters those whose upper bound reaches its lower
    one. Returns the best upper bound, and where the list ends."""
    node, belief = store.nodes[index], store.belief[index]
    step, given = node.step, node.given
    place = store.places[step, given]
    in_pairs = len(tables.pairs.cell) > 0 and mix(tables.pairs, step, given, belief, SWEEPS)
    best, end = -np.inf, begin
    for c in range(place.first_candidate, place.first_candidate + place.n_candidates):
        chosen = store.candidates[c]
        shown = given | chosen
        upper = tables.sets.discount[chosen] * expected(belief, tables.explain[step, shown])
        upper -= tables.sets.price[chosen]
        later = tables.sets.discount[chosen] * tables.model.discount
        base = upper - later * expected(belief, tables.optimal[step + 1, shown])
        if in_pairs:
            upper = min(upper, _in_pairs(tables, step, given, chosen))
        # The best is kept even where rounding puts it below the best plan.
        if upper >= node.lower or upper > best:
            action = store.actions[end]
            action.messages, action.base = chosen, base
            action.upper, action.lower = upper, upper
            if step < len(tables.explain) - 1:
                plans = tables.plans[step + 1, shown]
                value = expected(belief, plans[_best_plan(plans, belief)])
                action.lower = min(base + later * value, upper)
            end += 1
        best = max(best, upper)
    return best, end


@inlined
def _in_pairs(tables, step, given, chosen):  # type: ignore[no-untyped-def]
    """Bounds a set of messages from above, at the belief last mixed."""
    explain = mixed(tables.pairs, tables.pairs.explain[step], given | chosen)
    return tables.sets.discount[chosen] * explain - tables.sets.price[chosen]


@inlined
def _expand(tables, store, index, a, gap, answers):  # type: ignore[no-untyped-def]
    """Makes the nodes of an action's answers, but for a tail of unlikely ones that widens the
    gap by no more than ``gap``. False where the store or ``answers`` is full."""
    step, action = store.nodes[index].step, store.actions[a]
    shown = store.nodes[index].given | action.messages
    later = tables.sets.discount[action.messages] * tables.model.discount
    count = _list_answers(tables, store, index, a, gap, answers)
    begin = store.used[ANSWERS]
    if count < 0 or begin + count > len(store.answers):
        return False
    for o in range(count):
        slot = find(store, step + 1, shown, answers.evidence[o])
        known = store.hash_table[slot] >= 0
        if not known and not _make_node(tables, store, slot, step + 1, shown, answers, o):
            return False
        total = 0.0
        for t in range(len(answers.tail)):
            total += answers.weight[o, t]
        store.answers[begin + o].node = store.hash_table[slot]
        store.answers[begin + o].weight = later * total
    store.used[ANSWERS] += count
    store.used[WORK] += 4 * count
    action.first_answer, action.n_answers = begin, count
    return True


@inlined
def _list_answers(tables, store, index, a, gap, answers):  # type: ignore[no-untyped-def]
    """Lists an action's answers, and bounds the tail of those that are not; −1 where they are more
    than there is room for."""
    step, action = store.nodes[index].step, store.actions[a]
    shown = store.nodes[index].given | action.messages
    later = tables.sets.discount[action.messages] * tables.model.discount
    belief, evidence, tail = store.belief[index], store.evidence[index], answers.tail
    negligible = 0.1 * gap
    while True:
        count = branch(tables.model, step, shown, belief, evidence, negligible, answers)
        if count < 0:
            return count
        plans = tables.plans[step + 1, shown]
        plan = plans[_best_plan(plans, tail)]
        action.tail_upper = later * expected(tail, tables.optimal[step + 1, shown])
        action.tail_lower = later * expected(tail, plan)
        if action.tail_upper - action.tail_lower <= gap or negligible == 0.0:
            break
        negligible = negligible * 0.2 if negligible > 1e-18 else 0.0
    for t in range(len(tail)):
        store.tail_alpha[a, t] = later * tail[t] * plan[t]
    return count


@inlined
def _back_up(used, nodes, actions, answers, index, a):  # type: ignore[no-untyped-def]
    """Both bounds of an expanded action and its node, from its answers'. The first four are the
    store's."""
    node, action = nodes[index], actions[a]
    upper = action.base + action.tail_upper
    lower = action.base + action.tail_lower
    for o in range(action.first_answer, action.first_answer + action.n_answers):
        after = nodes[answers[o].node]
        upper += answers[o].weight * after.upper
        lower += answers[o].weight * after.lower
    used[WORK] += action.n_answers
    action.upper = min(action.upper, upper)
    action.lower = max(action.lower, min(lower, action.upper))
    best_upper, best_lower = -np.inf, node.lower
    for b in range(node.first_action, node.first_action + node.n_actions):
        best_upper = max(best_upper, actions[b].upper)
        best_lower = max(best_lower, actions[b].lower)
    # Rounding may cross them by a hair.
    node.upper = min(node.upper, max(best_upper, best_lower))
    node.lower = min(best_lower, node.upper)


@lean_kernel
def back_up_all(tables, store, order, least, new_pairs):  # type: ignore[no-untyped-def]
    """Backs up all that is open, and lets every node profit by what others at its (k, H) published
    since it was last visited: a trial visits one node a step. ``order`` is that of all nodes, the
    last step first; ``least`` as in :func:`publish`; with ``new_pairs``, upper bounds are first
    lowered to those of the pairs."""
    if new_pairs:
        for index in range(store.used[NODES]):
            _tighten_by_pairs(tables, store, index)
    for index in order:
        node = store.nodes[index]
        upper, lower = node.upper, node.lower
        tighten_by_shared(tables.optimal, store, index)
        for a in range(node.first_action, node.first_action + node.n_actions):
            if store.actions[a].first_answer >= 0:
                _back_up(store.used, store.nodes, store.actions, store.answers, index, a)
        improved = node.upper < upper - least or node.lower > lower + least
        if node.first_action >= 0 and improved:
            publish(tables, store, index, upper, lower, least)


@inlined
def _tighten_by_pairs(tables, store, index):  # type: ignore[no-untyped-def]
    """Lowers upper bounds made before there were tables of pairs."""
    node = store.nodes[index]
    sweeps = SWEEPS if node.first_action >= 0 else NO_SWEEP
    if not mix(tables.pairs, node.step, node.given, store.belief[index], sweeps):
        return
    upper = mixed(tables.pairs, tables.pairs.optimal[node.step], node.given)
    node.upper = max(min(node.upper, upper), node.lower)
    for a in range(node.first_action, node.first_action + node.n_actions):
        action = store.actions[a]
        upper = min(action.upper, _in_pairs(tables, node.step, node.given, action.messages))
        action.upper = max(upper, action.lower)
