"""The compiled search of :mod:`xplain.solvers.hsvi`: it samples beliefs, backs up bounds, and
shares bounds.

``tables.width`` is 0 if messages may be missed or forgotten. Messages then change the hidden state:
branches for this case update beliefs, and average values over the next state.

A node is a belief at (k, v) before a step's messages. Between two *explain* actions only questions
bring information, so an action is either a set of messages (the cheapest first) followed by
*explain*, or a question. Each answer to an action leads to a node.

A *place* is a pair (k, v). At a place, three quantities of a set of messages are linear in the
belief: its immediate cost, the upper bound of its value (the state becomes known afterwards), and
the lower bound (no message is given afterwards). Plans that ignore all answers give further lower
bounds.

The nodes of a place share their bounds. The value of a policy is linear in the belief, so the
policy's values by state (an alpha vector) bound the optimum of every belief from below. The optimum
is convex in the belief, so an upper bound at one belief gives upper bounds at the others (the
sawtooth; Hauskrecht 2000).
"""

from typing import NamedTuple

import numpy as np
from numba import uint64
from numpy.typing import NDArray

from xplain.numba_kernels import GOLDEN, first_bit, inner, part, search, small, splitmix64
from xplain.solvers.search_model import (
    NO_NEWS,
    SearchModel,
    find_cell,
    forget,
    give,
    rank_questions,
)

NODE = np.dtype(
    [
        ("upper", np.float64),  # bounds of the optimal value
        ("lower", np.float64),
        ("step", np.int64),  # k
        ("given", np.int64),  # v
        ("first_action", np.int64),  # NONE until the node is opened
        ("n_actions", np.int64),
        ("earned_by", np.int64),  # the action of another node's alpha vector; SILENCE for none
    ]
)
ACTION = np.dtype(
    [
        ("messages", np.int64),  # the set given, then *explain*; ~q to ask question q
        ("upper", np.float64),
        ("lower", np.float64),
        ("base", np.float64),  # the expected immediate reward
        ("later", np.float64),  # the discount of all later rewards
        ("tail_upper", np.float64),  # value of the answers that are treated as one
        ("tail_lower", np.float64),
        ("first_answer", np.int64),  # NONE until the action is expanded
        ("n_answers", np.int64),
    ]
)
# Weights are discounted; the node of the tail is NONE.
ANSWER = np.dtype([("weight", np.float64), ("node", np.int64)])
PLACE = np.dtype([("first_set", np.int64), ("n_sets", np.int64), ("row", np.int64)])
NODES, ACTIONS, ANSWERS, SETS, PLACES, OPENED, WORK, HASHED = range(8)
"""Positions in ``store.used``: the number of used elements of each array, of opened nodes (OPENED),
of work done (WORK), and of nodes in the hash table (HASHED)."""
ROOT = np.int64(0)
NONE = -1
"""An index that does not exist yet: the node is not opened, the action is not expanded, the place
has no sets, the entry of the hash table is free."""
SILENCE = 1 << 62
"""The value of ``earned_by`` if no action of another node earns the lower bound."""
KEPT = 32
"""The number of alpha vectors, and of upper bounds, that each place keeps."""
GRAIN = 2.0**40
"""Beliefs that are equal when rounded to multiples of 1 / GRAIN are one node."""
HAIR = 1e-12
"""The largest rounding error of a value, relative to 1 + its absolute value."""
ROUNDING = 1e-14
"""Differences below this are rounding."""
WORD = 62
"""The number of questions whose bits one integer holds."""
DONE, WORKING, FULL = 0, 1, 2
"""The results of :func:`sample`."""
CLOSED, NO_ROOM = -1, -2
"""The results of :func:`_choose_action` that are no action: the node's gap is small enough; the
store is full."""
NEWS = 0.01
"""A bound is published if it improved by more than this share of the gap."""


class Tables(NamedTuple):
    """The data that a search reads, for m steps, S states and the n messages with an effect. Bit 0
    of a set of messages is the cheapest message.

    Attributes:
        model: the model, restricted to these messages; the cell of (v, s) is s + v · width.
        width: S if messages always correct the fact; 0 if they may be missed.
        plans: [U, m + 1, cells] the values of U plans that ignore all answers. They bound the
            optimal value from below. The last plan gives no message.
        floor: [m + 1] a lower bound of every policy's value in every state.
        price: [2^n] the discounted price of each set of messages.
        factor: [2^n] the discount of the *explain* that follows each set.
    """

    model: SearchModel
    width: int
    plans: NDArray[np.float64]
    floor: NDArray[np.float64]
    price: NDArray[np.float64]
    factor: NDArray[np.float64]


