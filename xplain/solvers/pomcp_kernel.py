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

CERTAIN = 1 - 1e-6

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
def _draw_labels(count, given, t, p, weight, counter, zero):  # type: ignore[no-untyped-def]
    """Draws ``count`` informative labels of a user of type t: their code, and the counter."""
    code = uint64(0)
    word = uint64(0)
    for i in range(count):
        if i % 3 == 0:
            counter += GOLDEN
            word = mix(counter)
        zero[i] = (np.float64(word & LANE) + 0.5) * SCALE > p[given, i, t]
        word >>= uint64(21)
        code += weight[given, i] if zero[i] else uint64(0)
    return code, counter


@njit(forceinline=True)
def _update(count, given, p, zero, belief, posterior):  # type: ignore[no-untyped-def]
    """posterior ∝ belief × likelihood of the drawn labels. The two may be one array."""
    total = 0.0
    for t in range(len(belief)):
        likelihood = belief[t]
        for i in range(count):
            likelihood *= 1.0 - p[given, i, t] if zero[i] else p[given, i, t]
        posterior[t] = likelihood
        total += likelihood
    for t in range(len(belief)):
        posterior[t] /= total


@njit(forceinline=True)
def _qmdp(optimal, explain_cost, price, discounts, step, given, belief):  # type: ignore[no-untyped-def]
    """max_a Σ_t b(t) Q_t(k, H, a), and the action (n is *explain*)."""
    best, bound = 0.0, 0.0
    for t in range(len(belief)):
        later = discounts[0] * optimal[step + 1, given, t]
        best += belief[t] * (later - explain_cost[given, step, t])
        bound += belief[t] * optimal[step, given, t]
    action = len(price)
    # Where *explain* is best for every type there is nothing to compare.
    if bound > best:
        for j in range(len(price)):
            if not given >> j & 1:
                more = given | 1 << j
                value = 0.0
                for t in range(len(belief)):
                    value += belief[t] * optimal[step, more, t]
                value = discounts[1] * value - price[j]
                if value > best:
                    best, action = value, j
    return best, action


@njit
def _leaf(model, reading, step, given, belief):  # type: ignore[no-untyped-def]
    if reading == MAX_OF_MEAN:
        discounts = (model.discount, model.message_discount)
        return _qmdp(
            model.optimal, model.explain_cost, model.price, discounts, step, given, belief
        )[0]
    value = 0.0
    for t in range(len(belief)):
        value += belief[t] * model.optimal[step, given, t]
    return value


@njit
def _roll_random(explain_cost, price, discounts, step, given, t, counter):  # type: ignore[no-untyped-def]
    """The return of uniformly random actions, for a user of type t."""
    n, steps = len(price), explain_cost.shape[1]
    free = ((1 << n) - 1) & ~given
    count = _count_bits(free, n)
    value, scale = 0.0, 1.0
    while step < steps:
        choice = 0
        if count > 0:
            counter += GOLDEN
            choice = _below(mix(counter), count + 1)
        if choice == count:
            value -= scale * explain_cost[given, step, t]
            scale *= discounts[0]
            step += 1
        else:
            j = _nth_bit(free, choice)
            value -= scale * price[j]
            scale *= discounts[1]
            free ^= 1 << j
            given |= 1 << j
            count -= 1
    return value, counter


@njit
def _roll_silent(explain_cost, discount, step, given, belief):  # type: ignore[no-untyped-def]
    """The expected return of saying nothing more."""
    value, scale = 0.0, 1.0
    for k in range(step, explain_cost.shape[1]):
        for t in range(len(belief)):
            value -= scale * belief[t] * explain_cost[given, k, t]
        scale *= discount
    return value


@njit
def _roll_qmdp(model, step, given, t, belief, counter, zero, now):  # type: ignore[no-untyped-def]
    """The return of following QMDP with exact beliefs (kept in ``now``), for a user of type t.
    Once t is certain, QMDP acts as if it were known, and V*_t is the rest of the return."""
    optimal, explain_cost, price = model.optimal, model.explain_cost, model.price
    informative, p, weight = model.informative, model.p, model.weight
    discounts = (model.discount, model.message_discount)
    n, steps = len(price), explain_cost.shape[1]
    now[:] = belief
    value, scale = 0.0, 1.0
    while step < steps:
        if now[t] > CERTAIN:
            return value + scale * optimal[step, given, t], counter
        _, action = _qmdp(optimal, explain_cost, price, discounts, step, given, now)
        if action < n:
            value -= scale * price[action]
            scale *= discounts[1]
            given |= 1 << action
        else:
            value -= scale * explain_cost[given, step, t]
            scale *= discounts[0]
            if step + 1 < steps:
                count = informative[given, step]
                _, counter = _draw_labels(count, given, t, p, weight, counter, zero)
                _update(count, given, p, zero, now, now)
            step += 1
    return value, counter


@njit
def _roll(model, rollout, step, given, t, belief, counter, zero, now):  # type: ignore[no-untyped-def]
    if rollout == RANDOM:
        discounts = (model.discount, model.message_discount)
        return _roll_random(model.explain_cost, model.price, discounts, step, given, t, counter)
    if rollout == SILENT:
        return _roll_silent(model.explain_cost, model.discount, step, given, belief), counter
    return _roll_qmdp(model, step, given, t, belief, counter, zero, now)


@njit(forceinline=True)
def _find(nodes, table, parent, code):  # type: ignore[no-untyped-def]
    """Where the table holds this child, or has room for it."""
    mask = len(table) - 1
    slot = np.int64(mix(code + uint64(parent) * GOLDEN) & uint64(mask))
    while True:
        node = table[slot]
        if node == 0 or (nodes[node].parent == parent and nodes[node].code == code):
            return slot
        slot = (slot + 1) & mask


