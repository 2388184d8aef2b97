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
from xplain.numba_kernels import kernel
from xplain.solvers.dynamic_programming import message_discount, message_price, optimal_values
from xplain.solvers.hsvi.pair_bounds import Pairs, no_pairs


class Tables(NamedTuple):
    """The problem as the kernels want it.

    Attributes:
        p: [N, m, 2^n] P(label 1).
        values: [m + 1, 2^n, N] V*_t.
        explain: [m, 2^n, N] Q*_t of *explain*.
        plans: [m + 1, 2^n, N + 1, N] value of plan u (the last is silence) for type t.
        price, factor: [2^n] discounted price of a set of messages, and what discounts the
            *explain* after it.
        message_price: [n] λ C_e.
        discount, message_discount: γ, γ'.
        pairs: tighter above than ``values``, where a search found them worth making.
    """

    p: NDArray[np.float64]
    values: NDArray[np.float64]
    explain: NDArray[np.float64]
    plans: NDArray[np.float64]
    price: NDArray[np.float64]
    factor: NDArray[np.float64]
    message_price: NDArray[np.float64]
    discount: float
    message_discount: float
    pairs: Pairs


def table_bytes(problem: Problem) -> int:
    """What :func:`make_tables` takes."""
    types = problem.n_types
    per_entry = types * (types + 1) + 2 * types
    return (problem.n_steps + 1) * int(problem.p_explicable.shape[2]) * per_entry * 8


def make_tables(problem: Problem) -> Tables:
    """Known-type values and the plans' values, by dynamic programming."""
    p = problem.p_explicable
    types, steps, sets = p.shape
    per_message, prices = message_discount(problem), message_price(problem)
    values = optimal_values(problem)
    explain = np.empty((steps, sets, types))
    plans = np.zeros((steps + 1, sets, types + 1, types))
    costs = problem.inexplicability_cost, problem.discount, per_message
    for k in reversed(range(steps)):
        _plan_step(p, k, values, prices, *costs, explain, plans)
    price, factor = set_prices(problem)
    scalars = problem.discount, per_message
    return Tables(p, values, explain, plans, price, factor, prices, *scalars, no_pairs(problem))


def set_prices(problem: Problem) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """For every set of messages [2^n], given the cheapest first, as is best where giving them
    discounts: its discounted price, and what discounts the *explain* after it."""
    prices, per_message = message_price(problem), message_discount(problem)
    sets = np.arange(1 << problem.n_messages)
    price, factor = np.zeros(len(sets)), np.ones(len(sets))
    for j in np.argsort(prices, kind="stable"):
        has = sets >> j & 1 == 1
        price[has] += factor[has] * prices[j]
        factor[has] *= per_message
    return price, factor


@kernel
def _plan_step(  # type: ignore[no-untyped-def]
    p, k, values, prices, inexplicability, discount, message_discount, explain, plans
):
    types, _, sets = p.shape
    zeros = np.empty(types)
    for given in range(sets - 1, -1, -1):
        for t in range(types):
            zeros[t] = 0.0
            for i in range(k + 1):
                zeros[t] += inexplicability * (1.0 - p[t, i, given])
            explain[k, given, t] = discount * values[k + 1, given, t] - zeros[t]
        for u in range(types + 1):
            best, message = -np.inf, -1
            if u < types:
                best = explain[k, given, u] + 1e-12
                for j in range(len(prices)):
                    if not given >> j & 1:
                        value = message_discount * values[k, given | 1 << j, u] - prices[j]
                        if value > best:
                            best, message = value, j
            for t in range(types):
                if message < 0:
                    plans[k, given, u, t] = discount * plans[k + 1, given, u, t] - zeros[t]
                else:
                    after = plans[k, given | 1 << message, u, t]
                    plans[k, given, u, t] = message_discount * after - prices[message]