class Store(NamedTuple):
    """The results of a search.

    The lengths ``nodes``, ``actions``, ``answers``, ``sets`` and ``rows`` grow during the search.

    Attributes:
        used: [8] counts of used elements; NODES … HASHED are the positions.
        nodes: [nodes] records NODE.
        belief: [nodes, S] the belief of each node.
        alpha: [nodes, S] an alpha vector of each node: the values by state of a policy.
        asked: [nodes, words] bits of the questions that were asked on the way to the node.
        actions: [actions] records ACTION; the actions of a node are side by side.
        answers: [answers] records ANSWER; the answers to an action are side by side.
        likelihood: [answers, S] P(answer | s).
        sets: [sets] bitmasks of messages; the message sets of a place are side by side.
        base: [sets, S] the immediate reward of each message set by state.
        over, under: [sets, S] upper and lower bounds of the value of each message set by state.
        places: [m, number of v] records PLACE, by (k, v). The field ``row`` is the place's index in
            the next six arrays.
        published: [rows, 2] the numbers of alpha vectors and of upper bounds that were published at
            a place. The last KEPT of each are in the next five arrays.
        vector: [rows, KEPT, S] published alpha vectors.
        peak: [rows, KEPT, S] the beliefs of the published upper bounds.
        height: [rows, KEPT] published upper bounds.
        by: [rows, KEPT] the first action of the policy of each alpha vector: a bitmask of messages,
            or ~q for question q.
        source: [rows, KEPT, 2] the node that published each alpha vector, and each upper bound.
        table: [.] hash table (open addressing) of nodes by (k, v, belief, asked).
    """

    used: NDArray[np.int64]
    nodes: NDArray[np.void]
    belief: NDArray[np.float64]
    alpha: NDArray[np.float64]
    asked: NDArray[np.int64]
    actions: NDArray[np.void]
    answers: NDArray[np.void]
    likelihood: NDArray[np.float64]
    sets: NDArray[np.int64]
    base: NDArray[np.float64]
    over: NDArray[np.float64]
    under: NDArray[np.float64]
    places: NDArray[np.void]
    published: NDArray[np.int64]
    vector: NDArray[np.float64]
    peak: NDArray[np.float64]
    height: NDArray[np.float64]
    by: NDArray[np.int64]
    source: NDArray[np.int64]
    table: NDArray[np.int32]


class Scratch(NamedTuple):
    """The scratch memory of one search.

    Labels with equal probabilities P(answer 1 | s) in all possible states form a group; an answer
    to *explain* is the number of 1s in each group. :func:`_list_answers` treats the groups one
    after the other.

    Attributes:
        like: [answers, S] a row for each combination of numbers of 1s in the groups treated so far:
            the probability of this combination given s.
        more: [answers, S] the same probabilities, including the group that is treated now.
        belief: [S] the belief before the answers to an action.
        after: [S] the belief after an answer, or the alpha vector of the node after it.
        tail: [S] the probability given s of all answers that are left out.
        asked: [words] bits of the asked questions, as in :class:`Store`.
        ways: [m + 1, S] the probability given s that the first c labels of a group are 1 and all
            others are 0, for each number c.
        under: [2^n, S] lower bounds of the value of each message set, by state.
        news: [Q] the information of each question's answer.
        cells: [S] the cells at which tables of questions are read.
        path: [levels] the nodes of a trial.
        taken: [levels] the actions that the trial took at these nodes.
        gaps: [levels] the gaps of these nodes when the trial reached them.
    """

    like: NDArray[np.float64]
    more: NDArray[np.float64]
    belief: NDArray[np.float64]
    after: NDArray[np.float64]
    tail: NDArray[np.float64]
    asked: NDArray[np.int64]
    ways: NDArray[np.float64]
    under: NDArray[np.float64]
    news: NDArray[np.float64]
    cells: NDArray[np.int64]
    path: NDArray[np.int64]
    taken: NDArray[np.int64]
    gaps: NDArray[np.float64]


