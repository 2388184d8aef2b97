"""POMCP where messages may be missed or forgotten: histories of what was said and answered, exact
beliefs over what a user knows (:mod:`xplain.solvers.knowing`).

As :mod:`xplain.solvers.pomcp.kernel`, but that saying a message changes the belief, that it may be
said again at a later step, and that a history is worth QMDP's value where a simulation ends: a
rollout with so many states takes longer than all the rest. A step begins with the messages given
that may not be said any more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import uint64

from xplain.numba_kernels import inlined, lean_kernel
from xplain.solvers.count_lattice import copy
from xplain.solvers.inquiry import answer_probability, hear_answer
from xplain.solvers.knowing import (
    Knowing,
    best_now,
    draw_state,
    exhausted,
    given_after,
    hear,
    price_of,
    say,
    shown,
    told,
)
from xplain.solvers.pomcp.growth import (
    END,
    ROOT,
    UNOPENED,
    UNVISITED,
    add,
    find,
    grow_table,
    make_edges,
)
from xplain.solvers.pomcp.kernel import backward, select
from xplain.solvers.random_words import GOLDEN, next_uniform, splitmix64


class KnowingSearch(NamedTuple):
    """What simulations look at.

    Attributes:
        reduced: the problem, by states.
    """

    reduced: Knowing


@lean_kernel
def simulate_knowing(simulations, model, options, tree, labels, log_root, inverse_root):  # type: ignore[no-untyped-def]
    """Runs simulations from the root, whose belief is set. ``labels``: [m] to work in; the rest as
    :func:`xplain.solvers.pomcp.kernel.simulate` has it."""
    n = len(model.reduced.price)
    for _ in range(simulations):
        grow_table(tree)
        state = draw_state(tree.counter, tree.beliefs[ROOT])
        node, depth, length, is_new = ROOT, 0, 0, False
        while depth < options.depth and not is_new and node != END:
            if tree.nodes[node].edges == UNOPENED:
                _open(model.reduced, tree, node)
            edge, action = select(model, options, tree, node, log_root, inverse_root)
            tree.path[0, length] = node
            tree.path[1, length] = edge
            tree.path[2, length] = action
            if action < n:
                before = tree.before[tree.nodes[node].base]
                tree.paid[length] = price_of(model.reduced, before, action)
            length += 1
            if action <= n:
                depth += 1 if action == n else options.message_depth
            node, is_new, state = _expand(model.reduced, tree, node, edge, action, state, labels)
        value = 0.0
        if node != END:
            record = tree.nodes[node]
            if np.isnan(record.leaf):
                step, said = np.int64(record.step), np.int64(record.given)
                before, belief = tree.before[record.base], tree.beliefs[node]
                record.leaf, _, _ = best_now(model.reduced, step, before, said, belief)
            value = record.leaf
        backward(model, options, tree, node, length, value)


@inlined
def _open(knowing, tree, node):  # type: ignore[no-untyped-def]
    """Gives a node its edges, and the expected reward of *explain*."""
    make_edges(len(knowing.price), knowing.inquiry, tree, node)
    record = tree.nodes[node]
    record.reward = 0.0
    for s in range(tree.beliefs.shape[1]):
        record.reward -= tree.beliefs[node, s] * knowing.explain_cost[record.step, s]


@inlined
def _expand(knowing, tree, node, edge, action, state, labels):  # type: ignore[no-untyped-def]
    """The node that an action leads a user in this state to, whether it is new to the tree, and the
    state after it."""
    record, n = tree.nodes[node], len(knowing.price)
    step, said, base = np.int64(record.step), np.int64(record.given), np.int64(record.base)
    question, answer, before = np.int64(-1), 0, state
    if action < n:
        state = told(knowing, tree.counter, state, action)
        parent, code = ~base, uint64(said | 1 << action)
    elif action > n:
        question = np.int64(tree.inquired[node, action - n - 1])
        yes = answer_probability(knowing.inquiry, question, 0, before)
        answer = int(next_uniform(tree.counter) < yes)
        parent, code = node, splitmix64(uint64(2 * question + answer + 1) * GOLDEN)
    else:
        if step + 1 == len(knowing.explain):
            return np.int64(END), False, state
        state = shown(knowing, tree.counter, step, state, labels)
        parent, code = node, uint64(1)
        for i in range(step + 1):
            code = code * uint64(2) + uint64(labels[i])
            if i % 60 == 59:
                code = splitmix64(code)
    child = np.int64(tree.edges[edge].child)
    if child != UNVISITED and (action < n or tree.nodes[child].code == code):
        return child, False, state
    slot, tag = find(tree, parent, code)
    child = np.int64(tree.table[slot].node)
    is_new = child == UNVISITED
    if is_new:
        child = add(tree, slot, tag, parent, code)
        record, belief = tree.nodes[child], tree.beliefs[child]
        copy(tree.beliefs[node], belief)
        if action < n:
            record.step, record.given, record.base = step, said | 1 << action, base
            say(knowing, belief, action)
        else:
            before, record.base = tree.before[base], child
            if action == n:
                record.step = step + 1
                before = given_after(knowing, before, said)
                hear(knowing, step, labels, belief)
            else:
                record.step = step
                hear_answer(knowing.inquiry, question, 0, answer, belief)
            record.given, tree.before[child] = exhausted(knowing, before), before
            if len(tree.room.found) > 0:
                tree.inquired[child, len(tree.room.found)] = 0
                tree.inquired[child, len(tree.room.found) + 1] = question
    tree.edges[edge].child = child
    return child, is_new, state
