"""The compiled search of :mod:`xplain.solvers.pomcp`: select, expand, evaluate, back up.

numba compiles this source once for each kind of problem. ``missed`` is None if messages always
correct the fact, and True if messages may be missed or forgotten, and so change the hidden state.
For None numba removes the branches of the other kind, so the paper's search does no work for them.

A label is *informative* if P(answer 1) depends on the hidden state. Only these labels are drawn.
Labels with the same column P(answer 1 | s) are exchangeable, so an observation is identified by its
code Σ_i [l_i = 0] · w_i, where w is a 64-bit hash of the label's column. Two different observations
get the same code with probability 2^-64.
"""

from typing import NamedTuple

import numpy as np
from numba import uint64
from numpy.typing import NDArray

from xplain.numba_kernels import (
    GOLDEN,
    count_bits,
    first_bit,
    inner,
    next_uniform,
    nth_bit,
    part,
    search,
    small,
    splitmix64,
)
from xplain.solvers.search_model import NO_NEWS, find_cell, forget, give, rank_questions

NODE = np.dtype(
    [
        ("code", np.uint64),  # code of the labels that led here; v after a message
        ("leaf", np.float64),  # QMDP's value at the belief, NaN until computed
        ("value", np.float64),  # value of the best action so far, or of the only rollout
        ("reward", np.float64),  # expected reward of *explain*
        ("given", np.int64),  # v
        ("actions", np.int64),  # bitmask: messages that matter, *explain* (bit n), questions
        ("untried", np.int64),  # bitmask of the actions that were not tried
        ("edges", np.int32),  # the node's first edge; 0 until a second visit
        ("parent", np.int32),  # node before *explain* or a question; ~base after a message
        ("base", np.int32),  # node at which the step began
        ("visits", np.int32),
        ("step", np.int32),  # k
    ],
    align=True,
)
EDGE = np.dtype(
    [
        ("value", np.float64),  # estimated return; −inf until tried
        ("inverse_root", np.float64),  # 1 / sqrt(visits); 0 until tried
        ("visits", np.int32),
        ("child", np.int32),  # node after the message or the last answer; 0 until known
    ]
)
ENTRY = np.dtype([("node", np.int32), ("tag", np.uint32)])
MOVE = np.dtype(
    [
        ("node", np.int32),
        ("edge", np.int32),
        ("action", np.int32),
        ("paid", np.float64),  # the cost of the action, if it is no *explain*
        ("later", np.float64),  # the discount of all later rewards
    ],
    align=True,
)
LABEL = np.dtype([("weight", np.uint64), ("informative", np.int64)])
COLUMN = np.dtype([("p", np.float64), ("probability", np.float64), ("code", np.uint64)])
MEAN, MAX = 0, 1
NODES, EDGES, MASK = 0, 1, 2
"""Positions in ``tree.used``."""
ROOT, END = np.int64(0), -1
"""The node at which a search begins, and the end after the last *explain*."""
UNVISITED, UNOPENED = 0, 0
"""UNVISITED means "no node" in ``edge.child`` and ``entry.node``: the root is nobody's child.
UNOPENED means "no edges yet" in ``node.edges``: the first edges are never used."""
SETTLED = -1
"""A value in ``wanted``: the state needs no message from this step to the end."""
CERTAIN = 1 - 1e-6
"""Rollouts treat a state as certain if the belief in it exceeds this."""
ROUNDING = 1e-12
"""Values that differ by less than this are equal; the first of several equal messages is taken."""


class Options(NamedTuple):
    """The settings of a search.

    Attributes:
        depth: the depth at which simulations end.
        message_depth: how much a message adds to the depth, 0 or 1. *Explain* adds 1.
        exploration: the constant c of UCB1, in the problem's unit of cost.
        backup: MEAN or MAX.
    """

    depth: int
    message_depth: int
    exploration: float
    backup: int


