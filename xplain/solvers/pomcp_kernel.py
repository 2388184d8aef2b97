"""The compiled search of :mod:`xplain.solvers.pomcp`.

All that ``simulate`` is made of stands in this one file: numba's cache looks at no other. The
arrays (``Model``, ``Tree``, ``Options``) are described in :mod:`xplain.solvers.pomcp_tables`.
"""

from __future__ import annotations

import numpy as np
from numba import njit, uint64

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
LANE = np.uint64((1 << 21) - 1)
SCALE = 2.0**-21  # three labels share one random word: 21 bits and a bias below 2^-21 a label

MAX_OF_MEAN, MEAN_OF_MAX = 0, 1
RANDOM, QMDP, SILENT = 0, 1, 2
MEAN, MAX = 0, 1


@njit(inline="always")
def mix(x):  # type: ignore[no-untyped-def]
    """The output function of splitmix64 (Steele, Lea & Flood 2014)."""
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@njit(inline="always")
def _below(word, count):  # type: ignore[no-untyped-def]
    """A number in 0 … count − 1 from a random word."""
    return np.int64(((word >> uint64(32)) * uint64(count)) >> uint64(32))


@njit(inline="always")
def _nth_bit(mask, r):  # type: ignore[no-untyped-def]
    """The position of the r-th bit set in a mask, from 0."""
    for _ in range(r):
        mask &= mask - 1
    j = 0
    while not mask >> j & 1:
        j += 1
    return j


@njit(inline="always")
def _count_bits(mask, n):  # type: ignore[no-untyped-def]
    count = 0
    for j in range(n):
        count += mask >> j & 1
    return count


@njit(forceinline=True)
def _draw_type(belief, counter):  # type: ignore[no-untyped-def]
    """A type with positive belief, and the counter."""
    counter += GOLDEN
    u = np.float64(mix(counter) >> uint64(11)) * 2.0**-53
    drawn, total = 0, 0.0
    for t in range(len(belief)):
        # The last type with positive belief takes what rounding leaves of the sum.
        if belief[t] > 0 and (total == 0 or u >= total):
            drawn = t
        total += belief[t]
    return drawn, counter


@njit(forceinline=True)
def _draw_labels(model, step, given, t, counter, zero):  # type: ignore[no-untyped-def]
    """Draws the informative labels that a user of type t gives: their code, and the counter."""
    code = uint64(0)
    word = uint64(0)
    p, weight = model.p[given], model.weight[given]
    for i in range(model.informative[given, step]):
        if i % 3 == 0:
            counter += GOLDEN
            word = mix(counter)
        zero[i] = (np.float64(word & LANE) + 0.5) * SCALE > p[i, t]
        word >>= uint64(21)
        code += weight[i] if zero[i] else uint64(0)
    return code, counter


@njit(forceinline=True)
def _update(model, step, given, zero, belief, posterior):  # type: ignore[no-untyped-def]
    """posterior ∝ belief × likelihood of the drawn labels. The two may be one array."""
    p = model.p[given]
    posterior[:] = belief
    for i in range(model.informative[given, step]):
        for t in range(len(belief)):
            posterior[t] *= 1.0 - p[i, t] if zero[i] else p[i, t]
    total = 0.0
    for t in range(len(belief)):
        total += posterior[t]
    for t in range(len(belief)):
        posterior[t] /= total


@njit(forceinline=True)
def _qmdp(model, step, given, belief):  # type: ignore[no-untyped-def]
    """max_a Σ_t b(t) Q_t(k, H, a), and the action (n is *explain*)."""
    n = len(model.price)
    now, later = model.explain_cost[given, step], model.optimal[step + 1, given]
    best, action = 0.0, n
    for t in range(len(belief)):
        best += belief[t] * (model.discount * later[t] - now[t])
    for j in range(n):
        if not given >> j & 1:
            after = model.optimal[step, given | 1 << j]
            value = 0.0
            for t in range(len(belief)):
                value += belief[t] * after[t]
            value = model.message_discount * value - model.price[j]
            if value > best:
                best, action = value, j
    return best, action


@njit(forceinline=True)
def _leaf(model, reading, step, given, belief):  # type: ignore[no-untyped-def]
    if reading == MAX_OF_MEAN:
        return _qmdp(model, step, given, belief)[0]
    value = 0.0
    for t in range(len(belief)):
        value += belief[t] * model.optimal[step, given, t]
    return value


