"""The compiled search of :mod:`xplain.solvers.pomcp.solver`: select, expand, evaluate, backward.

``model`` is a :class:`~xplain.solvers.pomcp.search_model.SearchModel`, ``tree`` a
:class:`~xplain.solvers.pomcp.tree.Tree`, ``options``
the :class:`~xplain.solvers.pomcp.tree.Options`.
"""

from __future__ import annotations

import numpy as np
from numba import uint64

from xplain.numba_kernels import inlined, lean_kernel
from xplain.solvers.bits import count_bits, nth_bit
from xplain.solvers.inquiry import answer_probability, hear_answer
from xplain.solvers.pomcp.growth import (
    END,
    ROOT,
    UNOPENED,
    UNVISITED,
    add,
    find,
    grow_table,
    open_,
    questions_at,
)
from xplain.solvers.pomcp.labels import draw_labels, update_belief
from xplain.solvers.pomcp.rollout import leaf_value, roll_qmdp
from xplain.solvers.random_words import GOLDEN, next_below, next_uniform, splitmix64

MEAN, MAX = 0, 1


@lean_kernel
def simulate(simulations, model, options, tree, log_root, inverse_root):  # type: ignore[no-untyped-def]
    """Runs simulations from the root, whose belief is set. ``log_root[v]`` is sqrt(log v), and
    ``inverse_root[v]`` is 1 / sqrt(v), but 0 for 0: [a number larger than all visits]."""
    last_type = tree.beliefs.shape[1] - 1
    while tree.beliefs[ROOT, last_type] <= 0.0:
        last_type -= 1
    for _ in range(simulations):
        grow_table(tree)
        user_type = draw_type(tree, last_type)
        node, depth, length, is_new = ROOT, 0, 0, False
        while depth < options.depth and not is_new and node != END:
            if tree.nodes[node].edges == UNOPENED:
                open_(model, tree, node)
            edge, action = select(model, options, tree, node, log_root, inverse_root)
            tree.path[0, length] = node
            tree.path[1, length] = edge
            tree.path[2, length] = action
            if action < len(model.reduced.price):
                tree.paid[length] = model.reduced.price[action]
            length += 1
            if action <= len(model.reduced.price):  # a question costs no depth
                depth += 1 if action == len(model.reduced.price) else options.message_depth
            node, is_new = expand(model, tree, node, edge, action, user_type)
        value = evaluate(model, tree, node, is_new, user_type)
        backward(model, options, tree, node, length, value)


@inlined
def draw_type(tree, last_type):  # type: ignore[no-untyped-def]
    """A type from the root's belief; the last with positive belief takes what rounding leaves."""
    u = next_uniform(tree.counter)
    t = 0
    while t < last_type and u >= tree.beliefs[ROOT, t]:
        u -= tree.beliefs[ROOT, t]
        t += 1
    return t


@inlined
def select(model, options, tree, node, log_root, inverse_root):  # type: ignore[no-untyped-def]
    """The action to try at an open node, and its edge: those not yet tried come first, in random
    order, then UCB1 decides (Auer et al. 2002)."""
    record, n = tree.nodes[node], len(model.reduced.price)
    first, untried = record.edges, np.int64(record.untried)
    asking = questions_at(tree, node)
    available = ((1 << (n + 1 + asking)) - 1) & ~np.int64(record.given)
    if untried != 0:
        action = nth_bit(untried, next_below(tree.counter, count_bits(untried)))
        record.untried = untried & ~(1 << action)
        return first + count_bits(available & ((1 << action) - 1)), action
    last = first + count_bits(available) - 1
    bonus, best, chosen = options.exploration * log_root[record.visits], -np.inf, uint64(first)
    # Unsigned, as numba looks at each index whether it counts from the end.
    for e in range(uint64(first), uint64(last + 1)):
        score = tree.edges[e].value + bonus * inverse_root[uint64(tree.edges[e].visits)]
        if score > best:
            best, chosen = score, e
    edge = np.int64(chosen)
    return edge, n if edge == last - asking else nth_bit(available, edge - first)