class Tree(NamedTuple):
    """The search tree of R simulations. Each simulation adds at most one node.

    There are n messages, m steps, S states and Q questions; at most B questions are tried at a
    node.

    Attributes:
        nodes: [R + 1] NODE.
        edges: [(R + 2) · (n + 1 + B)] EDGE, one for each action of a node, side by side. The first
            n + 1 + B edges are never used, so that 0 can mean "no edges yet".
        beliefs: [R + 1, S] the belief at each node. If messages always correct the fact, only nodes
            that begin a step have a belief.
        table: [a power of two > 2 R + 2] ENTRY, the hash table of child nodes; node 0 marks a free
            entry. Only the first ``used[MASK] + 1`` entries are in use; their number doubles as
            the tree grows.
        tried: [R + 1, B + 2] for nodes that begin a step: the questions to try, their number, and
            the question that led to the node (−1 for none).
        path: [(n + 1) m + 1 + Q] the records MOVE of a simulation.
        used: [3] the number of nodes (NODES) and edges (EDGES), and the table's mask (MASK).
    """

    nodes: NDArray[np.void]
    edges: NDArray[np.void]
    beliefs: NDArray[np.float64]
    table: NDArray[np.void]
    tried: NDArray[np.int32]
    path: NDArray[np.void]
    used: NDArray[np.int64]


class LabelCodes(NamedTuple):
    """The codes of labels, and the likelihoods of observations, that a search has computed. The
    arrays with lengths ".." have a slot for each stored observation (``likelihoods``) or message
    set (``labels`` and ``columns``).

    Attributes:
        seen: [a power of two] hashes of the observations in ``likelihoods``; 0 marks a free slot.
        likelihoods: [.., S] P(observation | state).
        coded: [a power of two] the message set of each slot of ``labels`` and ``columns``; −1 for
            none.
        labels: [.., m] records LABEL. In element k, ``informative`` is the number of informative
            labels among the first k + 1 labels. In element i, ``weight`` is the hash w of the i-th
            informative label.
        columns: [.., m, S] records COLUMN. In element i, ``p`` is P(answer 1 | s) of the i-th
            informative label. In element k, ``probability`` and ``code`` are the probability and
            the code of the most likely answers to the first k + 1 labels in state s.
        zero: [m] True for each informative label whose drawn answer is 0. It is filled only if some
            drawn answer was the less likely answer.
    """

    seen: NDArray[np.uint64]
    likelihoods: NDArray[np.float64]
    coded: NDArray[np.int64]
    labels: NDArray[np.void]
    columns: NDArray[np.void]
    zero: NDArray[np.bool_]


class Scratch(NamedTuple):
    """The working memory of a search.

    Attributes:
        belief: [S] the belief of a rollout.
        cells: [S] the cells at which tables are read for one message set.
        gain: [n] the difference in V that each message makes under a belief; 0 between calls.
        asked: [Q] True for questions that were asked before the search.
        news: [Q] the information of each question, for ranking.
        counter: [1] the counter of the random stream.
    """

    belief: NDArray[np.float64]
    cells: NDArray[np.int64]
    gain: NDArray[np.float64]
    asked: NDArray[np.bool_]
    news: NDArray[np.float64]
    counter: NDArray[np.uint64]


Memory = tuple[Tree, LabelCodes, Scratch]
"""The memory of one search. Compiled functions get only the parts that they use, because numba
copies the arrays of a tuple at every call."""