@search
def sample(tables, store, scratch, order, least, gap, tail_gap, opened, work):  # type: ignore[no-untyped-def]
    """Improves the bounds of the nodes in ``order``: by the bounds that nodes with the same (k, v)
    published (``vector`` and ``height`` in :class:`Store`), and by a backup of each node. Then runs
    trials from the root until a limit is reached.

    Args:
        tables, store, scratch: the data, the results so far, and scratch memory.
        order: the nodes to back up before the trials, later steps first.
        least: the least improvement that is published when these nodes are backed up
            (:func:`_publish`).
        gap: trials end when the root's gap is at most this number.
        tail_gap: the gap that unlikely answers to one action may cause (:func:`_expand_action`).
        opened: trials end when the store has this number of opened nodes.
        work: trials end when ``store.used[WORK]``, the count of processed answers and message sets,
            has grown by this number during the trials.

    Returns:
        DONE, WORKING (call again), or FULL (grow the store and the scratch, call again).
    """
    _rehash(store)
    for index in order:
        node = store.nodes[index]
        upper, lower = node.upper, node.lower
        _improve_bounds(tables, store, index)
        for a in range(node.first_action, node.first_action + node.n_actions):
            if store.actions[a].first_answer >= 0:
                _back_up(store, index, a)
        if node.first_action >= 0:
            _publish(tables, store, scratch, index, upper, lower, least)
    stop, root, status = store.used[WORK] + work, store.nodes[ROOT], DONE
    while root.first_action < 0 or (root.upper - root.lower > gap and store.used[OPENED] < opened):
        if store.used[WORK] >= stop:
            status = WORKING
            break
        found = store.used[OPENED] + store.used[ANSWERS]
        last = _run_trial(tables, store, scratch, gap, tail_gap)
        moved = _back_up_trial(tables, store, scratch, last, NEWS * gap)
        if scratch.taken[last] == NO_ROOM:
            status = FULL
            break
        if not moved and found == store.used[OPENED] + store.used[ANSWERS]:
            break  # only rounding is left
    return status


@search
def make_plans(known, explain, cost, price, discounts, plans):  # type: ignore[no-untyped-def]
    """Computes the plan that is optimal for each of N known types, and the values of this plan for
    all types. Messages must always correct the fact.

    Args:
        known: [m + 1, cells] V of known types.
        explain: [m, cells] Q of *explain* for known types.
        cost: [m, cells] the expected cost of *explain*.
        price: [n] the price of each message.
        discounts: γ of *explain* and γ' of a message.
        plans: [N + 1, m + 1, cells] receives the values of the N plans; the last element, the plan
            without messages, does not change.
    """
    types, sets = len(plans) - 1, cost.shape[1] // (len(plans) - 1)
    for k in range(len(cost) - 1, -1, -1):
        for u in range(types):
            for given in range(sets - 1, -1, -1):
                at, best, chosen = given * types, explain[k, given * types + u], NONE
                for j in range(len(price)):
                    value = discounts[1] * known[k, (given | 1 << j) * types + u] - price[j]
                    if not given >> j & 1 and value > best + HAIR:
                        best, chosen = value, j
                for t in range(types):
                    if chosen < 0:
                        value = discounts[0] * plans[u, k + 1, at + t] - cost[k, at + t]
                    else:
                        value = discounts[1] * plans[u, k, (given | 1 << chosen) * types + t]
                        value -= price[chosen]
                    plans[u, k, at + t] = value


@part
def _run_trial(tables, store, scratch, gap, tail_gap):  # type: ignore[no-untyped-def]
    """Runs one trial: a path of nodes from the root. At each node, the trial takes the action with
    the best upper bound, and goes to the node after one of its answers: the node with the largest
    product of the answer's weight and the node's gap minus the allowed gap. Returns the last
    position in ``scratch.path``."""
    level, index, allowed = 0, ROOT, gap
    while True:
        node = store.nodes[index]
        scratch.path[level], scratch.gaps[level] = index, node.upper - node.lower
        a = _choose_action(tables, store, scratch, index, allowed, tail_gap)
        scratch.taken[level] = a
        if a < 0:
            break
        action = store.actions[a]
        allowed = (allowed - action.tail_upper + action.tail_lower) / action.later
        widest, index = ROUNDING, np.int64(NONE)
        for o in range(action.first_answer, action.first_answer + action.n_answers):
            answer = store.answers[o]
            if answer.node >= 0:
                after = store.nodes[answer.node]
                excess = answer.weight * (after.upper - after.lower - allowed)
                if excess > widest:
                    widest, index = excess, answer.node
        store.used[WORK] += action.n_answers
        if index < 0:
            break
        level += 1
    return level


@part
def _back_up_trial(tables, store, scratch, last, least):  # type: ignore[no-untyped-def]
    """Backs up the nodes of a trial, and publishes improved bounds. Returns True if a bound
    changed."""
    moved = False
    for level in range(last, -1, -1):
        index, a = scratch.path[level], scratch.taken[level]
        node = store.nodes[index]
        if a >= 0:
            upper, lower, before = node.upper, node.lower, store.actions[a].upper
            _back_up(store, index, a)
            # The node's own bounds may come from other nodes of its place, and so hide this change.
            moved = moved or store.actions[a].upper < before
            _publish(tables, store, scratch, index, upper, lower, least)
        moved = moved or node.upper - node.lower < scratch.gaps[level]
    return moved


