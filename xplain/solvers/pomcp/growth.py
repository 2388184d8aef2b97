"""How simulations find and make the nodes and edges of a tree.

Children are found in one open-addressing table, by (node, labels) after *explain* and by (node
where the step began, H) after a message: orders of the same messages lead to one node.
``tree`` is a :class:`~xplain.solvers.pomcp.tree.Tree`, ``model`` a
:class:`~xplain.solvers.pomcp.search_model.SearchModel`.
"""

from __future__ import annotations

import numpy as np
from numba import uint64

from xplain.numba_kernels import inlined
from xplain.solvers.bits import count_bits
from xplain.solvers.count_lattice import copy
from xplain.solvers.inquiry import open_questions
from xplain.solvers.random_words import GOLDEN, splitmix64
from xplain.solvers.rows import find_rows

ROOT, END = np.int64(0), -1
"""The node that a search begins at, and what comes after the last *explain*. A plain 0 would be a
type of its own to numba, which compiled half of the search for it and then again for all others."""
UNVISITED, UNOPENED = 0, 0
"""``edge.child`` and ``entry.node`` where there is no node (the root is no child), and
``node.edges`` until a simulation goes on from there (the first edges are unused)."""
CLOSED = -1
"""Instead of how many questions a node has: none may be asked there."""
NODES, EDGES, MASK = 0, 1, 2
"""Positions in ``tree.used``."""


@inlined
def find(tree, parent, code):  # type: ignore[no-untyped-def]
    """Where the table holds this child, or has room for it; and the tag it bears there, without
    which every other child on the way would have to be looked at."""
    mask = tree.used[MASK]
    h = splitmix64(code + uint64(parent) * GOLDEN)
    slot, tag = np.int64(h & uint64(mask)), np.uint32(h >> uint64(32))
    while True:
        node = tree.table[slot].node
        if node == UNVISITED:
            return slot, tag
        if tree.table[slot].tag == tag:
            record = tree.nodes[node]
            if record.parent == parent and record.code == code:
                return slot, tag
        slot = (slot + 1) & mask


@inlined
def grow_table(tree):  # type: ignore[no-untyped-def]
    """Where the table is half full, spreads the children over twice as much of it: a table no
    larger than need be stays in the processor's cache."""
    if 2 * tree.used[NODES] > tree.used[MASK]:
        tree.used[MASK] = 2 * tree.used[MASK] + 1
        for slot in range(tree.used[MASK] + 1):
            tree.table[slot].node = UNVISITED
        for node in range(1, tree.used[NODES]):
            record = tree.nodes[node]
            slot, tag = find(tree, np.int64(record.parent), record.code)
            tree.table[slot].node = node
            tree.table[slot].tag = tag


@inlined
def add(tree, slot, tag, parent, code):  # type: ignore[no-untyped-def]
    """A node without edges; its step, given, base and belief are left to set."""
    node = tree.used[NODES]
    tree.used[NODES] += 1
    tree.table[slot].node = node
    tree.table[slot].tag = tag
    record = tree.nodes[node]
    record.parent = parent
    record.code = code
    record.edges = UNOPENED
    record.visits = 0
    record.value = 0.0
    record.leaf = np.nan
    return node


@inlined
def open_(model, tree, node):  # type: ignore[no-untyped-def]
    """Gives a node its edges, and the expected reward of *explain*."""
    make_edges(len(model.reduced.price), model.reduced.inquiry, tree, node)
    record = tree.nodes[node]
    record.reward = 0.0
    find_rows(model.reduced.rows.part, np.int64(record.given), tree.rows)
    for t in range(tree.beliefs.shape[1]):
        cost = model.explain_cost[tree.rows[t], record.step, t]
        record.reward -= tree.beliefs[record.base, t] * cost


@inlined
def make_edges(messages, inquiry, tree, node):  # type: ignore[no-untyped-def]
    """Edges for each message not yet given, for *explain*, and for each of the most telling
    questions where a step begins."""
    record, actions = tree.nodes[node], messages + 1
    record.edges = tree.used[EDGES]
    if len(tree.room.found) > 0 and record.base == node:
        actions += _inquire(inquiry, tree, node)
    record.untried = ((1 << actions) - 1) & ~record.given
    actions = count_bits(np.int64(record.untried))
    tree.used[EDGES] += actions
    for a in range(actions):
        edge = tree.edges[record.edges + a]
        edge.value = -np.inf
        edge.visits = 0
        edge.child = UNVISITED


@inlined
def questions_at(tree, node):  # type: ignore[no-untyped-def]
    """How many questions an open node has edges for."""
    slots = len(tree.room.found)
    if slots == 0 or tree.nodes[node].base != node:
        return 0
    return max(np.int64(tree.inquired[node, slots]), 0)


@inlined
def _inquire(inquiry, tree, node):  # type: ignore[no-untyped-def]
    """Looks up the questions to try at a node where a step begins. Returns how many."""
    slots, known = len(tree.room.found), tree.inquired[node]
    if known[slots] == CLOSED:
        return 0
    copy(tree.asked, tree.room.asked)
    before = node
    while before != ROOT:
        if tree.inquired[before, slots + 1] >= 0:
            tree.room.asked[tree.inquired[before, slots + 1]] = True
        before = np.int64(tree.nodes[tree.nodes[before].parent].base)
    record = tree.nodes[node]
    given, step = np.int64(record.given), np.int64(record.step)
    count = open_questions(inquiry, step, given, tree.beliefs[node], tree.room)
    known[slots] = count
    for i in range(count):
        known[i] = tree.room.found[i]
    return count