@search
def simulate(simulations, model, memory, options, missed, log_root, inverse_root):  # type: ignore[no-untyped-def]
    """Runs simulations from the root. The caller has set the root's belief.

    ``log_root[v]`` is sqrt(log v) and ``inverse_root[v]`` is 1 / sqrt(v), and 0 for v = 0. Both
    tables are longer than the largest number of visits.

    Indices of records are unsigned numbers here: numba checks signed indices, which may count from
    the end, and the checks would take a tenth of the time.
    """
    tree, codes, scratch = memory
    n, last = len(model.price), tree.beliefs.shape[1] - 1
    while tree.beliefs[ROOT, last] <= 0.0:
        last -= 1
    for _ in range(simulations):
        _grow_table(tree)
        state = _draw_state(tree.beliefs, scratch.counter, last)
        node, depth, length, is_new = ROOT, 0, 0, False
        while depth < options.depth and not is_new and node != END:
            if tree.nodes[uint64(node)].edges == UNOPENED:
                _open_node(model, tree, scratch, missed, node)
            edge, action = _select_action(model, tree, scratch, options, missed, node, log_root)
            move = tree.path[uint64(length)]
            move.node = node
            move.edge = edge
            move.action = action
            if action < n:
                move.paid, move.later = model.price[action], model.message_discount
                depth += options.message_depth
            elif action == n:
                move.later = model.discount
                depth += 1
            else:  # a question costs no depth
                move.paid, move.later = model.question_cost, 1.0
            length += 1
            node, is_new, state = _take_action(
                model, tree, codes, scratch, missed, node, edge, action, state
            )
        value = _evaluate(model, tree, codes, scratch, options, missed, node, is_new, state)
        _back_up(tree, n, options.backup == MAX, node, length, value, inverse_root)


@small
def _draw_state(beliefs, counter, last):  # type: ignore[no-untyped-def]
    """Draws a state from the root's belief. The last possible state gets the remainder due to
    rounding. The loop always visits all states: a processor cannot predict a random end."""
    u, state = next_uniform(counter), 0
    for s in range(last):
        u -= beliefs[ROOT, s]
        state += u >= 0.0
    return state


@part
def _select_action(model, tree, scratch, options, missed, node, log_root):  # type: ignore[no-untyped-def]
    """Chooses the action to try at an open node; returns its edge and the action. QMDP's action is
    tried first and the others follow in random order. Then UCB1 decides (Auer et al. 2002)."""
    record = tree.nodes[uint64(node)]
    first, actions, untried = np.int64(record.edges), record.actions, record.untried
    if untried != 0:
        if untried == actions:
            belief = tree.beliefs[record.base if missed is None else node]
            _find_cells(model.value_stride, record.given, scratch.cells)
            messages = actions & ((1 << len(model.price)) - 1)
            _, action, _ = _evaluate_qmdp(
                model, scratch, missed, np.int64(record.step), messages, belief, 0.0
            )
        else:
            action = nth_bit(untried, int(next_uniform(scratch.counter) * count_bits(untried)))
        record.untried = untried & ~(1 << action)
        return first + count_bits(actions & ((1 << action) - 1)), action
    bonus = options.exploration * log_root[uint64(record.visits)]
    best, chosen = -np.inf, uint64(first)
    for e in range(uint64(first), uint64(first + count_bits(actions))):
        score = tree.edges[e].value + bonus * tree.edges[e].inverse_root
        if score > best:
            best, chosen = score, e
    edge = np.int64(chosen)
    return edge, nth_bit(actions, edge - first)


