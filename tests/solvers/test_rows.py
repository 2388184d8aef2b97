"""Rows of tables by type: which messages a row says are given."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from xplain.errors import TooLargeError
from xplain.explanation.label_table import NONE, LabelTable
from xplain.numba_kernels import lean_kernel
from xplain.solvers.rows import Rows, delaying, make_rows, row, rows_at

RELEVANT = np.array([[1, 4], [0, NONE]])
PRICE = np.array([1.0, 1.0, 2.0, 2.0, 1.0, 2.0, 3.0])
IDLE = [[0, 2, 3, 5], [2, 6, 3]]
"""Of type 0 three cost the same, and one less; of type 1 two, and one more."""


def by_type() -> LabelTable:
    return LabelTable.by_type(RELEVANT, np.random.default_rng(0).random((2, 3, 4)))


def classes(t: int) -> list[list[int]]:
    """Messages that a row of type t need not tell apart."""
    own = [[j] for j in RELEVANT[t].tolist() if j != NONE]
    prices = list(dict.fromkeys(PRICE[j] for j in IDLE[t]))
    return own + [[j for j in IDLE[t] if PRICE[j] == price] for price in prices]


@lean_kernel
def _row(rows, given, t):  # type: ignore[no-untyped-def]
    return row(rows.part, given, t)


@pytest.fixture(scope="module")
def rows() -> Rows:
    return make_rows(by_type(), PRICE, IDLE)


def one_more(rows: Rows, at: int, c: int, t: int) -> float:
    """The price of one more message of a digit in a row; inf where none is left."""
    count = at // rows.stride[c] % (rows.size[c] + 1)
    return float(rows.price[c, count, t]) if count < rows.size[c] else np.inf


@pytest.mark.parametrize("t", [0, 1])
def test_a_row_counts_what_is_given_of_each_class(rows: Rows, t: int) -> None:
    found = {}
    for given in range(1 << len(PRICE)):
        counts = tuple(sum(given >> j & 1 for j in members) for members in classes(t))
        at = _row(rows, given, t)
        assert at == rows_at(rows, given)[t]
        assert found.setdefault(counts, at) == at
        assert 0 <= at < rows.number
    assert len(set(found.values())) == len(found)  # a row each
    n_relevant = int((RELEVANT[t] != NONE).sum())
    for bits in product((0, 1), repeat=n_relevant):
        counts = bits + (0,) * (len(classes(t)) - n_relevant)
        assert found[counts] == sum(bit << place for place, bit in enumerate(bits))


@pytest.mark.parametrize("t", [0, 1])
def test_one_more_message_moves_the_row_and_costs_its_price(rows: Rows, t: int) -> None:
    """From every row there is exactly one way on for each class with a message left."""
    for given in range(1 << len(PRICE)):
        at = int(rows_at(rows, given)[t])
        left = [[j for j in members if not given >> j & 1] for members in classes(t)]
        known = {int(rows_at(rows, given | 1 << own[0])[t]): PRICE[own[0]] for own in left if own}
        prices = {
            at + int(stride): one_more(rows, at, c, t) for c, stride in enumerate(rows.stride)
        }
        assert {row: price for row, price in prices.items() if price < np.inf} == known


def test_a_row_of_a_dense_problem_is_the_message_set() -> None:
    """Also where messages are more than are looked up together."""
    n = 14
    rows = make_rows(LabelTable.dense(np.full((3, 1, 1 << n), 0.5)), np.ones(n))
    sets = np.arange(1 << n)
    assert (rows_at(rows, sets) == sets[:, None]).all()
    assert [_row(rows, given, 2) for given in (0, 5, 1 << 13, (1 << n) - 1)] == [
        0, 5, 1 << 13, (1 << n) - 1
    ]  # fmt: skip


def test_rows_of_many_sets_are_those_of_each(rows: Rows) -> None:
    given = np.arange(1 << len(PRICE))
    np.testing.assert_array_equal(rows_at(rows, given), [rows_at(rows, int(h)) for h in given])


def test_too_many_rows_are_refused() -> None:
    price = np.arange(1.0, 41.0)  # no two alike
    with pytest.raises(TooLargeError, match=r"40 messages or prices.*discount_per=step"):
        make_rows(
            LabelTable.by_type(np.array([[0]]), np.full((1, 1, 2), 0.5)),
            price,
            [list(range(1, 40))],
        )


def test_what_may_pay_as_a_delay_costs_less_than_it_saves() -> None:
    optimal = np.zeros((4, 4, 2))
    optimal[1, 2, 0], optimal[0, 1, 1] = -30.0, -15.0
    assert delaying(by_type(), PRICE, 0.0, optimal) == [[], []]
    # A tenth of 30 is 3, which 3.0 does not undercut; a tenth of 15 is 1.5.
    assert delaying(by_type(), PRICE, 0.1, optimal) == [[0, 2, 3, 5], [1, 4]]


def test_the_relevant_messages_are_the_lowest_digits_of_every_row(rows: Rows) -> None:
    """So a model's table is the problem's own, once for each count of the others."""
    for t, own in enumerate(RELEVANT.tolist()):
        for given in range(1 << len(PRICE)):
            subset = sum((given >> j & 1) << i for i, j in enumerate(own) if j != NONE)
            assert rows_at(rows, given)[t] % 4 == subset
    assert rows.relevant.tolist() == [
        sum(1 << j for members in classes(t) for j in members) for t in (0, 1)
    ]
