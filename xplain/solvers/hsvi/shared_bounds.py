"""What beliefs at one (k, H) learn from each other in :mod:`xplain.solvers.hsvi.search`.

The value of a policy is linear in the belief, so its values for each type (an alpha vector) bound
every belief's optimum from below; and the optimum is convex, so an upper bound at one belief bounds
the others from above (the sawtooth). The latest few of both are kept for each (k, H), and the sets
of messages that no plan dominates.
"""

from __future__ import annotations

from xplain.numba_kernels import inlined
from xplain.solvers.hsvi.tree import CANDIDATES, KEPT, PLACES, WORK, copy
from xplain.solvers.model import expected

IRRELEVANT = -1e30
"""In an alpha vector, the value for a type that cannot be at its node."""
ROUNDING = 1e-14
"""Differences below this are rounding."""


@inlined
def learn(tables, store, node):  # type: ignore[no-untyped-def]
    """Tightens a node's bounds by what other nodes at its (k, H) found out."""
    step, given, belief = store.step[node], store.given[node], store.belief[node]
    place = store.listed[step, given, 2]
    if place < 0:
        return
    for i in range(min(store.place_count[place, 0], KEPT)):
        value = expected(belief, store.place_alpha[place, i])
        if value > store.lower[node]:
            store.lower[node] = min(value, store.upper[node])
            copy(store.place_alpha[place, i], store.alpha[node])
            # The policy takes the best action: the set that earns the bound must say so.
            for a in range(store.first[node], store.first[node] + store.n_actions[node]):
                if store.action_set[a] == store.place_set[place, i]:
                    value = min(value, store.action_upper[a])
                    store.action_lower[a] = max(store.action_lower[a], value)
    known = tables.optimal[step, given]
    for i in range(min(store.place_count[place, 1], KEPT)):
        other = store.place_belief[place, i]
        share = 1.0
        for t in range(len(belief)):
            if other[t] > 0.0:
                share = min(share, belief[t] / other[t])
        if share > 0.0:
            value = share * store.place_upper[place, i]
            for t in range(len(belief)):
                value += (belief[t] - share * other[t]) * known[t]
            store.upper[node] = min(store.upper[node], max(value, store.lower[node]))


@inlined
def teach(tables, store, node, upper, lower, news):  # type: ignore[no-untyped-def]
    """Keeps a node's bounds for the others at its (k, H), if they are better than ``upper`` and
    ``lower`` by ``news``."""
    place = store.listed[store.step[node], store.given[node], 2]
    if store.upper[node] < upper - news:
        i = store.place_count[place, 1] % KEPT
        copy(store.belief[node], store.place_belief[place, i])
        store.place_upper[place, i] = store.upper[node]
        store.place_count[place, 1] += 1
    if store.lower[node] > lower + news:
        best = store.first[node]
        for a in range(best, best + store.n_actions[node]):
            if store.action_lower[a] > store.action_lower[best]:
                best = a
        if store.action_first[best] < 0:
            return
        _alpha(tables, store, node, best)
        i = store.place_count[place, 0] % KEPT
        copy(store.alpha[node], store.place_alpha[place, i])
        store.place_set[place, i] = store.action_set[best]
        store.place_count[place, 0] += 1


@inlined
def _alpha(tables, store, node, a):  # type: ignore[no-untyped-def]
    """The value, for each type, of taking an expanded action and then what the answers' nodes'
    alpha vectors stand for."""
    step, belief, alpha = store.step[node], store.belief[node], store.alpha[node]
    chosen = store.action_set[a]
    shown = store.given[node] | chosen
    begin = store.action_first[a]
    copy(store.action_tail_alpha[a], alpha)
    for o in range(begin, begin + store.action_answers[a]):
        child = store.answer_node[o]
        for t in range(len(belief)):
            if store.belief[child, t] > 0.0:
                weight = store.answer_probability[o] * store.belief[child, t]
                alpha[t] += weight * store.alpha[child, t]
    for t in range(len(belief)):
        if belief[t] > 0.0:
            now = (
                tables.explain[step, shown, t]
                - tables.model.discount * tables.optimal[step + 1, shown, t]
            )
            alpha[t] = (
                alpha[t] / belief[t]
                + tables.sets.discount[chosen] * now
                - tables.sets.price[chosen]
            )
        else:
            alpha[t] = IRRELEVANT
    store.used[WORK] += store.action_answers[a]


@inlined
def list_candidates(tables, store, step, given):  # type: ignore[no-untyped-def]
    """The sets of messages that may be optimal at (k, H) for some belief: all but those whose
    upper bound lies below the value of one and the same plan for every type."""
    sets = len(tables.sets.price)
    types = tables.explain.shape[2]
    begin = store.used[CANDIDATES]
    place = store.used[PLACES]
    if begin + sets > len(store.candidates) or place == len(store.place_count):
        return False
    plans = tables.plans[step, given]
    free = (sets - 1) & ~given
    end = begin
    chosen = 0
    while True:
        explain = tables.explain[step, given | chosen]
        dominated = False
        for u in range(len(plans)):
            below, strictly = True, False
            for t in range(types):
                value = tables.sets.discount[chosen] * explain[t] - tables.sets.price[chosen]
                if value > plans[u, t]:
                    below = False
                    break
                if value < plans[u, t] - ROUNDING:
                    strictly = True
            if below and strictly:
                dominated = True
                break
        if not dominated:
            store.candidates[end] = chosen
            end += 1
        chosen = (chosen - free) & free
        if chosen == 0:
            break
    store.listed[step, given, 0] = begin
    store.listed[step, given, 1] = end - begin
    store.listed[step, given, 2] = place
    store.used[PLACES] += 1
    store.used[CANDIDATES] = end
    store.used[WORK] += sets * types
    return True