@part
def _take_action(model, tree, codes, scratch, missed, node, edge, action, state):  # type: ignore[no-untyped-def]
    """Takes an action and draws its outcome for a user in this state. Returns the next node (END
    after the last *explain*), True if the node is new, and the next state. Sets the belief of a new
    node."""
    record, n = tree.nodes[uint64(node)], len(model.price)
    step, said, base = np.int64(record.step), record.given, np.int64(record.base)
    question, answer, before, at = np.int64(-1), False, state, np.int64(0)
    if action < n:
        said |= 1 << action
        parent, code = ~base, uint64(said)
        if missed is not None:
            state = _draw_after_message(model, scratch.counter, state, action)
    elif action == n:
        if step + 1 == len(model.explain_cost):
            return np.int64(END), False, state
        at = _find_coded_slot(model, codes, scratch, said if missed is None else np.int64(0))
        parent, code = node, _draw_labels(codes, scratch.counter, at, step, state)
        if missed is not None:
            state = _draw_after_step(model, scratch.counter, state)
    else:
        question = np.int64(tree.tried[node, action - n - 1])
        yes = model.asked_answered[question, find_cell(model.question_stride, said, state)]
        answer = next_uniform(scratch.counter) < yes
        parent, code = node, splitmix64(uint64(2 * question + answer + 1) * GOLDEN)
    child = np.int64(tree.edges[uint64(edge)].child)
    if child != UNVISITED and tree.nodes[uint64(child)].code == code:  # often the last answer
        return child, False, state
    slot, tag = _find_entry(tree, parent, code)
    child = np.int64(tree.table[slot].node)
    is_new = child == UNVISITED
    if is_new:
        child = _add_node(tree, slot, tag, parent, code)
        record, belief = tree.nodes[child], tree.beliefs[child]
        record.step, record.given, record.base = step, said, base
        if action >= n or missed is not None:
            held = base if missed is None else node
            for s in range(len(belief)):
                belief[s] = tree.beliefs[held, s]
        if action >= n:
            record.base = child
        if action == n:
            record.step = step + 1
            _update_belief(codes, at, step, before, code, belief)
        if missed is not None:
            if action < n:
                give(model.jump[action], model.accept, belief)
            elif action == n:
                record.given = 0
                forget(model.forget, belief)
        if len(scratch.asked) > 0 and action >= n:
            tree.tried[child, tree.tried.shape[1] - 1] = question
            if action > n:
                _update_by_answer(model, question, said, answer, belief)
    tree.edges[uint64(edge)].child = child
    return child, is_new, state


@part
def _evaluate(model, tree, codes, scratch, options, missed, node, is_new, state):  # type: ignore[no-untyped-def]
    """Estimates the return after the end of a simulation: 0 after the last *explain*, a rollout's
    return at a new node, QMDP's value at the depth limit. If messages may be missed, a rollout over
    so many states would take longer than everything else, so QMDP's value is used at new nodes,
    too."""
    if node == END:
        return 0.0
    record = tree.nodes[uint64(node)]
    step, said = np.int64(record.step), record.given
    belief = tree.beliefs[record.base if missed is None else node]
    if missed is None and (is_new or options.backup == MAX):
        value = _roll_out(model, codes, scratch, missed, step, said, state, belief)
        return record.value + (value - record.value) / (record.visits + 1)
    if np.isnan(record.leaf):
        _find_cells(model.value_stride, said, scratch.cells)
        if missed is None:
            messages = max(_find_wanted(model.wanted, scratch.cells, step, said), 0)
        else:
            messages = _find_relevant(model.relevant, belief) & ~said
        record.leaf = _evaluate_qmdp(model, scratch, missed, step, messages, belief, 0.0)[0]
    return record.leaf


@part
def _back_up(tree, n, to_max, node, length, value, inverse_root):  # type: ignore[no-untyped-def]
    """Adds a return to the statistics of all nodes on the path up to the root.

    With MAX, a node's value is the value of its best action. The value of *explain* is its reward
    plus the discounted mean, over all visits, of the current values of the nodes after it. If the
    value of such a node changes, this mean also changes for earlier visits of the node: ``moved``
    is their number times the change.
    """
    moved = 0.0
    if node != END:
        record = tree.nodes[uint64(node)]
        moved = record.visits * (value - record.value)
        record.value = value
        record.visits += 1
    for i in range(length - 1, -1, -1):
        move = tree.path[uint64(i)]
        record, edge = tree.nodes[uint64(move.node)], tree.edges[uint64(move.edge)]
        if move.action == n:
            value = record.reward + move.later * value
        else:
            value = move.later * value - move.paid
        edge.visits += 1
        edge.inverse_root = inverse_root[uint64(edge.visits)]
        before = edge.value
        if edge.visits == 1 or (to_max and move.action < n):
            edge.value = value
        elif to_max:
            edge.value += (value - before + move.later * moved) / edge.visits
        else:
            edge.value += (value - before) / edge.visits
        if to_max:
            # After one visit, a node's value is a rollout's return, not its best action's value.
            if record.visits > 1 and before < record.value:
                value = max(record.value, edge.value)
            else:
                value = edge.value
                for e in range(record.edges, record.edges + count_bits(record.actions)):
                    value = max(value, tree.edges[e].value)
            moved = record.visits * (value - record.value)
            record.value = value
        record.visits += 1