@njit(forceinline=True)
def _roll_random(model, step, given, t, counter):  # type: ignore[no-untyped-def]
    """The return of uniformly random actions, for a user of type t."""
    n, steps = len(model.price), model.explain_cost.shape[1]
    free = ((1 << n) - 1) & ~given
    count = _count_bits(free, n)
    value, scale = 0.0, 1.0
    while step < steps:
        choice = 0
        if count > 0:
            counter += GOLDEN
            choice = _below(mix(counter), count + 1)
        if choice == count:
            value -= scale * model.explain_cost[given, step, t]
            scale *= model.discount
            step += 1
        else:
            j = _nth_bit(free, choice)
            value -= scale * model.price[j]
            scale *= model.message_discount
            free ^= 1 << j
            given |= 1 << j
            count -= 1
    return value, counter


@njit(forceinline=True)
def _roll_silent(model, step, given, belief):  # type: ignore[no-untyped-def]
    """The expected return of saying nothing more."""
    value, scale = 0.0, 1.0
    for k in range(step, model.explain_cost.shape[1]):
        for t in range(len(belief)):
            value -= scale * belief[t] * model.explain_cost[given, k, t]
        scale *= model.discount
    return value


@njit(forceinline=True)
def _roll_qmdp(model, step, given, t, belief, counter, zero, now):  # type: ignore[no-untyped-def]
    """The return of following QMDP with exact beliefs (kept in ``now``), for a user of type t."""
    n, steps = len(model.price), model.explain_cost.shape[1]
    now[:] = belief
    value, scale = 0.0, 1.0
    while step < steps:
        _, action = _qmdp(model, step, given, now)
        if action < n:
            value -= scale * model.price[action]
            scale *= model.message_discount
            given |= 1 << action
        else:
            value -= scale * model.explain_cost[given, step, t]
            scale *= model.discount
            if step + 1 < steps:
                _, counter = _draw_labels(model, step, given, t, counter, zero)
                _update(model, step, given, zero, now, now)
            step += 1
    return value, counter


@njit(forceinline=True)
def _roll(model, rollout, step, given, t, belief, counter, zero, now):  # type: ignore[no-untyped-def]
    if rollout == RANDOM:
        return _roll_random(model, step, given, t, counter)
    if rollout == SILENT:
        return _roll_silent(model, step, given, belief), counter
    return _roll_qmdp(model, step, given, t, belief, counter, zero, now)


@njit(forceinline=True)
def _find(tree, parent, code):  # type: ignore[no-untyped-def]
    """Where the table holds this child, or has room for it."""
    mask = len(tree.table) - 1
    slot = np.int64(mix(code + uint64(parent) * GOLDEN) & uint64(mask))
    while True:
        node = tree.table[slot]
        if node == 0 or (tree.nodes[node].parent == parent and tree.nodes[node].code == code):
            return slot
        slot = (slot + 1) & mask


@njit(forceinline=True)
def _add(tree, slot, parent, code, step, given, base):  # type: ignore[no-untyped-def]
    """A node of its own; ``base`` < 0 means that it begins a step. The belief is left to set."""
    node = tree.used[0]
    tree.used[0] += 1
    tree.table[slot] = node
    record = tree.nodes[node]
    record.parent = parent
    record.code = code
    record.step = step
    record.given = given
    record.base = base if base >= 0 else node
    record.edges = 0
    record.visits = 0
    record.value = 0.0
    record.leaf = np.nan
    return node


@njit(forceinline=True)
def _open(model, tree, node):  # type: ignore[no-untyped-def]
    """Gives a node its edges: one a message, the last for *explain*."""
    n = len(model.price)
    record = tree.nodes[node]
    record.edges = tree.used[1]
    tree.used[1] += n + 1
    record.untried = ((1 << (n + 1)) - 1) & ~record.given
    record.reward = 0.0
    belief, cost = tree.beliefs[record.base], model.explain_cost[record.given, record.step]
    for t in range(len(belief)):
        record.reward -= belief[t] * cost[t]
    for a in range(n + 1):
        edge = tree.edges[record.edges + a]
        edge.value = -np.inf
        edge.width = 0.0
        edge.visits = 0
        edge.child = 0


