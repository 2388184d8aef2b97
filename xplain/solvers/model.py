"""The reduced POMDP of one problem, as arrays: what every solver stands on, kernels included.

Its states are (k, H, b): transitions shown, message set given, belief over the types
(docs/method.md §5). With the type t known, labels tell nothing, and it is an MDP on (k, H), solved
backwards in k (Bellman 1957). P[t, i, H] is the probability of label 1, transition i counted from
0, so that *explain* at k shows the transitions 0 … k:

    C_t(k, H) = C_t(k − 1, H) + C_inexp (1 − P[t, k, H]),              expected cost of *explain*
    Q_t(k, H) = −C_t(k, H) + γ V_t(k + 1, H),                          value of *explain*
    V_t(k, H) = max( Q_t(k, H), max_{j ∉ H} −λ C_e(j) + γ' V_t(k, H ∪ {j}) ),   V_t(m, ·) = 0,

with γ' = γ where every action discounts (the paper), 1 where only steps do. Every table here is
indexed [k, row, t], the types side by side, as beliefs want them (:mod:`xplain.solvers.rows`). In
a dense problem the row is H.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, lean_kernel, tell_when_compiling
from xplain.solvers.base import TIE
from xplain.solvers.inquiry import Inquiry, make_inquiry
from xplain.solvers.rows import Rows, make_rows, row, rows_at

BATCH = 1 << 20
"""Entries of a table that one call of a kernel fills, about: some hundredths of a second."""


class Model(NamedTuple):
    """N types, m steps, n messages. Making one takes little time and memory: tables are asked for.

    Attributes:
        p: [m, rows, N] P(label 1). Costs are made of it, in this module alone.
        answered: [m, rows, N] P(answer 1), the evidence; ``p`` itself where users do not err.
        price: [n] λ C_e(j) of each message.
        inexplicability: C_inexp.
        discount: γ, of *explain*.
        message_discount: γ', of a message.
        rows: where a type's row of H is.
        inquiry: the questions that may be asked.
    """

    p: NDArray[np.float64]
    answered: NDArray[np.float64]
    price: NDArray[np.float64]
    inexplicability: float
    discount: float
    message_discount: float
    rows: Rows
    inquiry: Inquiry

    @property
    def n_steps(self) -> int:
        """m, the number of steps."""
        return int(self.p.shape[0])

    @property
    def n_rows(self) -> int:
        """Rows of a table; 2^n, the number of message sets, where dense."""
        return int(self.p.shape[1])

    @property
    def n_types(self) -> int:
        """N, the number of user types."""
        return int(self.p.shape[2])


def model_of(problem: Problem) -> Model:
    """The reduced POMDP of a problem.

    Raises:
        InputError: users may miss or forget messages, so that a message said is no fact known.
        TooLargeError: too many rows.
    """
    if not problem.messages_land:
        raise InputError(
            "belief.accept, belief.forget",
            "set",
            "solver=qmdp, lookahead, pomcp or certified; or 1 and 0",
        )
    table, price = problem.table, problem.trade_off * problem.message_cost
    return Model(
        table.p,
        table.answered,
        price,
        problem.inexplicability_cost,
        problem.discount,
        problem.discount if problem.discount_per == "action" else 1.0,
        make_rows(table, price),
        make_inquiry(problem),
    )


def with_all_messages(model: Model) -> Model:
    """The model of a dense problem in which a known type may be given every message. One that
    changes nothing for this type, given for the sake of others, still puts off this type's costs:
    only so Σ_t b(t) V*_t bounds the optimum from above."""
    price = np.tile(model.price[:, None, None], (1, 1, model.n_types))
    return model._replace(rows=model.rows._replace(price=price))


def table_bytes(problem: Problem) -> int:
    """What one table [m + 1, rows, N] takes, at least."""
    steps, rows, types = problem.table.p.shape
    return int((steps + 1) * rows * types * 8)


def dense_table_bytes(problem: Problem) -> int:
    """What one table [m + 1, 2^n, N] takes."""
    return (problem.n_steps + 1 << problem.n_messages) * problem.n_types * 8


def explain_costs(model: Model) -> NDArray[np.float64]:
    """C_t(k, H) for all: [m, rows, N]."""
    return _accumulate(model, np.empty(model.p.shape))


def _accumulate(model: Model, costs: NDArray[np.float64]) -> NDArray[np.float64]:
    np.subtract(1, model.p, out=costs)
    costs *= model.inexplicability
    for k in range(1, len(costs)):
        costs[k] += costs[k - 1]
    return costs


def explain_cost_at(model: Model, step: int, given: int | NDArray[np.int64]) -> NDArray[np.float64]:
    """C_t(k, H) at one k: [N], or [B, N] for B message sets."""
    p = model.p[: step + 1, rows_at(model.rows, given), np.arange(model.n_types)]
    zeros: NDArray[np.float64] = np.add.reduce(1 - p, axis=0)
    return model.inexplicability * zeros


def take(
    model: Model, table: NDArray[np.float64], given: int | NDArray[np.int64]
) -> NDArray[np.float64]:
    """Every type's entry for H of a table [rows, N]: [N], or [B, N] for B sets."""
    return table[rows_at(model.rows, given), np.arange(model.n_types)]