@part
def _find_entry(tree, parent, code):  # type: ignore[no-untyped-def]
    """Finds the entry of a child node in ``tree.table``, or the free entry for it. Returns the
    entry's index, and the child's tag: 32 bits of a hash of its key. Children with other tags are
    excluded without reading their nodes.

    The key of a child is ``parent`` and ``code``: the node before and the code of the answers after
    *explain* or a question; the node at which the step began and v after a message. So all orders
    of the same messages lead to one node.
    """
    mask = tree.used[MASK]
    h = splitmix64(code + uint64(parent) * GOLDEN)
    slot, tag = np.int64(h & uint64(mask)), np.uint32(h >> uint64(32))
    while True:
        node = tree.table[slot].node
        if node == UNVISITED:
            break
        if tree.table[slot].tag == tag:
            record = tree.nodes[node]
            if record.parent == parent and record.code == code:
                break
        slot = (slot + 1) & mask
    return slot, tag


@part
def _grow_table(tree):  # type: ignore[no-untyped-def]
    """Doubles the part of the table that is in use, once it is half full, and adds all children
    again. A small table stays in the processor's cache."""
    if 2 * tree.used[NODES] > tree.used[MASK]:
        tree.used[MASK] = 2 * tree.used[MASK] + 1
        for slot in range(tree.used[MASK] + 1):
            tree.table[slot].node = UNVISITED
        for node in range(1, tree.used[NODES]):
            record = tree.nodes[node]
            slot, tag = _find_entry(tree, np.int64(record.parent), record.code)
            tree.table[slot].node = node
            tree.table[slot].tag = tag


@part
def _add_node(tree, slot, tag, parent, code):  # type: ignore[no-untyped-def]
    """Adds a node without edges. The caller sets the fields ``step``, ``given`` and ``base`` of the
    node, and its belief."""
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


@part
def _open_node(model, tree, scratch, missed, node):  # type: ignore[no-untyped-def]
    """Adds the edges of a node, and computes the expected reward of *explain*. There is one edge
    for each message that has an effect on a possible state and was not given yet, one for
    *explain*, and, if a step begins at the node, one for each of the most informative questions."""
    record, n = tree.nodes[node], len(model.price)
    belief = tree.beliefs[record.base if missed is None else node]
    questions = 0
    if len(scratch.asked) > 0 and record.base == node:
        questions = _list_questions(model, tree, scratch, node, record.step, record.given, belief)
    record.actions = (
        _find_relevant(model.relevant, belief) & ~record.given | ((2 << questions) - 1) << n
    )
    record.untried = record.actions
    record.edges = tree.used[EDGES]
    tree.used[EDGES] += count_bits(record.actions)
    for e in range(np.int64(record.edges), tree.used[EDGES]):
        edge = tree.edges[e]
        edge.value = -np.inf
        edge.inverse_root = 0.0
        edge.visits = 0
        edge.child = UNVISITED
    reward = 0.0
    for s in range(len(belief)):
        if belief[s] > 0.0:
            cell = find_cell(model.stride, record.given, s)
            reward -= belief[s] * model.explain_cost[record.step, cell]
    record.reward = reward


@small
def _find_relevant(relevant, belief):  # type: ignore[no-untyped-def]
    """Returns the bitmask of the messages that have an effect on a possible state."""
    messages = np.int64(0)
    for s in range(len(belief)):
        if belief[s] > 0.0:
            messages |= relevant[s]
    return messages


@small
def _find_cells(stride, said, cells):  # type: ignore[no-untyped-def]
    """Computes in ``cells``, for each s, the cell of (v, s) in tables with these strides."""
    for s in range(len(cells)):
        cells[s] = find_cell(stride, said, s)