@inlined
def expand(model, tree, node, edge, action, user_type):  # type: ignore[no-untyped-def]
    """The node that an action leads a user of this type to, and whether it is new to the tree. Its
    belief is set then; END after the last *explain*."""
    record = tree.nodes[node]
    step, given, base = np.int64(record.step), np.int64(record.given), np.int64(record.base)
    child = np.int64(tree.edges[edge].child)
    question, answer = np.int64(-1), 0
    if action < len(model.reduced.price):
        given |= 1 << action
        parent, code = ~base, uint64(given)
    elif action > len(model.reduced.price):
        question = np.int64(tree.inquired[node, action - len(model.reduced.price) - 1])
        yes = answer_probability(model.reduced.inquiry, question, given, user_type)
        answer = int(next_uniform(tree.counter) < yes)
        parent, code = node, splitmix64(uint64(2 * question + answer + 1) * GOLDEN)
    else:
        if step + 1 == model.informative.shape[1]:
            return np.int64(END), False
        parent, code = node, draw_labels(model, tree, step, given, user_type)
    if child != UNVISITED and tree.nodes[child].code == code:  # the last answer, as often
        return child, False
    slot, tag = find(tree, parent, code)
    child = np.int64(tree.table[slot].node)
    is_new = child == UNVISITED
    if is_new:
        child = add(tree, slot, tag, parent, code)
        record = tree.nodes[child]
        record.given = given
        if action < len(model.reduced.price):
            record.step, record.base = step, base
        else:
            belief = tree.beliefs[child]
            for t in range(len(belief)):
                belief[t] = tree.beliefs[base, t]
            if action == len(model.reduced.price):
                record.step, record.base = step + 1, child
                update_belief(model, tree, step, given, user_type, code, belief)
            else:
                record.step, record.base = step, child
                hear_answer(model.reduced.inquiry, question, given, answer, belief)
            if len(tree.room.found) > 0:
                tree.inquired[child, len(tree.room.found)] = 0
                tree.inquired[child, len(tree.room.found) + 1] = question
    tree.edges[edge].child = child
    return child, is_new


@inlined
def evaluate(model, tree, node, is_new, user_type):  # type: ignore[no-untyped-def]
    """The return from where a simulation ended: 0 after the last *explain*, a rollout's from a new
    node, QMDP's value from a node at the depth limit."""
    if node == END:
        return 0.0
    record = tree.nodes[node]
    step, given, belief = np.int64(record.step), np.int64(record.given), tree.beliefs[record.base]
    if not is_new:
        if np.isnan(record.leaf):
            record.leaf = leaf_value(model, tree, step, given, belief)
        return record.leaf
    return roll_qmdp(model, tree, step, given, user_type, belief)


@inlined
def backward(model, options, tree, node, length, value):  # type: ignore[no-untyped-def]
    """Takes the return from a node up the path to the root.

    With MAX a node is worth its best action, and *explain* the mean of what its observations are
    worth now: ``moved`` corrects what earlier arrivals counted as.
    """
    n, to_max, moved = len(model.reduced.price), options.backup == MAX, 0.0
    if node != END:
        record = tree.nodes[node]
        moved = record.visits * (value - record.value)
        record.value = value
        record.visits += 1
    for i in range(length - 1, -1, -1):
        record, edge = tree.nodes[tree.path[0, i]], tree.edges[tree.path[1, i]]
        is_message, later = tree.path[2, i] < n, model.reduced.discount
        edge.visits += 1
        before = edge.value
        if is_message:
            value = model.reduced.message_discount * value - tree.paid[i]
        elif tree.path[2, i] > n:
            value, later = value - model.reduced.inquiry.cost, 1.0
        else:
            value = record.reward + later * value
        if edge.visits == 1 or (to_max and is_message):
            edge.value = value
        elif to_max:
            edge.value += (value - before + later * moved) / edge.visits
        else:
            edge.value += (value - before) / edge.visits
        if to_max:
            # A node visited once so far holds a rollout's return, not its best action's.
            if record.visits > 1 and before < record.value:
                value = max(record.value, edge.value)
            else:
                value = edge.value
                actions = n + 1 - count_bits(np.int64(record.given))
                actions += questions_at(tree, tree.path[0, i])
                for e in range(record.edges, record.edges + actions):
                    value = max(value, tree.edges[e].value)
            moved = record.visits * (value - record.value)
            record.value = value
        record.visits += 1
