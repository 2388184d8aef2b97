"""Gap search: certified bounds of the optimum, tightened until they meet (after HSVI, Smith &
Simmons 2004, on a finite lattice as AO* does).

A node is a belief at (k, H). Between two *explains* nothing is learned, so a decision is one
choice of a message set, the cheapest messages first, then *explain*; its answers lead to nodes at
k + 1. Every node carries an upper and a lower bound of its optimal value:

- above, QMDP: Σ_t b(t) V*_t, at a visited node the best set's Σ_t b(t) Q*_t. (The fast informed
  bound is the same here: with a type that never changes it has nothing to add.) Long searches
  have a tighter one: :mod:`xplain.solvers.hsvi.pair_bounds`.
- below, the exact value of the best of N + 1 plans that heed no answer: each type's optimal one,
  and silence.

What is learned at one belief serves all at its (k, H): :mod:`xplain.solvers.hsvi.shared_bounds`.

A trial walks from the root: at each node it takes the set with the best upper bound, then the
answer with the largest probability-weighted gap, until the gap is small enough there, and backs
both bounds up. Unlikely answers stay coarse, and the unlikeliest are not even told apart. Now and
then everything is backed up: many nodes can then profit by what was learned since their last visit.
"""

from __future__ import annotations

import numpy as np

from xplain.numba_kernels import inlined, lean_kernel
from xplain.solvers.count_lattice import branch
from xplain.solvers.hsvi.pair_bounds import SWEEPS, mix, mixed
from xplain.solvers.hsvi.shared_bounds import ROUNDING, learn, list_candidates, teach
from xplain.solvers.hsvi.tree import ACTIONS, ANSWERS, NODES, OPENED, WORK, copy, find
from xplain.solvers.model import expected

DONE, WORKING, FULL = 0, 1, 2
CLOSED, NO_ROOM = -1, -2
TAIL = 0.6
"""Share of the gap that may come from answers not told apart."""
NEWS = 0.01
"""Share of the gap by which a bound must improve to be kept for the others."""


@inlined
def _best_plan(plans, weight):  # type: ignore[no-untyped-def]
    """The plan that is worth the most at a belief."""
    best, chosen = -np.inf, 0
    for u in range(plans.shape[0]):
        value = expected(weight, plans[u])
        if value > best:
            best, chosen = value, u
    return chosen


@lean_kernel
def add_node(tables, store, step, given, weight, evidence):  # type: ignore[no-untyped-def]
    """:func:`_add_node`, to be called from outside."""
    return _add_node(tables, store, step, given, weight, evidence)


@inlined
def _add_node(tables, store, step, given, weight, evidence):  # type: ignore[no-untyped-def]
    """The node of a belief, made if need be; −1 where the store is full. ``weight`` may be
    unnormalised."""
    slot = find(store, step, given, evidence)
    if store.hash_table[slot] >= 0:
        return store.hash_table[slot]
    node = store.used[NODES]
    if node == len(store.step):
        return -1
    store.used[NODES] += 1
    store.hash_table[slot] = node
    store.step[node] = step
    store.given[node] = given
    copy(evidence, store.evidence[node])
    total = 0.0
    for t in range(len(weight)):
        total += weight[t]
    for t in range(len(weight)):
        store.belief[node, t] = weight[t] / total
    store.first[node] = -1
    belief = store.belief[node]
    upper = expected(belief, tables.explain[step, given])
    for j in range(len(tables.model.price)):
        more = given | (1 << j)
        if more != given:
            later = tables.model.message_discount * expected(belief, tables.optimal[step, more])
            upper = max(upper, later - tables.model.price[j])
    if mix(tables.pairs, step, given, belief, 0):
        upper = min(upper, mixed(tables.pairs, tables.pairs.optimal[step], given))
    store.upper[node] = upper
    plans = tables.plans[step, given]
    u = _best_plan(plans, belief)
    copy(plans[u], store.alpha[node])
    store.lower[node] = min(expected(belief, plans[u]), upper)
    learn(tables, store, node)
    return node


