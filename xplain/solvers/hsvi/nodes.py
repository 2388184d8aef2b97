"""A node of HSVI's search: made with its first bounds, opened, expanded, backed up.

Opening a node lists the sets of messages that may be optimal there; expanding one of these makes
the nodes of its answers; backing up takes a node's bounds from theirs. ``tables`` are
:class:`~xplain.solvers.hsvi.initial_bounds.BoundTables`, ``store`` is a
:class:`~xplain.solvers.hsvi.tree.NodeStore`, ``index`` a node's.
"""

from __future__ import annotations

import numpy as np

from xplain.numba_kernels import inlined
from xplain.solvers.bits import count_bits
from xplain.solvers.count_lattice import SCALE, branch, copy, normalise
from xplain.solvers.hsvi.shared_bounds import (
    HAIR,
    below,
    credit,
    list_candidates,
    tighten_by_shared,
)
from xplain.solvers.hsvi.tree import (
    ACTIONS,
    ANSWERS,
    HASHED,
    NODES,
    NONE,
    OPENED,
    PLAN,
    WORK,
    find,
)
from xplain.solvers.inquiry import WORD, answer_probability, open_questions
from xplain.solvers.model import expected


@inlined
def make_node(tables, store, slot, step, given, answers, o):  # type: ignore[no-untyped-def]
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
    node.asked, node.earned_by = 0, PLAN
    for w in range(len(belief), store.evidence.shape[1]):
        node.asked += count_bits(store.evidence[index, w])
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
    if len(tables.room.asked) > 0:
        told = expected(belief, tables.optimal[step, given])
        upper = max(upper, told - tables.model.inquiry.cost)
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
def open_node(tables, store, index):  # type: ignore[no-untyped-def]
    """Lists the sets of messages that may be optimal at a node. False where the store is full."""
    node = store.nodes[index]
    place = store.places[node.step, node.given]
    if place.shared < 0 and not list_candidates(tables, store, node.step, node.given):
        return False
    begin = store.used[ACTIONS]
    if begin + place.n_candidates + len(tables.room.asked) > len(store.actions):
        return False
    best, end = _list_actions(tables, store, index, begin)
    said = best
    if len(tables.room.asked) > 0:
        best, end = _list_questions(tables, store, index, best, end)
    credit(store.actions, begin, end, node.earned_by, node.lower)
    lower = node.lower
    for a in range(begin, end):
        lower = max(lower, store.actions[a].lower)
    kept = begin
    for a in range(begin, end):
        action = store.actions[a]
        # Some messages, or none, are always among them: for who may not ask any more.
        spoken = action.messages >= 0 and action.upper == said
        if not below(action.upper, lower) or action.upper == best or spoken:
            store.actions[kept] = action
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
    best, end = -np.inf, begin
    for c in range(place.first_candidate, place.first_candidate + place.n_candidates):
        chosen = store.candidates[c]
        shown = given | chosen
        upper = tables.sets.discount[chosen] * expected(belief, tables.explain[step, shown])
        upper -= tables.sets.price[chosen]
        later = tables.sets.discount[chosen] * tables.model.discount
        base = upper - later * expected(belief, tables.optimal[step + 1, shown])
        # The best is kept even where rounding puts it below the best plan.
        if not below(upper, node.lower) or upper > best:
            action = store.actions[end]
            action.messages, action.base, action.later = chosen, base, later
            action.upper, action.lower = upper, upper
            if step < len(tables.explain) - 1:
                plans = tables.plans[step + 1, shown]
                value = expected(belief, plans[_best_plan(plans, belief)])
                action.lower = min(base + later * value, upper)
            end += 1
        best = max(best, upper)
    return best, end


