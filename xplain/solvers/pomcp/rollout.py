"""What a history is worth before there is a tree below it: QMDP's value, or a rollout's return.

``model`` is a :class:`~xplain.solvers.pomcp.search_model.SearchModel`, ``tree`` a
:class:`~xplain.solvers.pomcp.tree.Tree`; (step, given, belief) is
the history's (k, H, b).
"""

from __future__ import annotations

from xplain.numba_kernels import inlined
from xplain.solvers.bits import first_bit
from xplain.solvers.count_lattice import copy
from xplain.solvers.pomcp.labels import draw_labels, update_belief
from xplain.solvers.pomcp.search_model import SETTLED, wanted_at
from xplain.solvers.rows import find_rows

CERTAIN = 1 - 1e-6
"""A belief from here on counts as certainty in rollouts."""
ROUNDING = 1e-12
"""Messages worth the same but for this are equal, the first is taken."""


@inlined
def leaf_value(model, tree, step, given, belief):  # type: ignore[no-untyped-def]
    """Where simulations end: max_a Σ_t b(t) Q_t(k, H, a)."""
    find_rows(model.reduced.rows.part, given, tree.rows)
    wanted = wanted_at(model, step, given, tree.rows)
    return _qmdp(model, tree.gain, tree.rows, step, max(wanted, 0), belief)[0]


@inlined
def _qmdp(model, gain, rows, step, messages, belief):  # type: ignore[no-untyped-def]
    """max_a Σ_t b(t) Q_t(k, H, a) over *explain* and these messages, and the action (n is
    *explain*). A message changes what it is worth to give only for the types that it matters to:
    ``gain`` [n], all 0 between calls, sums that up. ``rows``: [N] of H."""
    price, relevant, place = (
        model.reduced.price,
        model.reduced.rows.relevant,
        model.reduced.rows.place,
    )
    best, base, action = 0.0, 0.0, len(price)
    for t in range(len(belief)):
        at = rows[t]
        now = model.optimal[step, at, t]
        base += belief[t] * now
        later = model.reduced.discount * model.optimal[step + 1, at, t]
        best += belief[t] * (later - model.explain_cost[at, step, t])
        left = messages & relevant[t]
        while left:
            j = first_bit(left)
            left &= left - 1
            gain[j] += belief[t] * (model.optimal[step, at + place[j, t], t] - now)
    while messages:
        j = first_bit(messages)
        messages &= messages - 1
        value = model.reduced.message_discount * (base + gain[j]) - price[j]
        gain[j] = 0.0
        if value > best + ROUNDING:
            best, action = value, j
    return best, action


@inlined
def roll_qmdp(model, tree, step, given, t, belief):  # type: ignore[no-untyped-def]
    """The return of following QMDP with exact beliefs, for a user of type t. Once t is certain QMDP
    acts as if it were known, and where nothing is worth saying to anybody any more it says nothing:
    V*_t is the rest of the return."""
    steps, reduced, rows = model.explain_cost.shape[1], model.reduced, tree.rows
    copy(belief, tree.rollout_belief)
    find_rows(reduced.rows.part, given, rows)
    value, scale = 0.0, 1.0
    while step < steps:
        wanted = wanted_at(model, step, given, rows)
        if tree.rollout_belief[t] > CERTAIN or wanted == SETTLED:
            return value + scale * model.optimal[step, rows[t], t]
        action = len(reduced.price)
        if wanted != 0:
            _, action = _qmdp(model, tree.gain, rows, step, wanted, tree.rollout_belief)
        if action < len(reduced.price):
            value -= scale * reduced.price[action]
            scale *= reduced.message_discount
            given |= 1 << action
            for u in range(len(rows)):
                rows[u] += reduced.rows.place[action, u]
        else:
            value -= scale * model.explain_cost[rows[t], step, t]
            scale *= reduced.discount
            if step + 1 < steps:
                code = draw_labels(model, tree, step, given, t)
                update_belief(model, tree, step, given, t, code, tree.rollout_belief)
            step += 1
    return value
