"""The compiled search of :mod:`xplain.solvers.pomcp.solver`.

The arrays (``Model``, ``Tree``, ``Options``) are described in :mod:`xplain.solvers.pomcp.tree`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types, uint64
from numba.extending import intrinsic

from xplain.numba_kernels import inlined, lean_kernel

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
CERTAIN = 1 - 1e-6

MAX_OF_MEAN, MEAN_OF_MAX = 0, 1
RANDOM, QMDP, SILENT = 0, 1, 2
MEAN, MAX = 0, 1
SETTLED = -1


@intrinsic  # type: ignore[untyped-decorator]
def _first_bit(typing: Any, mask: Any) -> Any:
    """The position of the lowest bit set; undefined for 0."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def _count_bits(typing: Any, mask: Any) -> Any:
    """How many bits are set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return types.int64(types.int64), generate


@inlined
def mix(x):  # type: ignore[no-untyped-def]
    """The output function of splitmix64 (Steele, Lea & Flood 2014)."""
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@inlined
def _below(word, count):  # type: ignore[no-untyped-def]
    """A number in 0 … count − 1 from a random word."""
    return np.int64(((word >> uint64(32)) * uint64(count)) >> uint64(32))


@inlined
def _nth_bit(mask, r):  # type: ignore[no-untyped-def]
    """The position of the r-th bit set in a mask, from 0."""
    for _ in range(r):
        mask &= mask - 1
    return _first_bit(mask)


@inlined
def _uniform(word):  # type: ignore[no-untyped-def]
    """A number in [0, 1) from a random word."""
    return np.float64(word >> uint64(11)) * 2.0**-53


@inlined
def _draw_labels(likeliest, count, step, given, t, p, weight, counter, zero):  # type: ignore[no-untyped-def]
    """Draws the ``count`` informative labels of a user of type t: their code, and the counter.

    A number u decides how many labels in a row are the likelier of the two. Mostly all are, which
    is one look into a table; else ``zero`` is filled, with a new u after each unlikely label.
    """
    counter += GOLDEN
    u = _uniform(mix(counter))
    code = likeliest[given, step, t].code
    if u >= likeliest[given, step, t].probability:
        as_likely = 1.0
        for i in range(count):
            yes = p[given, i, t]
            zero[i] = yes < 0.5
            as_likely *= max(yes, 1.0 - yes)
            if u >= as_likely:
                zero[i] = not zero[i]
                code = code + weight[given, i] if zero[i] else code - weight[given, i]
                counter += GOLDEN
                u = _uniform(mix(counter))
                as_likely = 1.0
    return code, counter


@inlined
def _update(  # type: ignore[no-untyped-def]
    likeliest, count, step, given, t, p, code, zero, seen, likelihoods, belief
):
    """belief ∝ itself × likelihood of the labels just drawn, for type t. The likelihoods of labels
    met before are remembered."""
    key = mix(code + uint64(given * likeliest.shape[1] + step + 1) * GOLDEN)
    slot = np.int64(key & uint64(len(seen) - 1))
    if seen[slot] != key:
        seen[slot] = key
        usual = code == likeliest[given, step, t].code  # then nothing was written to ``zero``
        for other in range(len(belief)):
            likelihood = 1.0
            for i in range(count):
                if p[given, i, t] < 0.5 if usual else zero[i]:
                    likelihood *= 1.0 - p[given, i, other]
                else:
                    likelihood *= p[given, i, other]
            likelihoods[slot, other] = likelihood
    total = 0.0
    for other in range(len(belief)):
        belief[other] *= likelihoods[slot, other]
        total += belief[other]
    scale = 1.0 / total
    for other in range(len(belief)):
        belief[other] *= scale


@inlined
def _qmdp(optimal, explain_cost, price, wanted, discounts, step, given, belief):  # type: ignore[no-untyped-def]
    """max_a Σ_t b(t) Q_t(k, H, a), and the action (n is *explain*)."""
    best = 0.0
    for t in range(len(belief)):
        later = discounts[0] * optimal[step + 1, given, t]
        best += belief[t] * (later - explain_cost[given, step, t])
    action = len(price)
    messages = np.int64(max(wanted[given, step], 0))  # none where SETTLED
    while messages:
        j = _first_bit(messages)
        messages &= messages - 1
        value = 0.0
        for t in range(len(belief)):
            value += belief[t] * optimal[step, given | 1 << j, t]
        value = discounts[1] * value - price[j]
        if value > best:
            best, action = value, j
    return best, action


@inlined
def _leaf(model, reading, step, given, belief):  # type: ignore[no-untyped-def]
    if reading == MAX_OF_MEAN:
        discounts = (model.discount, model.message_discount)
        return _qmdp(
            model.optimal,
            model.explain_cost,
            model.price,
            model.wanted,
            discounts,
            step,
            given,
            belief,
        )[0]
    value = 0.0
    for t in range(len(belief)):
        value += belief[t] * model.optimal[step, given, t]
    return value


@inlined
def _roll_random(optimal, explain_cost, price, discounts, step, given, t, counter):  # type: ignore[no-untyped-def]
    """The return of uniformly random actions, for a user of type t. Once all messages are given
    only *explain* is left, and V*_t is the rest."""
    n, steps = len(price), explain_cost.shape[1]
    free = np.int64(((1 << n) - 1) & ~given)
    count = _count_bits(free)
    value, scale = 0.0, 1.0
    while step < steps:
        if count == 0:
            return value + scale * optimal[step, given, t], counter
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


@inlined
def _roll_silent(explain_cost, discount, step, given, belief):  # type: ignore[no-untyped-def]
    """The expected return of saying nothing more."""
    value, scale = 0.0, 1.0
    for k in range(step, explain_cost.shape[1]):
        for t in range(len(belief)):
            value -= scale * belief[t] * explain_cost[given, k, t]
        scale *= discount
    return value


@inlined
def _roll_qmdp(model, tree, step, given, t, belief, counter, zero, now):  # type: ignore[no-untyped-def]
    """The return of following QMDP with exact beliefs (kept in ``now``), for a user of type t.
    Once t is certain QMDP acts as if it were known, and where nothing is worth saying to anybody
    any more it says nothing: V*_t is the rest of the return."""
    optimal, explain_cost, price = model.optimal, model.explain_cost, model.price
    informative, p, weight = model.informative, model.p, model.weight
    likeliest, wanted = model.likeliest, model.wanted
    seen, likelihoods = tree.seen, tree.likelihoods
    discounts = (model.discount, model.message_discount)
    n, steps = len(price), explain_cost.shape[1]
    for other in range(len(belief)):
        now[other] = belief[other]
    value, scale = 0.0, 1.0
    while step < steps:
        if now[t] > CERTAIN or wanted[given, step] == SETTLED:
            return value + scale * optimal[step, given, t], counter
        action = n
        if wanted[given, step] != 0:
            _, action = _qmdp(optimal, explain_cost, price, wanted, discounts, step, given, now)
        if action < n:
            value -= scale * price[action]
            scale *= discounts[1]
            given |= 1 << action
        else:
            value -= scale * explain_cost[given, step, t]
            scale *= discounts[0]
            if step + 1 < steps:
                count = informative[given, step]
                if count > 0:
                    code, counter = _draw_labels(
                        likeliest, count, step, given, t, p, weight, counter, zero
                    )
                    _update(likeliest, count, step, given, t, p, code, zero, seen, likelihoods, now)
            step += 1
    return value, counter


@inlined
def _roll(model, tree, rollout, step, given, t, belief, counter, zero, now):  # type: ignore[no-untyped-def]
    if rollout == RANDOM:
        discounts = (model.discount, model.message_discount)
        return _roll_random(
            model.optimal, model.explain_cost, model.price, discounts, step, given, t, counter
        )
    if rollout == SILENT:
        return _roll_silent(model.explain_cost, model.discount, step, given, belief), counter
    return _roll_qmdp(model, tree, step, given, t, belief, counter, zero, now)


@inlined
def _find(nodes, table, mask, parent, code):  # type: ignore[no-untyped-def]
    """Where the table holds this child, or has room for it; and the tag it bears there, without
    which every other child on the way would have to be looked at."""
    h = mix(code + uint64(parent) * GOLDEN)
    slot, tag = np.int64(h & uint64(mask)), np.uint32(h >> uint64(32))
    while True:
        node = table[slot].node
        if node == 0:
            return slot, tag
        if table[slot].tag == tag and nodes[node].parent == parent and nodes[node].code == code:
            return slot, tag
        slot = (slot + 1) & mask


@inlined
def _double(nodes, table, used):  # type: ignore[no-untyped-def]
    """Spreads the children over twice as much of the table: a table no larger than need be stays
    in the processor's cache."""
    used[2] = 2 * used[2] + 1
    for slot in range(used[2] + 1):
        table[slot].node = 0
    for node in range(1, used[0]):
        record = nodes[node]
        slot, tag = _find(nodes, table, used[2], record.parent, record.code)
        table[slot].node = node
        table[slot].tag = tag