@inlined
def _open(tables, store, node):  # type: ignore[no-untyped-def]
    """Lists the sets of messages that may be optimal at a node. False where the store is full."""
    step, given, belief = store.step[node], store.given[node], store.belief[node]
    if store.listed[step, given, 0] < 0 and not list_candidates(tables, store, step, given):
        return False
    candidates = store.listed[step, given, 1]
    begin = store.used[ACTIONS]
    if begin + candidates > len(store.action_set):
        return False
    last = step == len(tables.explain) - 1
    end = begin
    best = -np.inf
    lower = store.lower[node]
    in_pairs = mix(tables.pairs, step, given, belief, SWEEPS)
    for c in range(store.listed[step, given, 0], store.listed[step, given, 0] + candidates):
        chosen = store.candidates[c]
        value = tables.sets.discount[chosen] * expected(
            belief, tables.explain[step, given | chosen]
        )
        value -= tables.sets.price[chosen]
        shown = given | chosen
        later = tables.sets.discount[chosen] * tables.model.discount
        base = value - later * expected(belief, tables.optimal[step + 1, shown])
        if in_pairs:
            value = min(value, _in_pairs(tables, step, given, chosen))
        # The best is kept even where rounding puts it below the best plan.
        if value >= lower or value > best:
            store.action_set[end] = chosen
            store.action_upper[end] = value
            store.action_base[end] = base
            end += 1
        best = max(best, value)
    for a in range(begin, end):
        chosen = store.action_set[a]
        shown = given | chosen
        later = tables.sets.discount[chosen] * tables.model.discount
        store.action_lower[a] = store.action_upper[a]
        if not last:
            plans = tables.plans[step + 1, shown]
            value = store.action_base[a] + later * expected(
                belief, plans[_best_plan(plans, belief)]
            )
            store.action_lower[a] = min(value, store.action_upper[a])
        lower = max(lower, store.action_lower[a])
    kept = begin
    for a in range(begin, end):
        if store.action_upper[a] >= lower or store.action_upper[a] == best:
            store.action_set[kept] = store.action_set[a]
            store.action_upper[kept] = store.action_upper[a]
            store.action_lower[kept] = store.action_lower[a]
            store.action_base[kept] = store.action_base[a]
            store.action_first[kept] = -1
            kept += 1
    store.first[node] = begin
    store.n_actions[node] = kept - begin
    store.used[ACTIONS] = kept
    store.used[OPENED] += 1
    store.used[WORK] += candidates
    store.upper[node] = min(store.upper[node], max(best, lower))
    store.lower[node] = min(lower, store.upper[node])
    return True


@inlined
def _expand(tables, store, node, a, gap, out_weight, out_evidence, tail, room):  # type: ignore[no-untyped-def]
    """Makes the nodes of an action's answers, but for a tail of unlikely ones that widens the
    gap by no more than ``gap``. False where the store is full."""
    step, belief = store.step[node], store.belief[node]
    shown = store.given[node] | store.action_set[a]
    later = tables.sets.discount[store.action_set[a]] * tables.model.discount
    negligible = 0.1 * gap
    while True:
        answers = branch(
            tables.model,
            step,
            shown,
            belief,
            store.evidence[node],
            negligible,
            out_weight,
            out_evidence,
            tail,
            room,
        )
        if answers < 0:
            return False
        tail_upper = later * expected(tail, tables.optimal[step + 1, shown])
        plan = tables.plans[step + 1, shown, _best_plan(tables.plans[step + 1, shown], tail)]
        tail_lower = later * expected(tail, plan)
        if tail_upper - tail_lower <= gap or negligible == 0.0:
            break
        negligible = negligible * 0.2 if negligible > 1e-18 else 0.0
    begin = store.used[ANSWERS]
    if begin + answers > len(store.answer_node):
        return False
    for o in range(answers):
        child = _add_node(tables, store, step + 1, shown, out_weight[o], out_evidence[o])
        if child < 0:
            return False
        store.answer_node[begin + o] = child
        total = 0.0
        for t in range(len(belief)):
            total += out_weight[o, t]
        store.answer_probability[begin + o] = later * total
    store.used[ANSWERS] += answers
    store.used[WORK] += 4 * answers
    store.action_first[a] = begin
    store.action_answers[a] = answers
    store.action_tail[a, 0] = tail_upper
    store.action_tail[a, 1] = tail_lower
    for t in range(len(belief)):
        store.action_tail_alpha[a, t] = later * tail[t] * plan[t]
    return True