@part
def _choose_action(tables, store, scratch, index, allowed, tail_gap):  # type: ignore[no-untyped-def]
    """Opens a node, and expands the action with the best upper bound. If this makes another action
    the best, expands that action, too. Returns the best action; CLOSED if the node's gap is small
    enough or the best action ends the explanation, NO_ROOM if the store is full."""
    node, chosen = store.nodes[index], np.int64(CLOSED)
    if node.first_action < 0 and not _open_node(tables, store, scratch, index):
        chosen = np.int64(NO_ROOM)
    else:
        _improve_bounds(tables, store, index)
        while node.upper - node.lower > allowed + ROUNDING:
            best = node.first_action
            for a in range(best, best + node.n_actions):
                if store.actions[a].upper > store.actions[best].upper:
                    best = a
            if store.actions[best].first_answer >= 0:
                chosen = best
                break
            last = node.step == len(tables.model.explain_cost) - 1
            if last and store.actions[best].messages >= 0:
                break  # the action ends the explanation
            if not _expand_action(tables, store, scratch, index, best, tail_gap):
                chosen = np.int64(NO_ROOM)
                break
            _back_up(store, index, best)
    return chosen


@inner
def _back_up(store, index, a):  # type: ignore[no-untyped-def]
    """Computes both bounds of an expanded action and of its node, from the bounds of the answers'
    nodes."""
    node, action = store.nodes[index], store.actions[a]
    upper, lower = action.base + action.tail_upper, action.base + action.tail_lower
    for o in range(action.first_answer, action.first_answer + action.n_answers):
        answer = store.answers[o]
        if answer.node >= 0:
            upper += answer.weight * store.nodes[answer.node].upper
            lower += answer.weight * store.nodes[answer.node].lower
    store.used[WORK] += action.n_answers
    action.upper = min(action.upper, upper)
    action.lower = max(action.lower, min(lower, action.upper))
    best_upper, best_lower = -np.inf, node.lower
    for b in range(node.first_action, node.first_action + node.n_actions):
        best_upper = max(best_upper, store.actions[b].upper)
        best_lower = max(best_lower, store.actions[b].lower)
    # Rounding may make the upper bound slightly less than the lower one.
    node.upper = min(node.upper, max(best_upper, best_lower))
    node.lower = min(best_lower, node.upper)


@inner
def _improve_bounds(tables, store, index):  # type: ignore[no-untyped-def]
    """Improves a node's bounds by the bounds that were published at its place."""
    node, belief = store.nodes[index], store.belief[index]
    row = store.places[node.step, node.given].row
    for i in range(min(store.published[row, 0], KEPT) if row >= 0 else 0):
        value = min(_dot(belief, store.vector[row, i]), node.upper)
        if value > node.lower and _have_same_questions(store, index, store.source[row, i, 0]):
            messages, begin = store.by[row, i], node.first_action
            if begin < 0 or _raise_lower_bound(
                store, begin, begin + node.n_actions, messages, value
            ):
                node.lower, node.earned_by = value, messages
                _copy(store.vector[row, i], store.alpha[index])
    known = tables.model.value[node.step]
    first = node.given * tables.width
    for i in range(min(store.published[row, 1], KEPT) if row >= 0 else 0):
        if not _have_same_questions(store, index, store.source[row, i, 1]):
            continue
        share = 1.0
        for s in range(len(belief)):
            if store.peak[row, i, s] > 0.0:
                share = min(share, belief[s] / store.peak[row, i, s])
        if share > 0.0:
            value = share * store.height[row, i]
            for s in range(len(belief)):
                value += (belief[s] - share * store.peak[row, i, s]) * known[first + s]
            node.upper = min(node.upper, max(value, node.lower))


@part
def _raise_lower_bound(store, begin, end, messages, value):  # type: ignore[no-untyped-def]
    """Raises the lower bound of the action ``messages`` to ``value``. Some policy that begins with
    this action has at least this value. Returns False if the node does not have this action.

    Args:
        store: the results so far.
        begin, end: range of the node's actions.
        messages: the action: a bitmask of messages, or ~q for question q.
        value: the new lower bound.
    """
    found = False
    for a in range(begin, end):
        action = store.actions[a]
        if action.messages == messages:
            action.upper = max(action.upper, value)  # smaller only by rounding
            action.lower = max(action.lower, value)
            found = True
    return found


@part
def _have_same_questions(store, index, other):  # type: ignore[no-untyped-def]
    """Returns True if the same questions were asked on the way to two nodes. Bounds hold only for
    nodes with the same remaining questions."""
    alike = True
    for w in range(store.asked.shape[1]):
        alike &= store.asked[index, w] == store.asked[other, w]
    return alike