def optimal_values(model: Model) -> NDArray[np.float64]:
    """V*_t(k, H) for all: [m + 1, rows, N]."""
    tell_when_compiling()
    values = np.zeros((model.n_steps + 1, model.n_rows, model.n_types))
    _accumulate(model, values[:-1])
    for first, end in backwards(model):
        _back_up(model.rows, model.discount, model.message_discount, values, first, end)
    return values


def backwards(model: Model) -> Iterator[tuple[int, int]]:
    """The steps from the last to the first, in ranges (first, end): one call of a kernel each, so
    that Ctrl-C is heard between them, and small tables take no more calls than they need."""
    together = max(1, BATCH // (model.n_rows * model.n_types))
    for end in range(model.n_steps, 0, -together):
        yield max(0, end - together), end


class SetPrices(NamedTuple):
    """Sets of messages, each given the cheapest message first, as is best where giving discounts.

    Attributes:
        price: [2^n] discounted price of a set.
        discount: [2^n] what discounts the *explain* after it.
    """

    price: NDArray[np.float64]
    discount: NDArray[np.float64]


def set_prices(model: Model) -> SetPrices:
    """Prices of all sets of messages of a dense problem."""
    return prices_of_sets(np.arange(model.n_rows), model.price, model.message_discount)


def prices_of_sets(
    sets: NDArray[np.int64], prices: NDArray[np.float64], message_discount: float
) -> SetPrices:
    """Prices of some sets of messages, given each message's."""
    price, discount = np.zeros(len(sets)), np.ones(len(sets))
    for j in np.argsort(prices, kind="stable"):
        has = sets >> j & 1 == 1
        price[has] += discount[has] * prices[j]
        discount[has] *= message_discount
    return SetPrices(price, discount)


def discounts(model: Model, step: int, given: NDArray[np.int64]) -> NDArray[np.float64]:
    """What discounts the *explain* that ends a step, H including the step's messages."""
    actions: NDArray[np.float64] = model.message_discount ** np.bitwise_count(given)
    return actions * model.discount**step


def paid(model: Model, given: int, new: int) -> tuple[float, float, float]:
    """Discount at the start of the messages (but for steps), the discounted price of them from
    there, the cheapest first, and the plain price."""
    per_message = model.message_discount
    prices = sorted(p for j, p in enumerate(model.price) if new >> j & 1)
    discounted = sum(p * per_message**i for i, p in enumerate(prices))
    return per_message ** given.bit_count(), float(discounted), float(sum(prices))


def best_set(values: Mapping[int, float]) -> int:
    """The message set (0 is *explain* at once) that :func:`best_of` takes, of values that may also
    be of questions, ~q."""
    said = {chosen: value for chosen, value in values.items() if chosen >= 0}
    return best_of(np.array(list(said)), np.array(list(said.values())))


def best_of(sets: NDArray[np.int64], values: NDArray[np.float64]) -> int:
    """The set with the largest value; ties: fewest messages, then message order."""
    first = values.argmax()
    best = values[first]
    equal = values >= best - TIE * (1 + abs(best))
    if np.count_nonzero(equal) == 1:
        return int(sets[first])
    tied = sets[equal]
    size = np.bitwise_count(tied)
    return int(tied[size == size.min()].min())


def one_by_one(best_action: Callable[[int], int], given: int) -> int:
    """All the messages given before the next *explain* by who gives one at a time.

    Args:
        best_action: the best action (0 is *explain*, else a message's bit) by the messages given.
            No label comes in between, so the belief stays.
        given: H.
    """
    chosen = 0
    while message := best_action(given | chosen):
        chosen |= message
    return chosen


@inlined
def explain_cost(model, k, given, t):  # type: ignore[no-untyped-def]
    """C_t(k, H), the expected cost of *explain* for type t."""
    cost = 0.0
    at = row(model.rows.part, given, t)
    for i in range(k + 1):
        cost += model.inexplicability * (1.0 - model.p[i, at, t])
    return cost


@inlined
def expected(belief, row):  # type: ignore[no-untyped-def]
    """Σ_t b(t) x_t, for a row [N] of a table."""
    total = 0.0
    for t in range(len(belief)):
        total += belief[t] * row[t]
    return total


@lean_kernel
def _back_up(rows, discount, message_discount, values, first, end):  # type: ignore[no-untyped-def]
    """``values`` [m + 1, rows, N] holds C(k, ·) from step ``first`` to before ``end``, V(k, ·) from
    there on, and leaves with V(k, ·) in all of these. One message more is a larger row, so
    descending rows meet it first."""
    _, number, types = values.shape
    for k in range(end - 1, first - 1, -1):
        now, after = values[k], values[k + 1]
        for at in range(number - 1, -1, -1):
            for t in range(types):
                now[at, t] = discount * after[at, t] - now[at, t]
            for c in range(len(rows.stride)):
                stride = rows.stride[c]
                if c < rows.bits:  # told more quickly than a digit
                    count, size = at >> c & 1, 1
                else:
                    size = rows.size[c]
                    count = at // stride % (size + 1)
                if count < size:
                    for t in range(types):
                        value = message_discount * now[at + stride, t] - rows.price[c, count, t]
                        if value > now[at, t]:
                            now[at, t] = value
