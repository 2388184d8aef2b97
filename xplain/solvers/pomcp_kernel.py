"""The compiled search of :mod:`xplain.solvers.pomcp`: one tree in flat arrays.

A node is a history that ends in a belief: k transitions shown, messages H given, exact belief b.
Its records sit in ``Tree``; children are found in one open-addressing table by (node, labels) and
by (node at which the step began, H): orders of the same messages lead to one node. What every
type answers alike is no news and is not drawn; labels with the same P[:, i, H] are exchangeable,
so an observation is known by Σ_i [l_i = 0] · w_i with one 64-bit hash w per distinct column
(different counts collide with probability 2^-64). Rewards of *explain* are exact expectations
under the node's belief, not the drawn labels: the same mean, less noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
LANE = np.uint64((1 << 21) - 1)
SCALE = 2.0**-21
"""Three label draws share one 64-bit word: 21 bits each, a bias of at most 2^-22 a label."""

MAX_OF_MEAN, MEAN_OF_MAX = 0, 1
RANDOM, QMDP, SILENT = 0, 1, 2

NODE = np.dtype(
    [
        ("code", np.uint64),  # the labels that led here, or H after a message
        ("leaf", np.float64),  # QMDP's value at the belief, NaN until asked for
        ("parent", np.int32),  # node before *explain*; ~(node where the step began) after a message
        ("step", np.int32),  # k
        ("given", np.int32),  # H
        ("base", np.int32),  # node where the step began; it holds the belief
        ("edges", np.int32),  # its first edge; 0 until visited a second time
        ("untried", np.int32),  # bitmask of actions
        ("visits", np.int32),
        ("n_available", np.int32),
    ]
)
EDGE = np.dtype(
    [
        ("value", np.float64),  # mean return
        ("reward", np.float64),
        ("width", np.float32),  # c / sqrt(visits)
        ("visits", np.int32),
        ("child", np.int32),  # after a message; 0 until known
        ("discount", np.float32),
    ]
)


class Model(NamedTuple):
    """A problem's tables, laid out for the search.

    Attributes:
        optimal: [m + 1, 2^n, N] V*_t(k, H).
        explain_cost: [2^n, m, N] C_inexp Σ_{i ≤ k} (1 − P[t, i, H]).
        informative: [2^n, m] labels among the first k + 1 that types answer differently.
        p: [2^n, N, m] P of the informative labels, in order.
        weight: [2^n, m] their w.
        price: [n] λ C_e.
        discount, message_discount: γ of *explain* and of a message.
    """

    optimal: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    informative: NDArray[np.int32]
    p: NDArray[np.float64]
    weight: NDArray[np.uint64]
    price: NDArray[np.float64]
    discount: float
    message_discount: float


class Tree(NamedTuple):
    """Room for a search of S simulations: each adds at most one node and opens at most one."""

    nodes: NDArray[np.void]
    edges: NDArray[np.void]
    beliefs: NDArray[np.float64]
    table: NDArray[np.int32]
    used: NDArray[np.int64]  # nodes, edges
    counter: NDArray[np.uint64]  # of the random stream


class Options(NamedTuple):
    """How to search; the names are those of :class:`xplain.solvers.pomcp.POMCP`."""

    depth: int
    count_messages: int
    exploration: float
    leaf: int
    rollout: int


@njit(inline="always")
def mix(x):  # type: ignore[no-untyped-def]
    """The output function of splitmix64 (Steele, Lea & Flood 2014)."""
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return x ^ (x >> uint64(31))


@njit(inline="always")
def below(word, count):  # type: ignore[no-untyped-def]
    """A number in 0 … count − 1 from a random word."""
    return np.int64(((word >> uint64(32)) * uint64(count)) >> uint64(32))


@njit(inline="always")
def nth_bit(mask, r):  # type: ignore[no-untyped-def]
    """The position of the r-th bit set in a mask, from 0."""
    for _ in range(r):
        mask &= mask - 1
    j = 0
    while not mask >> j & 1:
        j += 1
    return j


@njit(cache=True, nogil=True)
def lay_out(p, bits, inexplicability, explain_cost, informative, p_out, weight):  # type: ignore[no-untyped-def]
    """Fills the tables of ``Model`` from p [N, m, 2^n] and the same numbers as ``bits``."""
    types, steps, sets = p.shape
    for given in range(sets):
        found = 0
        for i in range(steps):
            differs = False
            code = GOLDEN
            for t in range(types):
                before = explain_cost[given, i - 1, t] if i > 0 else 0.0
                explain_cost[given, i, t] = before + inexplicability * (1.0 - p[t, i, given])
                differs |= p[t, i, given] != p[0, i, given]
                code = mix((code + GOLDEN) ^ bits[t, i, given])
            if differs:
                for t in range(types):
                    p_out[given, t, found] = p[t, i, given]
                weight[given, found] = code
                found += 1
            informative[given, i] = found


@njit
def _draw(model, step, given, t, counter, zero):  # type: ignore[no-untyped-def]
    """Draws the informative labels that a user of type t gives: their code, the counter."""
    code = uint64(0)
    word = uint64(0)
    p, weight = model.p[given, t], model.weight[given]
    for i in range(model.informative[given, step]):
        if i % 3 == 0:
            counter += GOLDEN
            word = mix(counter)
        is_zero = (np.float64(word & LANE) + 0.5) * SCALE > p[i]
        word >>= uint64(21)
        zero[i] = is_zero
        code += weight[i] if is_zero else uint64(0)
    return code, counter


@njit
def _bayes(model, step, given, zero, belief, posterior):  # type: ignore[no-untyped-def]
    """posterior ∝ belief × likelihood of the drawn labels."""
    total = 0.0
    for t in range(len(belief)):
        likelihood = belief[t]
        p = model.p[given, t]
        for i in range(model.informative[given, step]):
            likelihood *= 1.0 - p[i] if zero[i] else p[i]
        posterior[t] = likelihood
        total += likelihood
    for t in range(len(belief)):
        posterior[t] = posterior[t] / total if total > 0 else belief[t]


@njit
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


@njit
def _leaf(model, reading, step, given, belief):  # type: ignore[no-untyped-def]
    if reading == MAX_OF_MEAN:
        return _qmdp(model, step, given, belief)[0]
    value = 0.0
    for t in range(len(belief)):
        value += belief[t] * model.optimal[step, given, t]
    return value


@njit
def _roll_random(model, step, given, t, counter):  # type: ignore[no-untyped-def]
    """The return of uniformly random actions, for a user of type t."""
    n, steps = len(model.price), model.explain_cost.shape[1]
    free = ((1 << n) - 1) & ~given
    count = 0
    for j in range(n):
        count += free >> j & 1
    value, scale = 0.0, 1.0
    while step < steps:
        choice = 0
        if count > 0:
            counter += GOLDEN
            choice = below(mix(counter), count + 1)
        if choice == count:
            value -= scale * model.explain_cost[given, step, t]
            scale *= model.discount
            step += 1
        else:
            j = nth_bit(free, choice)
            value -= scale * model.price[j]
            scale *= model.message_discount
            free ^= 1 << j
            given |= 1 << j
            count -= 1
    return value, counter


@njit
def _roll_silent(model, step, given, belief):  # type: ignore[no-untyped-def]
    """The exact return of saying nothing more."""
    value, scale = 0.0, 1.0
    for k in range(step, model.explain_cost.shape[1]):
        for t in range(len(belief)):
            value -= scale * belief[t] * model.explain_cost[given, k, t]
        scale *= model.discount
    return value


@njit
def _roll_qmdp(model, step, given, t, belief, counter, zero, scratch):  # type: ignore[no-untyped-def]
    """The return of following QMDP with exact beliefs, for a user of type t."""
    n, steps = len(model.price), model.explain_cost.shape[1]
    scratch[:] = belief
    value, scale = 0.0, 1.0
    while step < steps:
        _, action = _qmdp(model, step, given, scratch)
        if action < n:
            value -= scale * model.price[action]
            scale *= model.message_discount
            given |= 1 << action
        else:
            value -= scale * model.explain_cost[given, step, t]
            scale *= model.discount
            if step + 1 < steps:
                _, counter = _draw(model, step, given, t, counter, zero)
                _bayes(model, step, given, zero, scratch, scratch)
            step += 1
    return value, counter


@njit
def _open(model, tree, node):  # type: ignore[no-untyped-def]
    """Gives a node its edges: one a message, the last for *explain*."""
    n = len(model.price)
    record = tree.nodes[node]
    first = tree.used[1]
    tree.used[1] += n + 1
    record.edges = first
    given, step = record.given, record.step
    belief = tree.beliefs[record.base]
    for a in range(n + 1):
        edge = tree.edges[first + a]
        edge.visits = 0
        edge.child = 0
        edge.width = 0.0
        if a < n and given >> a & 1:
            edge.value = -np.inf
        elif a < n:
            edge.reward = -model.price[a]
            edge.discount = model.message_discount
        else:
            cost = model.explain_cost[given, step]
            reward = 0.0
            for t in range(len(belief)):
                reward -= belief[t] * cost[t]
            edge.reward = reward
            edge.discount = model.discount
    record.untried = ((1 << (n + 1)) - 1) & ~given


@njit
def _find(tree, parent, code):  # type: ignore[no-untyped-def]
    """Where the table holds this child, or has room for it."""
    mask = len(tree.table) - 1
    slot = np.int64(mix(code + uint64(parent) * GOLDEN) & uint64(mask))
    while True:
        node = tree.table[slot]
        if node == 0 or (tree.nodes[node].parent == parent and tree.nodes[node].code == code):
            return slot
        slot = (slot + 1) & mask


@njit
def _add(tree, slot, parent, code, step, given, base):  # type: ignore[no-untyped-def]
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
    record.leaf = np.nan
    return node


@njit(cache=True, nogil=True)
def simulate(simulations, model, options, tree, log_root):  # type: ignore[no-untyped-def]
    """Runs simulations from node 0, whose belief is set. ``log_root[v]`` is sqrt(log v)."""
    n, steps = len(model.price), model.explain_cost.shape[1]
    types = tree.beliefs.shape[1]
    nodes, edges = tree.nodes, tree.edges
    counter = tree.counter[0]
    zero = np.zeros(steps, np.bool_)
    scratch = np.empty(types)
    path = np.empty(n + steps + 1, np.int64)
    path_node = np.empty(n + steps + 1, np.int64)
    root = tree.beliefs[0]
    for _ in range(simulations):
        counter += GOLDEN
        u = np.float64(mix(counter) >> uint64(11)) * 2.0**-53
        t, last = 0, 0
        for s in range(types):
            if root[s] > 0:
                last = s
        t = 0
        while t < last and u >= root[t]:
            u -= root[t]
            t += 1
        node, depth, length = 0, 0, 0
        tail = 0.0
        while True:
            record = nodes[node]
            step, given, base = np.int64(record.step), np.int64(record.given), record.base
            if depth >= options.depth:
                if np.isnan(record.leaf):
                    record.leaf = _leaf(model, options.leaf, step, given, tree.beliefs[base])
                tail = record.leaf
                break
            if record.edges == 0:
                _open(model, tree, node)
            first = np.int64(record.edges)
            untried = np.int64(record.untried)
            if untried != 0:
                count = 0
                for j in range(n + 1):
                    count += untried >> j & 1
                counter += GOLDEN
                action = nth_bit(untried, below(mix(counter), count))
                record.untried = untried & ~(1 << action)
            else:
                bonus = log_root[record.visits]
                best, action = -np.inf, 0
                for a in range(n + 1):
                    score = edges[first + a].value + bonus * edges[first + a].width
                    if score > best:
                        best, action = score, a
            path[length] = first + action
            path_node[length] = node
            length += 1
            if action < n:
                depth += options.count_messages
                more = given | 1 << action
                child = np.int64(edges[first + action].child)
                if child == 0:
                    slot = _find(tree, ~base, uint64(more))
                    child = np.int64(tree.table[slot])
                    if child == 0:
                        child = _add(tree, slot, ~base, uint64(more), step, more, base)
                        edges[first + action].child = child
                        tail, counter = _roll(
                            model,
                            options,
                            tree.beliefs[base],
                            step,
                            more,
                            t,
                            counter,
                            zero,
                            scratch,
                        )
                        break
                    edges[first + action].child = child
                node = child
            else:
                if step + 1 == steps:
                    break
                depth += 1
                code, counter = _draw(model, step, given, t, counter, zero)
                slot = _find(tree, node, code)
                child = np.int64(tree.table[slot])
                if child == 0:
                    child = _add(tree, slot, node, code, step + 1, given, -1)
                    _bayes(model, step, given, zero, tree.beliefs[base], tree.beliefs[child])
                    tail, counter = _roll(
                        model,
                        options,
                        tree.beliefs[child],
                        step + 1,
                        given,
                        t,
                        counter,
                        zero,
                        scratch,
                    )
                    break
                node = child
        for i in range(length - 1, -1, -1):
            edge = edges[path[i]]
            tail = edge.reward + edge.discount * tail
            edge.visits += 1
            edge.value += (
                (tail - edge.value) / edge.visits if edge.visits > 1 else tail - edge.value
            )
            edge.width = options.exploration / np.sqrt(np.float64(edge.visits))
            nodes[path_node[i]].visits += 1
    tree.counter[0] = counter


@njit
def _roll(model, options, belief, step, given, t, counter, zero, scratch):  # type: ignore[no-untyped-def]
    if options.rollout == RANDOM:
        return _roll_random(model, step, given, t, counter)
    if options.rollout == SILENT:
        return _roll_silent(model, step, given, belief), counter
    return _roll_qmdp(model, step, given, t, belief, counter, zero, scratch)