@inner
def _publish(tables, store, scratch, index, upper, lower, least):  # type: ignore[no-untyped-def]
    """Publishes a node's upper or lower bound for the other nodes of its place, if the bound has
    improved by more than ``least``.

    Args:
        tables, store, scratch: the data, the results so far, and scratch memory.
        index: the node.
        upper, lower: the node's bounds before they were improved.
        least: the least improvement that is published.
    """
    node = store.nodes[index]
    row = store.places[node.step, node.given].row
    if node.upper < upper - least:
        i = store.published[row, 1] % KEPT
        _copy(store.belief[index], store.peak[row, i])
        store.height[row, i], store.source[row, i, 1] = node.upper, index
        store.published[row, 1] += 1
    if node.lower > lower + least:
        best = node.first_action
        for a in range(best, best + node.n_actions):
            if store.actions[a].lower > store.actions[best].lower:
                best = a
        if store.actions[best].first_answer >= 0:
            _make_alpha(tables, store, scratch, index, best)
            i = store.published[row, 0] % KEPT
            _copy(store.alpha[index], store.vector[row, i])
            store.by[row, i], store.source[row, i, 0] = store.actions[best].messages, index
            store.published[row, 0] += 1


@part
def _make_alpha(tables, store, scratch, index, a):  # type: ignore[no-untyped-def]
    """Computes a node's alpha vector: the value by state of taking an expanded action and following
    the policies of the answers' nodes afterwards."""
    node, action, alpha = store.nodes[index], store.actions[a], store.alpha[index]
    belief, step, discount = scratch.belief, node.step, tables.model.discount
    _copy(store.belief[index], belief)
    shown = node.given
    if action.messages < 0:
        for s in range(len(alpha)):
            alpha[s] = -tables.model.question_cost
        discount = 1.0
    else:
        shown |= action.messages if tables.width > 0 else 0
        if tables.width == 0:
            _give_messages(tables.model.jump, tables.model.accept, action.messages, belief)
        for s in range(len(alpha)):
            alpha[s] = -tables.model.explain_cost[step, shown * tables.width + s]
    for o in range(action.first_answer, action.first_answer + action.n_answers):
        after = store.answers[o].node
        if after >= 0:
            _copy(store.alpha[after], scratch.after)
        else:
            for s in range(len(alpha)):
                scratch.after[s] = tables.plans[-1, step + 1, shown * tables.width + s]
        if tables.width == 0 and action.messages >= 0:
            _average_over_forgetting(tables.model.forget, scratch.after)
        for s in range(len(alpha)):
            alpha[s] += discount * store.likelihood[o, s] * scratch.after[s]
    for s in range(len(alpha)):
        if belief[s] <= 0.0:
            alpha[s] = tables.floor[step]
    if action.messages >= 0:
        if tables.width == 0:
            _average_over_giving(tables.model.jump, tables.model.accept, action.messages, alpha)
        for s in range(len(alpha)):
            alpha[s] = tables.factor[action.messages] * alpha[s] - tables.price[action.messages]
    for s in range(len(alpha)):
        if store.belief[index, s] <= 0.0:
            alpha[s] = tables.floor[step]
    store.used[WORK] += action.n_answers


@inner
def _open_node(tables, store, scratch, index):  # type: ignore[no-untyped-def]
    """Lists the actions that may be optimal at a node. Returns False if the store is full."""
    node, belief = store.nodes[index], store.belief[index]
    place = store.places[node.step, node.given]
    if place.row < 0 and not _list_sets(tables, store, scratch, node.step, node.given):
        return False
    begin = store.used[ACTIONS]
    if begin + place.n_sets + len(tables.model.asked_answered) > len(store.actions):
        return False
    best, end, lower = -np.inf, begin, node.lower
    for c in range(place.first_set, place.first_set + place.n_sets):
        upper = _dot(belief, store.over[c])
        # The best action is kept, even if rounding makes its bound less than the lower bound.
        if upper > best or not _is_below(upper, lower):
            action = store.actions[end]
            action.messages, action.upper = store.sets[c], upper
            action.base, action.later = _dot(belief, store.base[c]), tables.model.discount
            action.later *= tables.factor[store.sets[c]]
            action.lower = _dot(belief, store.under[c])
            if tables.width > 0:  # then the expected value of a plan does not depend on answers
                shown = node.given | action.messages
                plan = _find_best_plan(tables, belief, node.step + 1, shown)
                row = tables.plans[plan, node.step + 1]
                ahead = action.base + action.later * _dot_cells(belief, row, shown * tables.width)
                action.lower = max(action.lower, ahead)
            action.lower = min(action.lower, upper)
            end += 1
            lower = max(lower, action.lower)
        best = max(best, upper)
    said = best
    if len(tables.model.asked_answered) > 0:
        most = _dot_cells(belief, tables.model.value[node.step], node.given * tables.width)
        plan = _find_best_plan(tables, belief, node.step, node.given)
        least = _dot_cells(belief, tables.plans[plan, node.step], node.given * tables.width)
        most -= tables.model.question_cost
        most += HAIR * (1.0 - most)  # other bounds may be larger by rounding
        if not _is_below(most, lower):
            _rank_questions(tables, store, scratch, index)
            for q in range(len(tables.model.asked_answered)):
                if scratch.news[q] > NO_NEWS or ~q == node.earned_by:
                    action = store.actions[end]
                    action.messages, action.later = ~q, 1.0
                    action.base = -tables.model.question_cost
                    action.upper, action.lower = most, min(least - tables.model.question_cost, most)
                    end += 1
                    best = max(best, most)
    _raise_lower_bound(store, begin, end, node.earned_by, node.lower)
    for a in range(begin, end):
        lower = max(lower, store.actions[a].lower)
    kept = begin
    for a in range(begin, end):
        action = store.actions[a]
        # The best set of messages is always kept, because a node may have no questions left.
        spoken = action.messages >= 0 and action.upper == said
        if not _is_below(action.upper, lower) or action.upper == best or spoken:
            store.actions[kept] = action
            store.actions[kept].first_answer = NONE
            kept += 1
    node.first_action, node.n_actions = begin, kept - begin
    store.used[ACTIONS] = kept
    store.used[OPENED] += 1
    store.used[WORK] += place.n_sets
    node.upper = min(node.upper, max(best, lower))
    node.lower = min(lower, node.upper)
    return True