@inlined
def _list_questions(tables, store, index, best, end):  # type: ignore[no-untyped-def]
    """As :func:`_list_actions`, the questions: at most worth being told the type, at least the best
    plan that heeds no answer."""
    node, belief = store.nodes[index], store.belief[index]
    _recall(store, index, tables.room.asked)
    cost = tables.model.inquiry.cost
    upper = expected(belief, tables.optimal[node.step, node.given]) - cost
    upper += HAIR * (1.0 - upper)  # bounds from elsewhere may be above it by rounding
    plans = tables.plans[node.step, node.given]
    lower = min(expected(belief, plans[_best_plan(plans, belief)]) - cost, upper)
    if below(upper, node.lower):
        return best, end
    count = open_questions(tables.model.inquiry, node.step, node.given, belief, tables.room)
    earning = node.earned_by < 0
    for i in range(count):
        _enter_question(store.actions[end], tables.room.found[i], cost, upper, lower)
        earning = earning and node.earned_by != ~tables.room.found[i]
        best = max(best, upper)
        end += 1
    if earning:  # it tells nothing here, but is what the lower bound was found with
        _enter_question(store.actions[end], ~node.earned_by, cost, upper, lower)
        end += 1
    return best, end


@inlined
def _enter_question(action, q, cost, upper, lower):  # type: ignore[no-untyped-def]
    action.messages, action.base, action.later = ~q, -cost, 1.0
    action.upper, action.lower = upper, lower


@inlined
def _recall(store, index, asked):  # type: ignore[no-untyped-def]
    """Fills in which questions were asked on the way to a node."""
    types = store.belief.shape[1]
    for q in range(len(asked)):
        asked[q] = False
        if store.evidence.shape[1] > types:
            asked[q] = store.evidence[index, types + q // WORD] >> (q % WORD) & 1 == 1


@inlined
def expand(tables, store, index, a, gap, answers):  # type: ignore[no-untyped-def]
    """Makes the nodes of an action's answers, but for a tail of unlikely ones that widens the
    gap by no more than ``gap``. False where the store or ``answers`` is full."""
    step, given, action = store.nodes[index].step, store.nodes[index].given, store.actions[a]
    if action.messages < 0:
        count = _list_replies(tables, store, index, a, answers)
    else:
        step, given = step + 1, given | action.messages
        count = _list_answers(tables, store, index, a, gap, answers)
    begin = store.used[ANSWERS]
    if count < 0 or begin + count > len(store.answers):
        return False
    for o in range(count):
        slot = find(store, step, given, answers.evidence[o])
        known = store.hash_table[slot] >= 0
        if not known and not make_node(tables, store, slot, step, given, answers, o):
            return False
        total = 0.0
        for t in range(len(answers.tail)):
            total += answers.weight[o, t]
        store.answers[begin + o].node = store.hash_table[slot]
        store.answers[begin + o].weight = action.later * total
    store.used[ANSWERS] += count
    store.used[WORK] += 4 * count
    action.first_answer, action.n_answers = begin, count
    return True


@inlined
def _list_answers(tables, store, index, a, gap, answers):  # type: ignore[no-untyped-def]
    """Lists an action's answers, and bounds the tail of those that are not; −1 where they are more
    than there is room for."""
    step, action = store.nodes[index].step, store.actions[a]
    shown, later = store.nodes[index].given | action.messages, action.later
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
def _list_replies(tables, store, index, a, answers):  # type: ignore[no-untyped-def]
    """Lists the answers to a question, of which none is left out."""
    q, belief, evidence = ~store.actions[a].messages, store.belief[index], store.evidence[index]
    types, given, found = len(belief), store.nodes[index].given, 0
    store.actions[a].tail_upper, store.actions[a].tail_lower = 0.0, 0.0
    for t in range(types):
        store.tail_alpha[a, t] = 0.0
    for answer in range(2):
        weights, logs, total = answers.weights[0], answers.logs[0], 0.0
        for t in range(types):
            p = answer_probability(tables.model.inquiry, q, given, t)
            weights[t] = belief[t] * (p if answer else 1.0 - p)
            logs[t] = evidence[t]
            if weights[t] > 0.0:
                logs[t] += round((np.log(p) if answer else np.log1p(-p)) * SCALE)
            total += weights[t]
        if total > 0.0:
            copy(weights, answers.weight[found])
            copy(evidence, answers.evidence[found])
            normalise(weights, logs, answers.evidence[found])
            if len(evidence) > types:
                answers.evidence[found, types + q // WORD] |= 1 << (q % WORD)
            found += 1
    return found


@inlined
def back_up(used, nodes, actions, answers, index, a):  # type: ignore[no-untyped-def]
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


@inlined
def gap_of(node):  # type: ignore[no-untyped-def]
    """How far apart a node's bounds are."""
    return node.upper - node.lower