@inlined
def _back_up(store, node, a):  # type: ignore[no-untyped-def]
    """Both bounds of an expanded action and its node, from its answers'."""
    upper = store.action_base[a] + store.action_tail[a, 0]
    lower = store.action_base[a] + store.action_tail[a, 1]
    begin = store.action_first[a]
    for o in range(begin, begin + store.action_answers[a]):
        child = store.answer_node[o]
        upper += store.answer_probability[o] * store.upper[child]
        lower += store.answer_probability[o] * store.lower[child]
    store.used[WORK] += store.action_answers[a]
    store.action_upper[a] = min(store.action_upper[a], upper)
    store.action_lower[a] = max(store.action_lower[a], min(lower, store.action_upper[a]))
    best_upper, best_lower = -np.inf, store.lower[node]
    for b in range(store.first[node], store.first[node] + store.n_actions[node]):
        best_upper = max(best_upper, store.action_upper[b])
        best_lower = max(best_lower, store.action_lower[b])
    # Rounding may cross them by a hair.
    store.upper[node] = min(store.upper[node], max(best_upper, best_lower))
    store.lower[node] = min(best_lower, store.upper[node])


@inlined
def _best_action(store, node):  # type: ignore[no-untyped-def]
    best = store.first[node]
    for a in range(best, best + store.n_actions[node]):
        if store.action_upper[a] > store.action_upper[best]:
            best = a
    return best


@inlined
def _gap(store, node):  # type: ignore[no-untyped-def]
    return store.upper[node] - store.lower[node]


@lean_kernel
def search(  # type: ignore[no-untyped-def]
    tables,
    store,
    root,
    gap,
    tail_gap,
    max_opened,
    work,
    out_weight,
    out_evidence,
    path,
    gaps,
    tail,
    room,
):
    """Trials until the root's gap is closed, the nodes are spent, or the work is done. ``tail_gap``
    is what answers not told apart may widen an action's gap by. The last six arguments are room
    to work in: the first two as :func:`branch` has them, [2, m], [m], [N], and its own.

    Returns:
        DONE, WORKING (call again), or FULL (grow the store or the buffers, call again).
    """
    nodes, actions = path[0], path[1]
    stop = store.used[WORK] + work
    if store.first[root] < 0 and not _open(tables, store, root):
        return FULL
    while _gap(store, root) > gap and store.used[OPENED] < max_opened:
        if store.used[WORK] >= stop:
            return WORKING
        found = store.used[OPENED], store.used[ANSWERS]
        level, node, allowed = 0, root, gap
        while True:
            nodes[level], gaps[level] = node, _gap(store, node)
            last = level
            action = _settle(
                tables, store, node, allowed, tail_gap, out_weight, out_evidence, tail, room
            )
            if action < 0:
                break
            actions[level] = action
            # What the answers may leave open: all that the tail does not.
            allowed -= store.action_tail[action, 0] - store.action_tail[action, 1]
            allowed /= tables.sets.discount[store.action_set[action]] * tables.model.discount
            node = _widest_answer(store, action, allowed)
            level += 1
            if node < 0:
                break
        moved = found != (store.used[OPENED], store.used[ANSWERS])
        for d in range(level - 1, -1, -1):
            upper, lower = store.upper[nodes[d]], store.lower[nodes[d]]
            # What others at its (k, H) taught a node may hide that its action has moved.
            action_upper = store.action_upper[actions[d]]
            _back_up(store, nodes[d], actions[d])
            moved = moved or store.action_upper[actions[d]] < action_upper
            teach(tables, store, nodes[d], upper, lower, NEWS * gap)
        if action == NO_ROOM:
            return FULL
        for d in range(last + 1):
            moved = moved or _gap(store, nodes[d]) < gaps[d]
        if not moved:
            return DONE  # rounding is all that is left
    return DONE


