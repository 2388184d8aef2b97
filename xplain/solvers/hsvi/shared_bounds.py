"""What beliefs at one (k, H) tell each other in :mod:`xplain.solvers.hsvi.search`.

The value of a policy is linear in the belief, so its values for each type (an alpha vector) bound
every belief's optimum from below; and the optimum is convex, so an upper bound at one belief bounds
the others from above (the sawtooth; Hauskrecht 2000). The latest few of both are kept for each
(k, H), and the sets of messages that no plan dominates.
"""

from __future__ import annotations

from xplain.numba_kernels import inlined, shared_kernel
from xplain.solvers.count_lattice import copy
from xplain.solvers.hsvi.tree import CANDIDATES, KEPT, SHARED, WORK
from xplain.solvers.model import expected

IRRELEVANT = -1e30
"""In an alpha vector, the value for a type that cannot be at its node."""
ROUNDING = 1e-14
"""Differences below this are rounding."""
HAIR = 1e-12
"""Relative to 1 + its size, what rounding may change a value by."""


@inlined
def tighten_by_shared(optimal, store, index):  # type: ignore[no-untyped-def]
    """Tightens a node's bounds by what was published at its (k, H). ``optimal``: V*."""
    node, belief = store.nodes[index], store.belief[index]
    row = store.places[node.step, node.given].shared
    if row < 0:
        return
    for i in range(min(store.shared_count[row, 0], KEPT)):
        if not _asked_alike(store, index, store.shared_node[row, i, 0]):
            continue
        value = min(expected(belief, store.shared_alpha[row, i]), node.upper)
        if value > node.lower:
            messages, begin = store.shared_messages[row, i], node.first_action
            if begin < 0 or credit(store.actions, begin, begin + node.n_actions, messages, value):
                node.lower, node.earned_by = value, messages
                copy(store.shared_alpha[row, i], store.alpha[index])
    known = optimal[node.step, node.given]
    for i in range(min(store.shared_count[row, 1], KEPT)):
        if not _asked_alike(store, index, store.shared_node[row, i, 1]):
            continue
        other = store.shared_belief[row, i]
        share = 1.0
        for t in range(len(belief)):
            if other[t] > 0.0:
                share = min(share, belief[t] / other[t])
        if share > 0.0:
            value = share * store.shared_upper[row, i]
            for t in range(len(belief)):
                value += (belief[t] - share * other[t]) * known[t]
            node.upper = min(node.upper, max(value, node.lower))


@inlined
def credit(actions, begin, end, messages, value):  # type: ignore[no-untyped-def]
    """Raises the lower bound of one of a node's actions to what it is known to earn: the policy
    takes the best one. False where it is none of them."""
    for a in range(begin, end):
        if actions[a].messages == messages:
            actions[a].upper = max(actions[a].upper, value)  # below it by rounding alone
            actions[a].lower = max(actions[a].lower, value)
            return True
    return False


@inlined
def below(upper, lower):  # type: ignore[no-untyped-def]
    """Whether an upper bound is below a lower one by more than rounding."""
    return upper < lower - HAIR * (1.0 + abs(lower))


@shared_kernel
def publish(tables, store, index, upper, lower, least):  # type: ignore[no-untyped-def]
    """Keeps a node's bounds for the others at its (k, H), where they are better than ``upper`` and
    ``lower`` by ``least``."""
    node = store.nodes[index]
    row = store.places[node.step, node.given].shared
    if node.upper < upper - least:
        i = store.shared_count[row, 1] % KEPT
        copy(store.belief[index], store.shared_belief[row, i])
        store.shared_upper[row, i] = node.upper
        store.shared_node[row, i, 1] = index
        store.shared_count[row, 1] += 1
    if node.lower > lower + least:
        best = node.first_action
        for a in range(best, best + node.n_actions):
            if store.actions[a].lower > store.actions[best].lower:
                best = a
        if store.actions[best].first_answer < 0:
            return
        _make_alpha(tables, store, index, best)
        i = store.shared_count[row, 0] % KEPT
        copy(store.alpha[index], store.shared_alpha[row, i])
        store.shared_messages[row, i] = store.actions[best].messages
        store.shared_node[row, i, 0] = index
        store.shared_count[row, 0] += 1


@inlined
def _asked_alike(store, index, other):  # type: ignore[no-untyped-def]
    """Whether the same questions were asked on the way to two nodes: what is left to be asked is
    part of what a node is worth."""
    for w in range(store.belief.shape[1], store.evidence.shape[1]):
        if store.evidence[index, w] != store.evidence[other, w]:
            return False
    return True


@inlined
def _make_alpha(tables, store, index, a):  # type: ignore[no-untyped-def]
    """A node's alpha vector: the value, for each type, of taking an expanded action and then what
    the answers' nodes' alpha vectors stand for."""
    node, belief, alpha = store.nodes[index], store.belief[index], store.alpha[index]
    action = store.actions[a]
    copy(store.tail_alpha[a], alpha)
    for o in range(action.first_answer, action.first_answer + action.n_answers):
        answer = store.answers[o]
        for t in range(len(belief)):
            if store.belief[answer.node, t] > 0.0:
                weight = answer.weight * store.belief[answer.node, t]
                alpha[t] += weight * store.alpha[answer.node, t]
    for t in range(len(belief)):
        if belief[t] > 0.0:
            alpha[t] = alpha[t] / belief[t] + _reward(tables, node, action.messages, t)
        else:
            alpha[t] = IRRELEVANT
    store.used[WORK] += action.n_answers


@inlined
def _reward(tables, node, messages, t):  # type: ignore[no-untyped-def]
    """What an action brings at once, of type t."""
    if messages < 0:
        return -tables.model.inquiry.cost
    shown = node.given | messages
    later = tables.model.discount * tables.optimal[node.step + 1, shown, t]
    now = tables.explain[node.step, shown, t] - later
    return tables.sets.discount[messages] * now - tables.sets.price[messages]


@inlined
def list_candidates(tables, store, step, given):  # type: ignore[no-untyped-def]
    """The sets of messages that may be optimal at (k, H) for some belief: all but those whose
    upper bound lies below the value of one and the same plan for every type. False where the store
    is full."""
    sets = len(tables.sets.price)
    begin = store.used[CANDIDATES]
    row = store.used[SHARED]
    if begin + sets > len(store.candidates) or row == len(store.shared_count):
        return False
    plans = tables.plans[step, given]
    free = (sets - 1) & ~given
    end = begin
    chosen = 0
    while True:
        explain = tables.explain[step, given | chosen]
        if not _dominated(explain, tables.sets.discount[chosen], tables.sets.price[chosen], plans):
            store.candidates[end] = chosen
            end += 1
        chosen = (chosen - free) & free
        if chosen == 0:
            break
    place = store.places[step, given]
    place.first_candidate = begin
    place.n_candidates = end - begin
    place.shared = row
    store.used[SHARED] += 1
    store.used[CANDIDATES] = end
    store.used[WORK] += sets * len(explain)
    return True


@inlined
def _dominated(explain, discount, price, plans):  # type: ignore[no-untyped-def]
    """Whether some plan is worth more than a set of messages to one type, and to none less."""
    for u in range(len(plans)):
        below, strictly = True, False
        for t in range(len(explain)):
            value = discount * explain[t] - price
            if value > plans[u, t]:
                below = False
                break
            if value < plans[u, t] - ROUNDING:
                strictly = True
        if below and strictly:
            return True
    return False