@inlined
def _add(tree, slot, tag, parent, code, step, given, base):  # type: ignore[no-untyped-def]
    """A node of its own; ``base`` < 0 means that it begins a step. The belief is left to set."""
    node = tree.used[0]
    tree.used[0] += 1
    tree.table[slot].node = node
    tree.table[slot].tag = tag
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


@inlined
def _open(model, tree, node):  # type: ignore[no-untyped-def]
    """Gives a node its edges: one for each message not yet given, the last for *explain*."""
    record = tree.nodes[node]
    record.edges = tree.used[1]
    record.untried = ((1 << (len(model.price) + 1)) - 1) & ~record.given
    actions = _count_bits(np.int64(record.untried))
    tree.used[1] += actions
    record.reward = 0.0
    for t in range(tree.beliefs.shape[1]):
        cost = model.explain_cost[record.given, record.step, t]
        record.reward -= tree.beliefs[record.base, t] * cost
    for a in range(actions):
        edge = tree.edges[record.edges + a]
        edge.value = -np.inf
        edge.visits = 0
        edge.child = 0


@lean_kernel
def simulate(simulations, model, options, tree, log_root, inverse_root):  # type: ignore[no-untyped-def]
    """Runs simulations from node 0, whose belief is set. ``log_root[v]`` is sqrt(log v), and
    ``inverse_root[v]`` is 1 / sqrt(v), but 0 for 0."""
    nodes, edges, beliefs = tree.nodes, tree.edges, tree.beliefs
    table, used = tree.table, tree.used
    informative, p, weight, price = model.informative, model.p, model.weight, model.price
    likeliest, seen, likelihoods = model.likeliest, tree.seen, tree.likelihoods
    discount, message_discount = model.discount, model.message_discount
    depth_limit, message_depth = options.depth, options.message_depth
    exploration, to_max = options.exploration, options.backup == MAX
    n, steps, types = len(price), informative.shape[1], beliefs.shape[1]
    counter = tree.counter[0]
    zero, now = tree.zero, tree.now
    path_node, path_edge, path_action = tree.path[0], tree.path[1], tree.path[2]
    last_type = 0
    for t in range(types):
        if beliefs[0, t] > 0:
            last_type = t
    for _ in range(simulations):
        if 2 * used[0] > used[2]:
            _double(nodes, table, used)
        # The type; the last with positive belief takes what rounding leaves of the sum.
        counter += GOLDEN
        u = _uniform(mix(counter))
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
            available = ((1 << (n + 1)) - 1) & ~given
            last = first + _count_bits(available) - 1
            if untried != 0:  # actions not yet tried come first, in random order
                counter += GOLDEN
                choice = _below(mix(counter), _count_bits(untried))
                action = _nth_bit(untried, choice)
                record.untried = untried & ~(1 << action)
                chosen = first + _count_bits(available & ((1 << action) - 1))
            else:  # UCB1
                bonus, best = exploration * log_root[record.visits], -np.inf
                # Unsigned, as numba looks at each index whether it counts from the end.
                best_edge = uint64(first)
                for e in range(uint64(first), uint64(last + 1)):
                    score = edges[e].value + bonus * inverse_root[uint64(edges[e].visits)]
                    if score > best:
                        best, best_edge = score, e
                chosen = np.int64(best_edge)
                action = n if chosen == last else _nth_bit(available, chosen - first)
            path_node[length], path_edge[length], path_action[length] = node, chosen, action
            length += 1
            is_new = False
            if action < n:
                given |= 1 << action
                depth += message_depth
                node = np.int64(edges[chosen].child)
                if node == 0:
                    slot, tag = _find(nodes, table, used[2], ~base, uint64(given))
                    node = np.int64(table[slot].node)
                    is_new = node == 0
                    if is_new:
                        node = _add(tree, slot, tag, ~base, uint64(given), step, given, base)
                    edges[chosen].child = node
            elif step + 1 == steps:
                node = np.int64(-1)
                break
            else:
                depth += 1
                count, code = informative[given, step], uint64(0)
                if count > 0:
                    code, counter = _draw_labels(
                        likeliest, count, step, given, t, p, weight, counter, zero
                    )
                # The last answer is often this one too.
                child = np.int64(edges[chosen].child)
                if child == 0 or nodes[child].code != code:
                    slot, tag = _find(nodes, table, used[2], node, code)
                    child = np.int64(table[slot].node)
                    is_new = child == 0
                    edges[chosen].child = used[0] if is_new else child
                if is_new:
                    child = _add(tree, slot, tag, node, code, step + 1, given, -1)
                    for other in range(types):
                        beliefs[child, other] = beliefs[base, other]
                    if count > 0:
                        _update(
                            likeliest,
                            count,
                            step,
                            given,
                            t,
                            p,
                            code,
                            zero,
                            seen,
                            likelihoods,
                            beliefs[child],
                        )
                    base = child
                node, step = child, step + 1
            if is_new:
                tail, counter = _roll(
                    model, tree, options.rollout, step, given, t, beliefs[base], counter, zero, now
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
            edge = edges[path_edge[i]]
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
            if to_max:
                # A node visited once so far holds a rollout's return, not its best action's.
                if record.visits > 1 and before < record.value:
                    tail = max(record.value, edge.value)
                else:
                    tail = edge.value
                    actions = n + 1 - _count_bits(np.int64(record.given))
                    for e in range(record.edges, record.edges + actions):
                        tail = max(tail, edges[e].value)
                moved = record.visits * (tail - record.value)
                record.value = tail
            record.visits += 1
    tree.counter[0] = counter
