"""Gap search: certified bounds of the optimum, tightened until they meet (after HSVI, Smith &
Simmons 2004, on a finite lattice as AO* does).

A node is a belief at (k, H). Between two *explains* nothing is learned, so a decision is one
choice of a message set, the cheapest messages first, then *explain*; its answers lead to nodes at
k + 1. Every node carries an upper and a lower bound of its optimal value:

- above, QMDP: Σ_t b(t) V*_t, at a visited node the best set's Σ_t b(t) Q*_t. (The fast informed
  bound is the same here: with a type that never changes it has nothing to add.)
- below, the exact value of the best of N + 1 plans that heed no answer: each type's optimal one,
  and silence.

What is learned at one belief serves all beliefs at its (k, H), as in point-based solvers: the value
of a policy is linear in the belief, so its values for each type (an alpha vector) bound every
belief's optimum from below; and the optimum is convex, so an upper bound at one belief bounds the
others from above (the sawtooth). The latest few of both are kept for each (k, H).

A trial walks from the root: at each node it takes the set with the best upper bound, then the
answer with the largest probability-weighted gap, until the gap is small enough there, and backs
both bounds up. Unlikely answers stay coarse, and the unlikeliest are not even told apart.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from xplain.solvers.bound_tables import Tables
from xplain.solvers.lattice import branch, hash_key

DONE, WORKING, FULL = 0, 1, 2
CLOSED, NO_ROOM = -1, -2
TAIL = 0.25
"""Share of the gap that may come from answers not told apart."""
KEPT = 32
"""Alpha vectors, and upper bounds, kept for each (k, H)."""
NEWS = 0.01
"""Share of the gap by which a bound must improve to be kept for the others."""
IRRELEVANT = -1e30
"""In an alpha vector, the value for a type that cannot be at its node."""
ROUNDING = 1e-14
"""Differences below this are rounding."""


class Store(NamedTuple):
    """Nodes, their actions (sets of messages, then *explain*), these actions' answers.

    ``used`` counts nodes, actions, answers, candidates, places, nodes opened, work done. A node
    not yet opened has ``first`` −1, and so has an action not yet expanded. A place is a (k, H)
    where a node was opened; ``listed`` [m, 2^n, 3] holds its first candidate set, their number,
    and its index; −1 before that.
    """

    used: NDArray[np.int64]
    step: NDArray[np.int64]
    given: NDArray[np.int64]
    belief: NDArray[np.float64]
    evidence: NDArray[np.int64]
    upper: NDArray[np.float64]
    lower: NDArray[np.float64]
    alpha: NDArray[np.float64]
    first: NDArray[np.int64]
    n_actions: NDArray[np.int64]
    action_set: NDArray[np.int64]
    action_upper: NDArray[np.float64]
    action_lower: NDArray[np.float64]
    action_base: NDArray[np.float64]
    action_first: NDArray[np.int64]
    action_answers: NDArray[np.int64]
    action_tail: NDArray[np.float64]
    action_tail_alpha: NDArray[np.float64]
    answer_node: NDArray[np.int64]
    answer_probability: NDArray[np.float64]
    candidates: NDArray[np.int64]
    place_count: NDArray[np.int64]
    place_alpha: NDArray[np.float64]
    place_set: NDArray[np.int64]
    place_belief: NDArray[np.float64]
    place_upper: NDArray[np.float64]
    listed: NDArray[np.int64]
    hash_table: NDArray[np.int64]


NODES, ACTIONS, ANSWERS, CANDIDATES, PLACES, OPENED, WORK = range(7)


def make_store(tables: Tables, nodes: int = 1 << 10) -> Store:
    """An empty store."""
    types, steps, sets = tables.p.shape
    actions, answers, places = max(4 * nodes, 2 * sets), 4 * nodes, 16
    return Store(
        np.zeros(7, dtype=np.int64),
        np.zeros(nodes, dtype=np.int64),
        np.zeros(nodes, dtype=np.int64),
        np.zeros((nodes, types)),
        np.zeros((nodes, types), dtype=np.int64),
        np.zeros(nodes),
        np.zeros(nodes),
        np.zeros((nodes, types)),
        np.zeros(nodes, dtype=np.int64),
        np.zeros(nodes, dtype=np.int64),
        np.zeros(actions, dtype=np.int64),
        np.zeros(actions),
        np.zeros(actions),
        np.zeros(actions),
        np.zeros(actions, dtype=np.int64),
        np.zeros(actions, dtype=np.int64),
        np.zeros((actions, 2)),
        np.zeros((actions, types)),
        np.zeros(answers, dtype=np.int64),
        np.zeros(answers),
        np.zeros(actions, dtype=np.int64),
        np.zeros((places, 2), dtype=np.int64),
        np.zeros((places, KEPT, types)),
        np.zeros((places, KEPT), dtype=np.int64),
        np.zeros((places, KEPT, types)),
        np.zeros((places, KEPT)),
        np.full((steps, sets, 3), -1, dtype=np.int64),
        np.full(4 * nodes, -1, dtype=np.int64),
    )


def grown(store: Store) -> Store:
    """The same store with twice the room for whatever has used up half of it."""
    room = {NODES: len(store.step), ACTIONS: len(store.action_set)}
    room |= {ANSWERS: len(store.answer_node), CANDIDATES: len(store.candidates)}
    room |= {PLACES: len(store.place_count)}
    short = {kind for kind, size in room.items() if 2 * store.used[kind] >= size}
    short = short or set(room)

    def bigger(name: str, array: NDArray[Any]) -> NDArray[Any]:
        kind = _KIND.get(name.split("_")[0], NODES)
        if kind not in short:
            return array
        return np.concatenate([array, np.zeros_like(array)])

    fixed = {"used": store.used, "listed": store.listed}
    arrays: dict[str, Any] = {
        n: fixed[n] if n in fixed else bigger(n, a) for n, a in store._asdict().items()
    }
    arrays["hash_table"] = np.full(4 * len(arrays["step"]), -1, dtype=np.int64)
    new = Store(**arrays)
    _rehash(new)
    return new


_KIND = {"action": ACTIONS, "answer": ANSWERS, "candidates": CANDIDATES, "place": PLACES}
"""What an array of the store is about, by the first word of its name; the rest is about nodes."""


def store_bytes(store: Store) -> int:
    """What a store takes."""
    return sum(array.nbytes for array in store)


@njit(cache=True, nogil=True)
def _rehash(store):  # type: ignore[no-untyped-def]
    for node in range(store.used[NODES]):
        slot = _find(store, store.step[node], store.given[node], store.evidence[node])
        store.hash_table[slot] = node


@njit(cache=True, nogil=True)
def _find(store, step, given, evidence):  # type: ignore[no-untyped-def]
    """The slot that holds this belief's node, or the free one where it belongs."""
    mask = np.uint64(len(store.hash_table) - 1)
    slot = hash_key(step, given, evidence) & mask
    while True:
        node = store.hash_table[slot]
        if node < 0:
            return slot
        if store.step[node] == step and store.given[node] == given:
            same = True
            for t in range(len(evidence)):
                if store.evidence[node, t] != evidence[t]:
                    same = False
                    break
            if same:
                return slot
        slot = (slot + np.uint64(1)) & mask