@part
def _list_sets(tables, store, scratch, step, given):  # type: ignore[no-untyped-def]
    """Lists the sets of messages that may be optimal at a place for some belief. A set is left out
    if, in every state, its upper bound is at most the lower bound of giving nothing, or of giving
    the set without one message. Returns False if the store is full."""
    states, all_sets = store.belief.shape[1], len(tables.price)
    begin, row = store.used[SETS], store.used[PLACES]
    free = (all_sets - 1) & ~given
    if begin + all_sets > len(store.sets) or row == len(store.published):
        return False
    end, chosen = begin, np.int64(0)
    while True:
        shown = (given | chosen if tables.width > 0 else 0) * tables.width
        base, over, under = store.base[end], store.over[end], scratch.under[chosen]
        for s in range(states):
            base[s] = -tables.model.explain_cost[step, shown + s]
            over[s] = tables.model.explain[step, shown + s]
            under[s] = tables.plans[-1, step, shown + s]
        if tables.width == 0:
            for vector in (base, over, under):
                _average_over_giving(tables.model.jump, tables.model.accept, chosen, vector)
        factor, price = tables.factor[chosen], tables.price[chosen]
        for vector in (base, over, under):
            for s in range(states):
                vector[s] = factor * vector[s] - price
        useful, left = chosen == 0 or not _is_dominated(over, scratch.under[0]), chosen
        while left and useful:
            useful = not _is_dominated(over, scratch.under[chosen ^ (left & -left)])
            left &= left - 1
        if useful:
            _copy(under, store.under[end])
            store.sets[end] = chosen
            end += 1
        chosen = (chosen - free) & free
        if chosen == 0:
            break
    place = store.places[step, given]
    place.first_set, place.n_sets, place.row = begin, end - begin, row
    store.used[PLACES] += 1
    store.used[SETS] = end
    store.used[WORK] += all_sets
    return True


@small
def _is_dominated(over, under):  # type: ignore[no-untyped-def]
    """Returns True if ``over`` is at most ``under`` in every state."""
    dominated = True
    for s in range(len(over)):
        dominated &= over[s] <= under[s]
    return dominated


