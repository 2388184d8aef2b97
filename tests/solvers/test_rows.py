"""Rows of tables by type: which messages a row says are given."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from xplain.errors import TooLargeError
from xplain.explanation.label_table import NONE, LabelTable
from xplain.numba_kernels import lean_kernel
from xplain.solvers.rows import Rows, delaying, is_left, make_rows, row, rows_at, spread

RELEVANT = np.array([[1, 4], [0, NONE]])
PRICE = np.array([1.0, 1.0, 2.0, 2.0, 1.0, 2.0, 3.0])
IDLE = [[0, 2, 3, 5], [2, 6, 3]]
"""Of type 0 three cost the same, and one less; of type 1 two, and one more."""


def by_type() -> LabelTable:
    return LabelTable.by_type(RELEVANT, np.full((2, 3, 4), 0.5))


def classes(t: int) -> list[list[int]]:
    """Messages that a row of type t need not tell apart."""
    own = [[j] for j in RELEVANT[t].tolist() if j != NONE]
    prices = list(dict.fromkeys(PRICE[j] for j in IDLE[t]))
    return own + [[j for j in IDLE[t] if PRICE[j] == price] for price in prices]


@lean_kernel
def _row(rows, given, t):  # type: ignore[no-untyped-def]
    return row(rows, given, t)


@lean_kernel
def _is_left(rows, at, t, c):  # type: ignore[no-untyped-def]
    return is_left(rows, at, t, c)


@pytest.fixture(scope="module")
def rows() -> Rows:
    return make_rows(by_type(), PRICE, IDLE)


@pytest.mark.parametrize("t", [0, 1])
def test_a_row_counts_what_is_given_of_each_class(rows: Rows, t: int) -> None:
    found = {}
    for given in range(1 << len(PRICE)):
        counts = tuple(sum(given >> j & 1 for j in members) for members in classes(t))
        at = _row(rows, given, t)
        assert at == rows_at(rows, given)[t]
        assert found.setdefault(counts, at) == at
        for c, members in enumerate(classes(t)):
            assert _is_left(rows, at, t, c) == (counts[c] < len(members))
    # A row each, none between, the relevant messages first.
    assert sorted(found.values()) == list(range(int(rows.number[t])))
    n_relevant = int((RELEVANT[t] != NONE).sum())
    for bits in product((0, 1), repeat=n_relevant):
        counts = bits + (0,) * (len(classes(t)) - n_relevant)
        assert found[counts] == sum(bit << place for place, bit in enumerate(bits))


def test_rows_of_many_sets_are_those_of_each(rows: Rows) -> None:
    given = np.arange(1 << len(PRICE))
    np.testing.assert_array_equal(rows_at(rows, given), [rows_at(rows, int(h)) for h in given])


@pytest.mark.parametrize("t", [0, 1])
def test_a_class_has_the_price_of_its_messages(rows: Rows, t: int) -> None:
    for c, members in enumerate(classes(t)):
        assert rows.price[t, c] == PRICE[members[0]]


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


def test_rows_that_a_type_lacks_cost_nothing(rows: Rows) -> None:
    """The least value over all rows bounds what is still to be paid (:func:`delaying`)."""
    table = np.random.default_rng(0).random((2, 3, 4))
    table[1, :, 2:] = table[1, :, :2]  # of a single relevant message
    found = spread(LabelTable.by_type(RELEVANT, table), rows)
    assert found.shape == (3, rows.number.max(), 2)
    for t, own in enumerate(table):
        for given in range(1 << len(PRICE)):
            relevant = [j for j in RELEVANT[t].tolist() if j != NONE]
            subset = sum((given >> j & 1) << i for i, j in enumerate(relevant))
            assert (found[:, rows_at(rows, given)[t], t] == own[:, subset]).all()
        assert (found[:, int(rows.number[t]) :, t] == 1).all()
    assert rows.number.min() < rows.number.max()