@njit(forceinline=True)
def _select(tree, record, n, log_root, counter):  # type: ignore[no-untyped-def]
    """UCB1; actions not yet tried come first, in random order."""
    untried = np.int64(record.untried)
    if untried != 0:
        counter += GOLDEN
        action = _nth_bit(untried, _below(mix(counter), _count_bits(untried, n + 1)))
        record.untried = untried & ~(1 << action)
        return action, counter
    first, bonus = record.edges, log_root[record.visits]
    best, action = -np.inf, 0
    for a in range(n + 1):
        edge = tree.edges[first + a]
        score = edge.value + bonus * edge.width
        if score > best:
            best, action = score, a
    return action, counter


@njit(forceinline=True)
def _back_up(tree, model, options, node, tail, path_node, path_action, length):  # type: ignore[no-untyped-def]
    """Tells the nodes on the path of a return ``tail`` from ``node`` on (−1: the end).

    With MAX backups a node is worth its best action, and *explain* the mean of what its
    observations are worth now: ``moved`` corrects what earlier arrivals were counted with.
    """
    n = len(model.price)
    moved = 0.0
    if node >= 0:
        record = tree.nodes[node]
        moved = record.visits * (tail - record.value)
        record.value = tail
        record.visits += 1
    for i in range(length - 1, -1, -1):
        record, action = tree.nodes[path_node[i]], path_action[i]
        edge = tree.edges[record.edges + action]
        edge.visits += 1
        before = edge.value
        if action < n:
            tail = model.message_discount * tail - model.price[action]
        else:
            tail = record.reward + model.discount * tail
        if edge.visits == 1 or (options.backup == MAX and action < n):
            edge.value = tail
        elif options.backup == MAX:
            edge.value += (tail - before + model.discount * moved) / edge.visits
        else:
            edge.value += (tail - before) / edge.visits
        edge.width = options.exploration / np.sqrt(np.float64(edge.visits))
        if options.backup == MAX:
            # A node visited once so far holds a rollout's return, not its best action's.
            if record.visits > 1 and before < record.value:
                tail = max(record.value, edge.value)
            else:
                tail = edge.value
                for a in range(n + 1):
                    tail = max(tail, tree.edges[record.edges + a].value)
            moved = record.visits * (tail - record.value)
            record.value = tail
        record.visits += 1


@njit(cache=True, nogil=True)
def simulate(simulations, model, options, tree, log_root):  # type: ignore[no-untyped-def]
    """Runs simulations from node 0, whose belief is set. ``log_root[v]`` is sqrt(log v)."""
    n, steps = len(model.price), model.explain_cost.shape[1]
    counter = tree.counter[0]
    zero = np.zeros(steps, np.bool_)
    now = np.empty(tree.beliefs.shape[1])
    path_node = np.empty(n + steps + 1, np.int64)
    path_action = np.empty(n + steps + 1, np.int64)
    for _ in range(simulations):
        t, counter = _draw_type(tree.beliefs[0], counter)
        node, depth, length, tail = 0, 0, 0, 0.0
        while True:
            record = tree.nodes[node]
            step, given, base = np.int64(record.step), np.int64(record.given), record.base
            if depth >= options.depth:
                if np.isnan(record.leaf):
                    record.leaf = _leaf(model, options.leaf, step, given, tree.beliefs[base])
                tail = record.leaf
                break
            if record.edges == 0:
                _open(model, tree, node)
            action, counter = _select(tree, record, n, log_root, counter)
            path_node[length], path_action[length] = node, action
            length += 1
            if action < n:
                given |= 1 << action
                depth += options.message_depth
                edge = tree.edges[record.edges + action]
                if edge.child == 0:
                    slot = _find(tree, ~base, uint64(given))
                    edge.child = tree.table[slot]
                is_new = edge.child == 0
                if is_new:
                    edge.child = _add(tree, slot, ~base, uint64(given), step, given, base)
                node = np.int64(edge.child)
            elif step + 1 == steps:
                node = -1
                break
            else:
                depth += 1
                code, counter = _draw_labels(model, step, given, t, counter, zero)
                slot = _find(tree, node, code)
                child = np.int64(tree.table[slot])
                is_new = child == 0
                if is_new:
                    child = _add(tree, slot, node, code, step + 1, given, -1)
                    _update(model, step, given, zero, tree.beliefs[base], tree.beliefs[child])
                node, base, step = child, child, step + 1
            if is_new:
                belief = tree.beliefs[base]
                tail, counter = _roll(
                    model, options.rollout, step, given, t, belief, counter, zero, now
                )
                break
        _back_up(tree, model, options, node, tail, path_node, path_action, length)
    tree.counter[0] = counter