@njit
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


@njit
def _open(model, tree, node):  # type: ignore[no-untyped-def]
    """Gives a node its edges: one a message, the last for *explain*."""
    n = len(model.price)
    record = tree.nodes[node]
    record.edges = tree.used[1]
    tree.used[1] += n + 1
    record.untried = ((1 << (n + 1)) - 1) & ~record.given
    record.reward = 0.0
    for t in range(tree.beliefs.shape[1]):
        cost = model.explain_cost[record.given, record.step, t]
        record.reward -= tree.beliefs[record.base, t] * cost
    for a in range(n + 1):
        edge = tree.edges[record.edges + a]
        edge.value = -np.inf
        edge.width = 0.0
        edge.visits = 0
        edge.child = 0


@njit(cache=True, nogil=True)
def simulate(simulations, model, options, tree, log_root):  # type: ignore[no-untyped-def]
    """Runs simulations from node 0, whose belief is set. ``log_root[v]`` is sqrt(log v).

    The inner loops are written out, and arrays taken from their tuples once: numba counts
    references wherever an array is passed on or sliced, which cost more than the search itself.
    """
    nodes, edges, beliefs, table = tree.nodes, tree.edges, tree.beliefs, tree.table
    informative, p, weight, price = model.informative, model.p, model.weight, model.price
    discount, message_discount = model.discount, model.message_discount
    depth_limit, message_depth = options.depth, options.message_depth
    exploration, to_max = options.exploration, options.backup == MAX
    n, steps, types = len(price), informative.shape[1], beliefs.shape[1]
    counter = tree.counter[0]
    zero = np.zeros(steps, np.bool_)
    now = np.empty(types)
    path_node = np.empty(n + steps + 1, np.int64)
    path_action = np.empty(n + steps + 1, np.int64)
    last_type = 0
    for t in range(types):
        if beliefs[0, t] > 0:
            last_type = t
    for _ in range(simulations):
        # The type; the last with positive belief takes what rounding leaves of the sum.
        counter += GOLDEN
        u = np.float64(mix(counter) >> uint64(11)) * 2.0**-53
        t = 0
        while t < last_type and u >= beliefs[0, t]:
            u -= beliefs[0, t]
            t += 1
        # Down the tree.
        node, depth, length, tail = np.int64(0), 0, 0, 0.0
        while True:
            record = nodes[node]
            step, given, base = np.int64(record.step), np.int64(record.given), record.base
            if depth >= depth_limit:
                if np.isnan(record.leaf):
                    record.leaf = _leaf(model, options.leaf, step, given, beliefs[base])
                tail = record.leaf
                break
            if record.edges == 0:
                _open(model, tree, node)
            first, untried = record.edges, np.int64(record.untried)
            action = 0
            if untried != 0:  # actions not yet tried come first, in random order
                counter += GOLDEN
                choice = _below(mix(counter), _count_bits(untried, n + 1))
                action = _nth_bit(untried, choice)
                record.untried = untried & ~(1 << action)
            else:  # UCB1
                bonus, best = log_root[record.visits], -np.inf
                for a in range(n + 1):
                    score = edges[first + a].value + bonus * edges[first + a].width
                    if score > best:
                        best, action = score, a
            path_node[length], path_action[length] = node, action
            length += 1
            is_new = False
            if action < n:
                given |= 1 << action
                depth += message_depth
                node = np.int64(edges[first + action].child)
                if node == 0:
                    slot = _find(nodes, table, ~base, uint64(given))
                    node = np.int64(table[slot])
                    is_new = node == 0
                    if is_new:
                        node = _add(tree, slot, ~base, uint64(given), step, given, base)
                    edges[first + action].child = node
            elif step + 1 == steps:
                node = np.int64(-1)
                break
            else:
                depth += 1
                count = informative[given, step]
                code, counter = _draw_labels(count, given, t, p, weight, counter, zero)
                slot = _find(nodes, table, node, code)
                child = np.int64(table[slot])
                is_new = child == 0
                if is_new:
                    child = _add(tree, slot, node, code, step + 1, given, -1)
                    _update(count, given, p, zero, beliefs[base], beliefs[child])
                    base = child
                node, step = child, step + 1
            if is_new:
                tail, counter = _roll(
                    model, options.rollout, step, given, t, beliefs[base], counter, zero, now
                )
                break
        # Back up. With MAX a node is worth its best action, and *explain* the mean of what its
        # observations are worth now: ``moved`` corrects what earlier arrivals counted as.
        moved = 0.0
        if node >= 0:
            record = nodes[node]
            moved = record.visits * (tail - record.value)
            record.value = tail
            record.visits += 1
        for i in range(length - 1, -1, -1):
            record, action = nodes[path_node[i]], path_action[i]
            edge = edges[record.edges + action]
            edge.visits += 1
            before = edge.value
            if action < n:
                tail = message_discount * tail - price[action]
            else:
                tail = record.reward + discount * tail
            if edge.visits == 1 or (to_max and action < n):
                edge.value = tail
            elif to_max:
                edge.value += (tail - before + discount * moved) / edge.visits
            else:
                edge.value += (tail - before) / edge.visits
            edge.width = exploration / np.sqrt(np.float64(edge.visits))
            if to_max:
                # A node visited once so far holds a rollout's return, not its best action's.
                if record.visits > 1 and before < record.value:
                    tail = max(record.value, edge.value)
                else:
                    tail = edge.value
                    for a in range(n + 1):
                        tail = max(tail, edges[record.edges + a].value)
                moved = record.visits * (tail - record.value)
                record.value = tail
            record.visits += 1
    tree.counter[0] = counter