@inner
def _expand_action(tables, store, scratch, index, a, gap):  # type: ignore[no-untyped-def]
    """Makes the nodes of the answers to an action. Unlikely answers are left out while this widens
    the gap by at most ``gap``. Returns False if the store or the scratch memory is full."""
    node, action, belief = store.nodes[index], store.actions[a], scratch.belief
    step, given, messages = node.step, node.given, action.messages
    _copy(store.belief[index], belief)
    _copy(store.asked[index], scratch.asked)
    action.tail_upper, action.tail_lower = 0.0, 0.0
    like, count = scratch.like, 2
    if messages < 0:
        scratch.asked[~messages // WORD] |= 1 << (~messages % WORD)
        for s in range(len(belief)):
            scratch.tail[s] = 0.0
            cell = find_cell(tables.model.question_stride, given, s)
            like[1, s] = tables.model.asked_answered[~messages, cell]
            like[0, s] = 1.0 - like[1, s]
    else:
        if tables.width == 0:
            _give_messages(tables.model.jump, tables.model.accept, messages, belief)
            given = np.int64(0)
        else:
            given |= messages
        negligible = 0.1 * gap
        while True:
            count, like = _list_answers(
                tables.model.answered, scratch, step, given * tables.width, belief, negligible
            )
            if count < 0:
                return False
            for s in range(len(belief)):
                scratch.after[s] = scratch.tail[s] * belief[s]
            if tables.width == 0:
                forget(tables.model.forget, scratch.after)
            upper = _dot_cells(scratch.after, tables.model.value[step + 1], given * tables.width)
            lower = _dot_cells(scratch.after, tables.plans[-1, step + 1], given * tables.width)
            action.tail_upper, action.tail_lower = action.later * upper, action.later * lower
            if action.tail_upper - action.tail_lower <= gap or negligible == 0.0:
                break
            negligible = negligible * 0.2 if negligible > 1e-18 else 0.0
        step += 1
    begin = store.used[ANSWERS]
    if begin + count >= len(store.answers) or store.used[NODES] + count > len(store.nodes):
        return False
    end = begin
    for o in range(count + 1):
        total = 0.0
        for s in range(len(belief)):
            likelihood = like[o, s] if o < count else scratch.tail[s]
            store.likelihood[end, s] = likelihood
            scratch.after[s] = belief[s] * likelihood
            total += scratch.after[s]
        if total > 0.0:
            store.answers[end].weight, store.answers[end].node = action.later * total, NONE
            if o < count:
                for s in range(len(belief)):
                    scratch.after[s] /= total
                if tables.width == 0 and messages >= 0:
                    forget(tables.model.forget, scratch.after)
                after = _get_node(tables, store, step, given, scratch.after, scratch.asked)
                store.answers[end].node = after
            end += 1
    store.used[ANSWERS] = end
    store.used[WORK] += 4 * count
    action.first_answer, action.n_answers = begin, end - begin
    return True


@part
def _list_answers(answered, scratch, step, first, belief, negligible):  # type: ignore[no-untyped-def]
    """Lists the answers to *explain* with probabilities above ``negligible``. ``scratch.tail``
    receives the probability given s of all other answers.

    Labels with equal probabilities P(answer 1 | s) in all possible states are exchangeable and form
    a group. So an answer is the number of 1s in each group.

    Returns:
        The number of listed answers (−1 if there is not enough memory), and an array whose first
        rows are P(answer | s) of these answers.
    """
    states = len(belief)
    like, more, count = scratch.like, scratch.more, 1
    for s in range(states):
        like[0, s] = 1.0 if belief[s] > 0.0 else 0.0
        scratch.tail[s] = 0.0
    for i in range(step + 1):
        size = _count_equal_labels(answered, step, i, first, belief)
        if size == 0 or count < 0:
            continue
        for s in range(states):
            yes = answered[i, first + s]
            for ones in range(size + 1):
                scratch.ways[ones, s] = yes**ones * (1.0 - yes) ** (size - ones)
        found = 0
        for row in range(count):
            choose = 1.0
            for ones in range(size + 1):
                if found == len(more):
                    return -1, like
                total = 0.0
                for s in range(states):
                    more[found, s] = like[row, s] * choose * scratch.ways[ones, s]
                    total += belief[s] * more[found, s]
                if total > negligible:
                    found += 1
                else:
                    for s in range(states):
                        scratch.tail[s] += more[found, s]
                choose *= (size - ones) / (ones + 1)
        like, more, count = more, like, found
    return count, like


@small
def _count_equal_labels(answered, step, i, first, belief):  # type: ignore[no-untyped-def]
    """Counts the labels of a prefix that have the same P(answer 1 | s) as label i in all possible
    states. Returns 0 if i is not the first of these labels, or if P(answer 1 | s) of label i is the
    same in all possible states."""
    size, news, one = 0, False, -1
    for s in range(len(belief)):
        if belief[s] > 0.0:
            if one < 0:
                one = s
            news |= answered[i, first + s] != answered[i, first + one]
    for j in range(step + 1 if news else 0):
        same = True
        for s in range(len(belief)):
            if belief[s] > 0.0:
                same &= answered[i, first + s] == answered[j, first + s]
        if same and j < i:
            size = 0
            break
        size += same
    return size


@part
def _rank_questions(tables, store, scratch, index):  # type: ignore[no-untyped-def]
    """Computes in ``scratch.news`` [Q] the information of each question that may be asked at a
    node."""
    node, asked = store.nodes[index], store.asked[index]
    left = tables.model.most
    for q in range(len(tables.model.asked_answered)):
        left -= asked[q // WORD] >> (q % WORD) & 1
    closed = left <= 0 or (tables.model.first and (node.step > 0 or node.given > 0))
    for q in range(len(tables.model.asked_answered)):
        known = asked[q // WORD] >> (q % WORD) & 1 == 1
        scratch.news[q] = -1.0 if closed or known else 0.0
    for s in range(len(scratch.cells)):
        scratch.cells[s] = find_cell(tables.model.question_stride, node.given, s)
    belief, model = store.belief[index], tables.model
    rank_questions(model.asked_answered, model.likelier, scratch.cells, belief, scratch.news)


@part
def _get_node(tables, store, step, given, belief, asked):  # type: ignore[no-untyped-def]
    """Returns the node of a belief. If there is none, makes a node with its first bounds."""
    slot = _find_slot(store, step, given, belief, asked)
    index = np.int64(store.table[slot])
    if index < 0:
        index = store.used[NODES]
        store.used[NODES] += 1
        store.used[HASHED] += 1
        store.table[slot] = index
        node = store.nodes[index]
        node.step, node.given, node.first_action, node.n_actions = step, given, NONE, 0
        node.earned_by = SILENCE
        _copy(belief, store.belief[index])
        _copy(asked, store.asked[index])
        plan = _find_best_plan(tables, belief, step, given)
        for s in range(len(belief)):
            store.alpha[index, s] = tables.plans[plan, step, given * tables.width + s]
        node.upper = _dot_cells(belief, tables.model.value[step], given * tables.width)
        node.lower = min(_dot(belief, store.alpha[index]), node.upper)
        _improve_bounds(tables, store, index)
    return index


@inner
def _find_best_plan(tables, belief, step, given):  # type: ignore[no-untyped-def]
    """Returns the plan with the largest value at (k, v) and a belief."""
    best, most = 0, -np.inf
    for u in range(len(tables.plans)):
        value = _dot_cells(belief, tables.plans[u, step], given * tables.width)
        if value > most:
            best, most = u, value
    return best


@inner
def _find_slot(store, step, given, belief, asked):  # type: ignore[no-untyped-def]
    """Returns the slot of this belief's node, or the free slot where the node belongs."""
    mask = uint64(len(store.table) - 1)
    h = uint64(step) * GOLDEN ^ uint64(given)
    for s in range(len(belief)):
        h = splitmix64((h + GOLDEN) ^ uint64(np.int64(belief[s] * GRAIN + 0.5)))
    for w in range(len(asked)):
        h = splitmix64((h + GOLDEN) ^ uint64(asked[w]))
    slot = h & mask
    while True:
        index = store.table[slot]
        if index < 0:
            break
        node = store.nodes[index]
        same = node.step == step and node.given == given
        for s in range(len(belief) if same else 0):
            rounded = np.int64(store.belief[index, s] * GRAIN + 0.5)
            same &= rounded == np.int64(belief[s] * GRAIN + 0.5)
        for w in range(len(asked)):
            same &= store.asked[index, w] == asked[w]
        if same:
            break
        slot = (slot + uint64(1)) & mask
    return slot


@part
def _rehash(store):  # type: ignore[no-untyped-def]
    """Adds the missing nodes to the hash table, after the store has grown."""
    while store.used[HASHED] < store.used[NODES]:
        index = store.used[HASHED]
        node = store.nodes[index]
        slot = _find_slot(store, node.step, node.given, store.belief[index], store.asked[index])
        store.table[slot] = index
        store.used[HASHED] += 1


@small
def _give_messages(jump, accept, messages, belief):  # type: ignore[no-untyped-def]
    """Updates a belief in place, after each message of a bitmask was given."""
    left = messages
    while left:
        give(jump[first_bit(left)], accept, belief)
        left &= left - 1


@small
def _average_over_giving(jumps, accept, messages, values):  # type: ignore[no-untyped-def]
    """Replaces values v by E[v(s') | s], where s' is the state after each message of a bitmask was
    given."""
    left = messages
    while left:
        jump = jumps[first_bit(left)]
        left &= left - 1
        for s in range(len(values)):
            if jump[s] > 0:
                values[s] += accept[s] * (values[s + jump[s]] - values[s])


@small
def _average_over_forgetting(lose, values):  # type: ignore[no-untyped-def]
    """Replaces values v by E[v(s') | s], where s' is the state after facts were forgotten."""
    types = len(lose)
    bit = types
    while bit < len(values):
        for s in range(len(values)):
            if s // bit % 2 == 1:
                values[s] += lose[s % types] * (values[s - bit] - values[s])
        bit *= 2


@small
def _dot(belief, values):  # type: ignore[no-untyped-def]
    """Returns Σ_s b(s) x(s)."""
    total = 0.0
    for s in range(len(belief)):
        total += belief[s] * values[s]
    return total


@small
def _dot_cells(belief, row, first):  # type: ignore[no-untyped-def]
    """Returns Σ_s b(s) x(v, s) for a row x of a table; ``first`` is the cell of (v, 0)."""
    total = 0.0
    for s in range(len(belief)):
        total += belief[s] * row[first + s]
    return total


@small
def _copy(source, target):  # type: ignore[no-untyped-def]
    """Copies an array. (``target[:] = source`` would allocate memory.)"""
    for i in range(len(target)):
        target[i] = source[i]


@small
def _is_below(upper, lower):  # type: ignore[no-untyped-def]
    """Returns True if an upper bound is below a lower bound by more than rounding."""
    return upper < lower - HAIR * (1.0 + abs(lower))