@small
def _find_wanted(wanted, cells, step, said):  # type: ignore[no-untyped-def]
    """Returns the bitmask of the messages that are better than *explain* in some state; SETTLED if
    no state needs a message from this step to the end. Reads the states' cells in
    ``cells``."""
    mask, settled = np.int64(0), True
    for s in range(len(cells)):
        own = wanted[step, cells[s]]
        if own != SETTLED:
            settled = False
            mask |= own
    return np.int64(SETTLED) if settled else mask & ~said


@inner
def _evaluate_qmdp(model, scratch, missed, step, messages, belief, patience):  # type: ignore[no-untyped-def]
    """Evaluates QMDP at a belief: max_a Σ_s b(s) Q(k, v, s, a) over *explain* and these messages.

    The function reads the states' cells in ``scratch.cells``. It reads values after a message only
    in the states on which the message has an effect, and adds up the differences in
    ``scratch.gain``.

    Args:
        model, missed: as in :func:`simulate`.
        step: k.
        messages: bitmask of the possible messages.
        belief: [S].
        patience: the additional share of its price that a message must gain
            (:data:`~xplain.solvers.process.PATIENCE`); 0 for the plain maximum.

    Returns:
        The maximum, its action (a message, or n for *explain*), and Σ_s b(s) V(k, v, s).
    """
    best, base, action, likeliest = 0.0, 0.0, len(model.price), 0.0
    for s in range(len(belief)):
        if belief[s] <= 0.0:
            continue
        at = scratch.cells[s]
        now = model.value[step, at]
        base += belief[s] * now
        best += belief[s] * model.explain[step, at if missed is None else s]
        likeliest = max(likeliest, belief[s])
        left = messages & model.relevant[s]
        while left:
            j = first_bit(left)
            left &= left - 1
            more = at + model.value_stride[j, s]
            later = model.value[step, more]
            if missed is not None:
                landed = model.value[step, more + model.jump[j, s]]
                later += model.accept[s] * (landed - later)
            scratch.gain[j] += belief[s] * (later - now)
    extra = 0.0
    while messages:
        j = first_bit(messages)
        messages &= messages - 1
        waits = patience * (1.0 - likeliest) * model.price[j]
        value = model.message_discount * (base + scratch.gain[j]) - model.price[j]
        scratch.gain[j] = 0.0
        if value - waits > best - extra + ROUNDING:
            best, action, extra = value, j, waits
    return best, action, base


@search
def roll(model, codes, scratch, missed, step, said, belief, states, weights, seeds):  # type: ignore[no-untyped-def]
    """Estimates by simulation the return of QMDP's decisions from a belief at (k, v).

    Args:
        model, missed: as in :func:`simulate`.
        codes, scratch: working memory.
        step, said, belief: k, v, and the belief [S].
        states, weights, seeds: [R] the first state of each simulation, its weight, and the seed of
            its random stream.
    """
    total = 0.0
    for i in range(len(states)):
        scratch.counter[0] = seeds[i]
        total += weights[i] * _roll_out(
            model, codes, scratch, missed, step, said, states[i], belief
        )
    return total