@njit(cache=True, nogil=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for t in range(len(a)):
        total += a[t] * b[t]
    return total


@njit(cache=True, nogil=True)
def _best_plan(plans, weight):  # type: ignore[no-untyped-def]
    """The plan that is worth the most at a belief."""
    best, chosen = -np.inf, 0
    for u in range(plans.shape[0]):
        value = _dot(weight, plans[u])
        if value > best:
            best, chosen = value, u
    return chosen


@njit(cache=True, nogil=True)
def add_node(tables, store, step, given, weight, evidence):  # type: ignore[no-untyped-def]
    """The node of a belief, made if need be; −1 where the store is full. ``weight`` may be
    unnormalised."""
    slot = _find(store, step, given, evidence)
    if store.hash_table[slot] >= 0:
        return store.hash_table[slot]
    node = store.used[NODES]
    if node == len(store.step):
        return -1
    store.used[NODES] += 1
    store.hash_table[slot] = node
    store.step[node] = step
    store.given[node] = given
    store.evidence[node] = evidence
    store.belief[node] = weight / weight.sum()
    store.first[node] = -1
    belief = store.belief[node]
    upper = _dot(belief, tables.explain[step, given])
    for j in range(len(tables.message_price)):
        more = given | (1 << j)
        if more != given:
            later = tables.message_discount * _dot(belief, tables.values[step, more])
            upper = max(upper, later - tables.message_price[j])
    store.upper[node] = upper
    plans = tables.plans[step, given]
    u = _best_plan(plans, belief)
    store.alpha[node] = plans[u]
    store.lower[node] = min(_dot(belief, plans[u]), upper)
    _learn(tables, store, node)
    return node


@njit(cache=True, nogil=True)
def _learn(tables, store, node):  # type: ignore[no-untyped-def]
    """Tightens a node's bounds by what other nodes at its (k, H) found out."""
    step, given, belief = store.step[node], store.given[node], store.belief[node]
    place = store.listed[step, given, 2]
    if place < 0:
        return
    for i in range(min(store.place_count[place, 0], KEPT)):
        value = _dot(belief, store.place_alpha[place, i])
        if value > store.lower[node]:
            store.lower[node] = min(value, store.upper[node])
            store.alpha[node] = store.place_alpha[place, i]
            # The policy takes the best action: the set that earns the bound must say so.
            for a in range(store.first[node], store.first[node] + store.n_actions[node]):
                if store.action_set[a] == store.place_set[place, i]:
                    value = min(value, store.action_upper[a])
                    store.action_lower[a] = max(store.action_lower[a], value)
    known = tables.values[step, given]
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


@njit(cache=True, nogil=True)
def _teach(tables, store, node, upper, lower, news):  # type: ignore[no-untyped-def]
    """Keeps a node's bounds for the others at its (k, H), if they are better than ``upper`` and
    ``lower`` by ``news``."""
    place = store.listed[store.step[node], store.given[node], 2]
    if store.upper[node] < upper - news:
        i = store.place_count[place, 1] % KEPT
        store.place_belief[place, i] = store.belief[node]
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
        store.place_alpha[place, i] = store.alpha[node]
        store.place_set[place, i] = store.action_set[best]
        store.place_count[place, 0] += 1


@njit(cache=True, nogil=True)
def _alpha(tables, store, node, a):  # type: ignore[no-untyped-def]
    """The value, for each type, of taking an expanded action and then what the answers' nodes'
    alpha vectors stand for."""
    step, belief, alpha = store.step[node], store.belief[node], store.alpha[node]
    chosen = store.action_set[a]
    shown = store.given[node] | chosen
    begin = store.action_first[a]
    alpha[:] = store.action_tail_alpha[a]
    for o in range(begin, begin + store.action_answers[a]):
        child = store.answer_node[o]
        for t in range(len(belief)):
            if store.belief[child, t] > 0.0:
                weight = store.answer_probability[o] * store.belief[child, t]
                alpha[t] += weight * store.alpha[child, t]
    for t in range(len(belief)):
        if belief[t] > 0.0:
            now = (
                tables.explain[step, shown, t] - tables.discount * tables.values[step + 1, shown, t]
            )
            alpha[t] = alpha[t] / belief[t] + tables.factor[chosen] * now - tables.price[chosen]
        else:
            alpha[t] = IRRELEVANT
    store.used[WORK] += store.action_answers[a]


@njit(cache=True, nogil=True)
def _list_candidates(tables, store, step, given):  # type: ignore[no-untyped-def]
    """The sets of messages that may be optimal at (k, H) for some belief: all but those whose
    upper bound lies below the value of one and the same plan for every type."""
    sets = len(tables.price)
    types = tables.p.shape[0]
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
                value = tables.factor[chosen] * explain[t] - tables.price[chosen]
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
    store.used[WORK] += sets
    return True


@njit(cache=True, nogil=True)
def _open(tables, store, node):  # type: ignore[no-untyped-def]
    """Lists the sets of messages that may be optimal at a node. False where the store is full."""
    step, given, belief = store.step[node], store.given[node], store.belief[node]
    if store.listed[step, given, 0] < 0 and not _list_candidates(tables, store, step, given):
        return False
    candidates = store.listed[step, given, 1]
    begin = store.used[ACTIONS]
    if begin + candidates > len(store.action_set):
        return False
    last = step == tables.p.shape[1] - 1
    end = begin
    best = -np.inf
    lower = store.lower[node]
    for c in range(store.listed[step, given, 0], store.listed[step, given, 0] + candidates):
        chosen = store.candidates[c]
        value = tables.factor[chosen] * _dot(belief, tables.explain[step, given | chosen])
        value -= tables.price[chosen]
        # The best is kept even where rounding puts it below the best plan.
        if value >= lower or value > best:
            store.action_set[end] = chosen
            store.action_upper[end] = value
            end += 1
        best = max(best, value)
    for a in range(begin, end):
        chosen = store.action_set[a]
        shown = given | chosen
        later = tables.factor[chosen] * tables.discount
        store.action_base[a] = store.action_upper[a] - later * _dot(
            belief, tables.values[step + 1, shown]
        )
        store.action_lower[a] = store.action_upper[a]
        if not last:
            plans = tables.plans[step + 1, shown]
            value = store.action_base[a] + later * _dot(belief, plans[_best_plan(plans, belief)])
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


@njit(cache=True, nogil=True)
def _expand(tables, store, node, a, gap, out_weight, out_evidence, tail):  # type: ignore[no-untyped-def]
    """Makes the nodes of an action's answers, but for a tail of unlikely ones that widens the
    gap by no more than ``gap``. False where the store is full."""
    step, belief = store.step[node], store.belief[node]
    shown = store.given[node] | store.action_set[a]
    later = tables.factor[store.action_set[a]] * tables.discount
    negligible = 0.1 * gap
    while True:
        answers = branch(
            tables.p,
            step,
            shown,
            belief,
            store.evidence[node],
            negligible,
            out_weight,
            out_evidence,
            tail,
        )
        if answers < 0:
            return False
        tail_upper = later * _dot(tail, tables.values[step + 1, shown])
        plan = tables.plans[step + 1, shown, _best_plan(tables.plans[step + 1, shown], tail)]
        tail_lower = later * _dot(tail, plan)
        if tail_upper - tail_lower <= gap or negligible == 0.0:
            break
        negligible = negligible * 0.2 if negligible > 1e-18 else 0.0
    begin = store.used[ANSWERS]
    if begin + answers > len(store.answer_node):
        return False
    for o in range(answers):
        child = add_node(tables, store, step + 1, shown, out_weight[o], out_evidence[o])
        if child < 0:
            return False
        store.answer_node[begin + o] = child
        store.answer_probability[begin + o] = later * out_weight[o].sum()
    store.used[ANSWERS] += answers
    store.used[WORK] += 4 * answers
    store.action_first[a] = begin
    store.action_answers[a] = answers
    store.action_tail[a, 0] = tail_upper
    store.action_tail[a, 1] = tail_lower
    store.action_tail_alpha[a] = later * tail * plan
    return True


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _best_action(store, node):  # type: ignore[no-untyped-def]
    best = store.first[node]
    for a in range(best, best + store.n_actions[node]):
        if store.action_upper[a] > store.action_upper[best]:
            best = a
    return best


@njit(cache=True, nogil=True)
def _gap(store, node):  # type: ignore[no-untyped-def]
    return store.upper[node] - store.lower[node]


@njit(cache=True, nogil=True)
def search(tables, store, root, gap, tail_gap, max_opened, work, out_weight, out_evidence):  # type: ignore[no-untyped-def]
    """Trials until the root's gap is closed, the nodes are spent, or the work is done. ``tail_gap``
    is what answers not told apart may widen an action's gap by.

    Returns:
        DONE, WORKING (call again), or FULL (grow the store or the buffers, call again).
    """
    steps = tables.p.shape[1]
    nodes = np.empty(steps, dtype=np.int64)
    gaps = np.empty(steps)
    actions = np.empty(steps, dtype=np.int64)
    tail = np.empty(tables.p.shape[0])
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
            action = _settle(tables, store, node, allowed, tail_gap, out_weight, out_evidence, tail)
            if action < 0:
                break
            actions[level] = action
            # What the answers may leave open: all that the tail does not.
            allowed -= store.action_tail[action, 0] - store.action_tail[action, 1]
            allowed /= tables.factor[store.action_set[action]] * tables.discount
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
            _teach(tables, store, nodes[d], upper, lower, NEWS * gap)
        if action == NO_ROOM:
            return FULL
        for d in range(last + 1):
            moved = moved or _gap(store, nodes[d]) < gaps[d]
        if not moved:
            return DONE  # rounding is all that is left
    return DONE


@njit(cache=True, nogil=True)
def _settle(tables, store, node, allowed, tail_gap, out_weight, out_evidence, tail):  # type: ignore[no-untyped-def]
    """Opens a node, and expands its best action until one that is expanded is the best.

    Returns:
        That action; CLOSED where the gap is small enough, NO_ROOM where the store is full.
    """
    if store.first[node] < 0 and not _open(tables, store, node):
        return NO_ROOM
    _learn(tables, store, node)
    while _gap(store, node) > allowed + ROUNDING and store.step[node] < tables.p.shape[1] - 1:
        action = _best_action(store, node)
        if store.action_first[action] >= 0:
            return action
        if not _expand(tables, store, node, action, tail_gap, out_weight, out_evidence, tail):
            return NO_ROOM
        _back_up(store, node, action)
    return CLOSED


@njit(cache=True, nogil=True)
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