@lean_kernel
def sweep(tables, store, news):  # type: ignore[no-untyped-def]
    """Backs up all that is open, the last step first, and lets every node learn what others at its
    (k, H) found since it was last visited: a trial visits one node a step. ``news`` as in
    :func:`teach`."""
    for step in range(len(tables.explain) - 1, -1, -1):
        for node in range(store.used[NODES]):
            if store.step[node] != step:
                continue
            upper, lower = store.upper[node], store.lower[node]
            learn(tables, store, node)
            for a in range(store.first[node], store.first[node] + store.n_actions[node]):
                if store.action_first[a] >= 0:
                    _back_up(store, node, a)
            if store.first[node] >= 0:
                teach(tables, store, node, upper, lower, news)


@lean_kernel
def tighten(tables, store):  # type: ignore[no-untyped-def]
    """Lowers upper bounds made before there were tables of pairs."""
    for node in range(store.used[NODES]):
        step, given = store.step[node], store.given[node]
        sweeps = SWEEPS if store.first[node] >= 0 else 0
        if not mix(tables.pairs, step, given, store.belief[node], sweeps):
            continue
        upper = mixed(tables.pairs, tables.pairs.optimal[step], given)
        store.upper[node] = max(min(store.upper[node], upper), store.lower[node])
        for a in range(store.first[node], store.first[node] + store.n_actions[node]):
            upper = _in_pairs(tables, step, given, store.action_set[a])
            upper = min(store.action_upper[a], upper)
            store.action_upper[a] = max(upper, store.action_lower[a])


@inlined
def _in_pairs(tables, step, given, chosen):  # type: ignore[no-untyped-def]
    """Bounds a set of messages from above, at the belief last mixed."""
    explain = mixed(tables.pairs, tables.pairs.explain[step], given | chosen)
    return tables.sets.discount[chosen] * explain - tables.sets.price[chosen]


@inlined
def _settle(tables, store, node, allowed, tail_gap, out_weight, out_evidence, tail, room):  # type: ignore[no-untyped-def]
    """Opens a node, and expands its best action until one that is expanded is the best.

    Returns:
        That action; CLOSED where the gap is small enough, NO_ROOM where the store is full.
    """
    if store.first[node] < 0 and not _open(tables, store, node):
        return NO_ROOM
    learn(tables, store, node)
    while _gap(store, node) > allowed + ROUNDING and store.step[node] < len(tables.explain) - 1:
        action = _best_action(store, node)
        if store.action_first[action] >= 0:
            return action
        if not _expand(tables, store, node, action, tail_gap, out_weight, out_evidence, tail, room):
            return NO_ROOM
        _back_up(store, node, action)
    return CLOSED


@inlined
def _widest_answer(store, action, allowed):  # type: ignore[no-untyped-def]
    """The answer whose node exceeds the allowed gap the most, by probability; −1 if none does."""
    worst, widest = ROUNDING, -1
    begin = store.action_first[action]
    for o in range(begin, begin + store.action_answers[action]):
        child = store.answer_node[o]
        excess = store.answer_probability[o] * (_gap(store, child) - allowed)
        if excess > worst:
            worst, widest = excess, child
    store.used[WORK] += store.action_answers[action]
    return widest