@inner
def _roll_out(model, codes, scratch, missed, step, said, state, belief):  # type: ignore[no-untyped-def]
    """Simulates QMDP with exact beliefs for a user in this state; returns the estimated return.

    The estimate is the value of the known state minus the expected loss of each decision, which
    arises because the state is unknown. This control variate has the mean of the simulated return
    and less noise. If messages always correct the fact, the simulation ends as soon as no later
    decision can have a loss: the state is certain, or no state needs a message.
    """
    n, steps, value, scale = len(model.price), len(model.explain_cost), 0.0, 1.0
    _find_cells(model.value_stride, said, scratch.cells)
    for s in range(len(belief)):
        scratch.belief[s] = belief[s]
        value += belief[s] * model.value[step, scratch.cells[s]]
    while step < steps:
        if missed is None:
            wanted = _find_wanted(model.wanted, scratch.cells, step, said)
            if scratch.belief[state] > CERTAIN or wanted == SETTLED:
                break
        else:
            wanted = _find_relevant(model.relevant, scratch.belief) & ~said
        action = n
        if wanted != 0:
            best, action, sure = _evaluate_qmdp(
                model, scratch, missed, step, wanted, scratch.belief, model.patience
            )
            value -= scale * (sure - best)
        if action < n:
            scale *= model.message_discount
            said |= 1 << action
            for s in range(len(belief)):
                scratch.cells[s] += model.value_stride[action, s]
            if missed is not None:
                give(model.jump[action], model.accept, scratch.belief)
                state = _draw_after_message(model, scratch.counter, state, action)
        else:
            scale *= model.discount
            step += 1
            if step < steps:
                at = _find_coded_slot(
                    model, codes, scratch, said if missed is None else np.int64(0)
                )
                code = _draw_labels(codes, scratch.counter, at, step - 1, state)
                _update_belief(codes, at, step - 1, state, code, scratch.belief)
                if missed is not None:
                    forget(model.forget, scratch.belief)
                    state = _draw_after_step(model, scratch.counter, state)
                    said = 0
                    _find_cells(model.value_stride, said, scratch.cells)
    return value


@part
def _draw_labels(codes, counter, at, step, s):  # type: ignore[no-untyped-def]
    """Draws the informative labels of a user in state s after *explain* at step k; returns their
    code. ``at`` is the slot of v in ``codes``.

    A random number u decides which label is the first unlikely answer. Usually there is none, and
    the code is read from a table. Otherwise ``codes.zero`` is filled, and a new u is drawn after
    each unlikely answer.
    """
    code, count = uint64(0), codes.labels[at, step].informative
    if count > 0:
        u = next_uniform(counter)
        code = codes.columns[at, step, s].code
        if u >= codes.columns[at, step, s].probability:
            as_likely = 1.0
            for i in range(count):
                yes = codes.columns[at, i, s].p
                zero = yes < 0.5
                as_likely *= 1.0 - yes if zero else yes
                if u >= as_likely:
                    zero = not zero
                    weight = codes.labels[at, i].weight
                    code = code + weight if zero else code - weight
                    u = next_uniform(counter)
                    as_likely = 1.0
                codes.zero[i] = zero
    return code


@part
def _update_belief(codes, at, step, state, code, belief):  # type: ignore[no-untyped-def]
    """Updates a belief [S] by the labels that :func:`_draw_labels` has just drawn for a user in
    this state. The likelihoods of these labels are stored, for later draws of the same labels."""
    count = codes.labels[at, step].informative
    if count > 0:
        place = codes.coded[at] * len(codes.zero) + step + 1
        key = splitmix64(code + uint64(place) * GOLDEN)
        slot = np.int64(key & uint64(len(codes.seen) - 1))
        if codes.seen[slot] != key:
            codes.seen[slot] = key
            usual = code == codes.columns[at, step, state].code  # nothing was written to ``zero``
            for s in range(len(belief)):
                likelihood = 1.0
                for i in range(count):
                    zero = codes.columns[at, i, state].p < 0.5 if usual else codes.zero[i]
                    yes = codes.columns[at, i, s].p
                    likelihood *= 1.0 - yes if zero else yes
                codes.likelihoods[slot, s] = likelihood
        total = 0.0
        for s in range(len(belief)):
            belief[s] *= codes.likelihoods[slot, s]
            total += belief[s]
        scale = 1.0 / total
        for s in range(len(belief)):
            belief[s] *= scale


