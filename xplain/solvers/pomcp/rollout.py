"""What a history is worth before there is a tree below it: QMDP's value, or a rollout's return.

``model`` is a :class:`~xplain.solvers.pomcp.search_model.SearchModel`, ``tree`` a
:class:`~xplain.solvers.pomcp.tree.Tree`; (step, given, belief) is
the history's (k, H, b).
"""

from __future__ import annotations

import numpy as np

from xplain.numba_kernels import inlined
from xplain.solvers.bits import count_bits, first_bit, nth_bit
from xplain.solvers.pomcp.labels import draw_labels, update_belief
from xplain.solvers.pomcp.random_words import next_below
from xplain.solvers.pomcp.search_model import SETTLED, wanted_at
from xplain.solvers.rows import row

CERTAIN = 1 - 1e-6
"""A belief from here on counts as certainty in rollouts."""
ROUNDING = 1e-12
"""Messages worth the same but for this are equal, the first is taken."""

MAX_OF_MEAN, MEAN_OF_MAX = 0, 1
RANDOM, QMDP, SILENT = 0, 1, 2


@inlined
def leaf_value(model, gain, reading, step, given, belief):  # type: ignore[no-untyped-def]
    """Where simulations end: max_a Σ_t b(t) Q_t(k, H, a), or Σ_t b(t) V*_t(k, H)."""
    if reading == MAX_OF_MEAN:
        return _qmdp(model.rows, model, gain, step, given, belief)[0]
    value = 0.0
    for t in range(len(belief)):
        value += belief[t] * model.optimal[step, row(model.rows, given, t), t]
    return value


@inlined
def _qmdp(rows, model, gain, step, given, belief):  # type: ignore[no-untyped-def]
    """max_a Σ_t b(t) Q_t(k, H, a), and the action (n is *explain*)."""
    if rows is None:
        return _qmdp_dense(model, step, given, belief)
    return _qmdp_by_type(rows, model, gain, step, given, belief)


@inlined
def _qmdp_dense(model, step, given, belief):  # type: ignore[no-untyped-def]
    best = 0.0
    for t in range(len(belief)):
        later = model.discount * model.optimal[step + 1, given, t]
        best += belief[t] * (later - model.explain_cost[given, step, t])
    action = len(model.price)
    messages = wanted_at(model.rows, model.wanted, step, given)
    if messages == SETTLED:
        return best, action
    while messages:
        j = first_bit(messages)
        messages &= messages - 1
        value = 0.0
        for t in range(len(belief)):
            value += belief[t] * model.optimal[step, given | 1 << j, t]
        value = model.message_discount * value - model.price[j]
        if value > best:
            best, action = value, j
    return best, action


@inlined
def _qmdp_by_type(rows, model, gain, step, given, belief):  # type: ignore[no-untyped-def]
    """A message changes what it is worth to give only for the types that it matters to: ``gain``
    [n], all 0 between calls, sums that up."""
    best, base = 0.0, 0.0
    messages = 0
    for t in range(len(belief)):
        at = row(rows, given, t)
        now = model.optimal[step, at, t]
        later = model.discount * model.optimal[step + 1, at, t]
        base += belief[t] * now
        best += belief[t] * (later - model.explain_cost[at, step, t])
        messages |= max(model.wanted[at, step, t], 0)
        for c in range(rows.mask.shape[1]):
            left = rows.mask[t, c] & ~given
            if left:
                more = belief[t] * (model.optimal[step, at + rows.stride[t, c], t] - now)
                while left:
                    gain[first_bit(left)] += more
                    left &= left - 1
    messages &= ~given
    action = len(model.price)
    while messages:
        j = first_bit(messages)
        messages &= messages - 1
        value = model.message_discount * (base + gain[j]) - model.price[j]
        if value > best + ROUNDING:
            best, action = value, j
    for j in range(len(gain)):
        gain[j] = 0.0
    return best, action


@inlined
def roll_random(model, counter, step, given, t):  # type: ignore[no-untyped-def]
    """The return of uniformly random actions, for a user of type t. Once all messages are given
    only *explain* is left, and V*_t is the rest."""
    free = np.int64(((1 << len(model.price)) - 1) & ~given)
    count = count_bits(free)
    value, scale = 0.0, 1.0
    while step < model.explain_cost.shape[1]:
        if count == 0:
            return value + scale * model.optimal[step, row(model.rows, given, t), t]
        choice = next_below(counter, count + 1)
        if choice == count:
            value -= scale * model.explain_cost[row(model.rows, given, t), step, t]
            scale *= model.discount
            step += 1
        else:
            j = nth_bit(free, choice)
            value -= scale * model.price[j]
            scale *= model.message_discount
            free ^= 1 << j
            given |= 1 << j
            count -= 1
    return value


@inlined
def roll_silent(model, step, given, belief):  # type: ignore[no-untyped-def]
    """The expected return of saying nothing more."""
    value, scale = 0.0, 1.0
    for k in range(step, model.explain_cost.shape[1]):
        for t in range(len(belief)):
            value -= scale * belief[t] * model.explain_cost[row(model.rows, given, t), k, t]
        scale *= model.discount
    return value


@inlined
def roll_qmdp(model, tree, step, given, t, belief):  # type: ignore[no-untyped-def]
    """The return of following QMDP with exact beliefs, for a user of type t. Once t is certain QMDP
    acts as if it were known, and where nothing is worth saying to anybody any more it says nothing:
    V*_t is the rest of the return."""
    steps = model.explain_cost.shape[1]
    for other in range(len(belief)):
        tree.rollout_belief[other] = belief[other]
    value, scale = 0.0, 1.0
    while step < steps:
        wanted = wanted_at(model.rows, model.wanted, step, given)
        if tree.rollout_belief[t] > CERTAIN or wanted == SETTLED:
            return value + scale * model.optimal[step, row(model.rows, given, t), t]
        action = len(model.price)
        if wanted != 0:
            _, action = _qmdp(model.rows, model, tree.gain, step, given, tree.rollout_belief)
        if action < len(model.price):
            value -= scale * model.price[action]
            scale *= model.message_discount
            given |= 1 << action
        else:
            value -= scale * model.explain_cost[row(model.rows, given, t), step, t]
            scale *= model.discount
            if step + 1 < steps:
                code = draw_labels(model, tree, step, given, t)
                update_belief(model, tree, step, given, t, code, tree.rollout_belief)
            step += 1
    return value
