"""Tables that bound the optimum at every (k, H) and every belief at once.

Above, the optimal values of known types (QMDP). Below, the exact values of plans that heed no
answer, each type's optimal plan and silence: linear in the belief, so a table of their values for
every type is all that is needed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, kernel
from xplain.solvers.inquiry import Room, make_room
from xplain.solvers.model import (
    Model,
    SetPrices,
    backwards,
    dense_table_bytes,
    explain_costs,
    model_of,
    optimal_values,
    set_prices,
    with_all_messages,
)


class BoundTables(NamedTuple):
    """What the search reads.

    Attributes:
        model: the problem's.
        optimal: [m + 1, 2^n, N] V*_t.
        explain: [m, 2^n, N] Q*_t of *explain*.
        plans: [m + 1, 2^n, N + 1, N] value of plan u (the last is silence) for type t.
        sets: prices and discounts of sets of messages.
        room: to look at questions in.
    """

    model: Model
    optimal: NDArray[np.float64]
    explain: NDArray[np.float64]
    plans: NDArray[np.float64]
    sets: SetPrices
    room: Room


def table_bytes(problem: Problem) -> int:
    """Memory that :func:`make_tables` takes, in bytes."""
    return dense_table_bytes(problem) * (problem.n_types + 4)


def make_tables(problem: Problem) -> BoundTables:
    """Known-type values and the plans' values of a dense problem, by dynamic programming."""
    model = with_all_messages(model_of(problem))
    optimal, costs = optimal_values(model), explain_costs(model)
    explain = model.discount * optimal[1:] - costs
    types = model.n_types
    plans = np.zeros((model.n_steps + 1, model.n_rows, types + 1, types))
    for first, end in backwards(model):
        _plan(model, costs, optimal, explain, plans, first, end)
    room = make_room(model.inquiry)
    return BoundTables(model, optimal, explain, plans, set_prices(model), room)


@kernel
def _plan(model, costs, optimal, explain, plans, first, end):  # type: ignore[no-untyped-def]
    """Fills ``plans`` [m + 1, 2^n, N + 1, N] from step ``end`` − 1 down to ``first``. ``costs`` and
    ``explain`` are [m, 2^n, N], ``optimal`` [m + 1, 2^n, N]."""
    _, sets, types = costs.shape
    for k in range(end - 1, first - 1, -1):
        for given in range(sets - 1, -1, -1):
            for u in range(types + 1):
                message = -1
                if u < types:
                    message = _best_message(model, explain[k, given, u], optimal[k], given, u)
                for t in range(types):
                    if message < 0:
                        later = model.discount * plans[k + 1, given, u, t]
                        plans[k, given, u, t] = later - costs[k, given, t]
                    else:
                        later = model.message_discount * plans[k, given | 1 << message, u, t]
                        plans[k, given, u, t] = later - model.price[message]


@inlined
def _best_message(model, explain, optimal, given, t):  # type: ignore[no-untyped-def]
    """What is best for type t at one k: a message, or −1 for *explain*, worth ``explain``."""
    best, message = explain + 1e-12, -1
    for j in range(len(model.price)):
        if not given >> j & 1:
            value = model.message_discount * optimal[given | 1 << j, t] - model.price[j]
            if value > best:
                best, message = value, j
    return message