@part
def _find_coded_slot(model, codes, scratch, shown):  # type: ignore[no-untyped-def]
    """Returns the slot of ``codes.labels`` and ``codes.columns`` for the messages on which labels
    depend: v, or 0 if messages may be missed. Fills the slot if necessary. Message sets with the
    same hash use the same slot: a set replaces the earlier set."""
    slot = shown
    if slot >= len(codes.coded):
        slot ^= slot >> 24 ^ slot >> 48
        slot = (slot ^ slot >> 12) & (len(codes.coded) - 1)
    if codes.coded[slot] != shown:
        _find_cells(model.stride, shown, scratch.cells)
        _code_labels(model.answered, scratch.cells, codes.labels[slot], codes.columns[slot])
        codes.coded[slot] = shown
    return slot


@inner
def _code_labels(answered, cells, labels, columns):  # type: ignore[no-untyped-def]
    """Fills this slot of ``codes.labels`` and ``codes.columns`` for the messages whose cells are
    given."""
    steps, states = columns.shape
    found = 0
    for i in range(steps):
        differs, code = False, GOLDEN
        first = answered[i, cells[0]]
        for s in range(states):
            p = answered[i, cells[s]]
            columns[found, s].p = p  # overwritten if the label is not informative
            differs |= p != first
            code = splitmix64((code + GOLDEN) ^ np.float64(p).view(np.uint64))
        for s in range(states):
            usual, p = columns[i, s], answered[i, cells[s]]
            usual.probability = columns[i - 1, s].probability if i > 0 else 1.0
            usual.code = columns[i - 1, s].code if i > 0 else np.uint64(0)
            if differs:
                usual.probability *= max(p, 1.0 - p)
                usual.code += code if p < 0.5 else np.uint64(0)
        if differs:
            labels[found].weight = code
            found += 1
        labels[i].informative = found


@part
def _draw_after_message(model, counter, state, message):  # type: ignore[no-untyped-def]
    """Draws the state of a user after a message was given once."""
    jump = model.jump[message, state]
    if jump > 0 and next_uniform(counter) < model.accept[state]:
        state += jump
    return state


@part
def _draw_after_step(model, counter, state):  # type: ignore[no-untyped-def]
    """Draws the state of a user after a step, at whose end known facts may be forgotten."""
    types = bit = len(model.forget)
    lost = model.forget[state % types]
    while lost > 0.0 and bit <= state:  # no fact of a larger bit is known
        if state // bit % 2 == 1 and next_uniform(counter) < lost:
            state -= bit
        bit *= 2
    return state


@part
def _update_by_answer(model, question, said, answer, belief):  # type: ignore[no-untyped-def]
    """Updates a belief by the answer to a question."""
    total = 0.0
    for s in range(len(belief)):
        yes = model.asked_answered[question, find_cell(model.question_stride, said, s)]
        belief[s] *= yes if answer else 1.0 - yes
        total += belief[s]
    for s in range(len(belief)):
        belief[s] /= total


@inner
def _list_questions(model, tree, scratch, node, step, said, belief):  # type: ignore[no-untyped-def]
    """Lists in ``tree.tried`` the most informative questions at a node that begins a step; returns
    their number."""
    slots, cells, news = tree.tried.shape[1] - 2, scratch.cells, scratch.news
    if tree.tried[ROOT, slots] < 0 and node == ROOT:  # the step already has messages
        return 0
    count, asked = 0, 0
    for q in range(len(news)):
        news[q] = -1.0 if scratch.asked[q] else 0.0
        asked += scratch.asked[q]
    before = node
    while before != ROOT:
        if tree.tried[before, slots + 1] >= 0:
            news[tree.tried[before, slots + 1]] = -1.0
            asked += 1
        before = np.int64(tree.nodes[tree.nodes[before].parent].base)
    if asked >= model.most or (model.first and (step > 0 or said > 0)):
        return 0
    _find_cells(model.question_stride, said, cells)
    rank_questions(model.asked_answered, model.likelier, cells, belief, news)
    while count < slots:
        best = 0
        for q in range(len(news)):
            if news[q] > news[best]:
                best = q
        if news[best] <= NO_NEWS:
            break
        tree.tried[node, count] = best
        news[best] = -1.0
        count += 1
    return count
