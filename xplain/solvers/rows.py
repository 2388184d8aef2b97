"""Where a type's values for a message set H stand, where types look at messages of their own.

To one type many message sets are the same. A message relevant to it is a *class* of its own. The
others change no label; but where giving discounts, giving one puts off what is still to be paid,
and an optimal plan does so where it is cheap enough. Of such messages with one price only how many
are given matters: they are one class. So a row is a number whose digits count, class by class, the
messages given, and one table [k, row, t] holds any function of (k, H) that a type's plans ask for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.label_table import MAX_RELEVANT, LabelTable
from xplain.numba_kernels import inlined
from xplain.solvers.bits import count_bits

MAX_ROWS = 1 << MAX_RELEVANT
"""Rows of a type's table, at most."""


class Rows(NamedTuple):
    """For N types, up to c classes each; unused ones hold no message.

    Attributes:
        mask: [N, c] the messages of a class.
        stride: [N, c] by how much one more of them moves the row.
        size: [N, c] how many there are.
        price: [N, c] λ C_e of each.
        number: [N] rows of a type.
    """

    mask: NDArray[np.int64]
    stride: NDArray[np.int64]
    size: NDArray[np.int64]
    price: NDArray[np.float64]
    number: NDArray[np.int64]


@inlined
def row(rows, given, t):  # type: ignore[no-untyped-def]
    """The row of H for type t; H itself where the problem is dense."""
    if rows is None:
        return given
    at = 0
    for c in range(rows.mask.shape[1]):
        at += rows.stride[t, c] * count_bits(given & rows.mask[t, c])
    return at


@inlined
def is_left(rows, at, t, c):  # type: ignore[no-untyped-def]
    """Whether some message of a class is not yet given in a row."""
    stride, size = rows.stride[t, c], rows.size[t, c]
    if size <= 1 and stride & (stride - 1) == 0:  # a bit, which is quicker told than a digit
        return size == 1 and at & stride == 0
    return at // stride % (size + 1) < size


def rows_at(rows: Rows, given: int | NDArray[np.int64]) -> NDArray[np.int64]:
    """The rows of H for all types: [N], or [B, N] for B message sets."""
    counts = np.bitwise_count(np.asarray(given, dtype=np.int64)[..., None, None] & rows.mask)
    at: NDArray[np.int64] = (counts * rows.stride).sum(axis=-1)
    return at


def relevant_rows(table: LabelTable, price: NDArray[np.float64]) -> Rows:
    """Rows of relevant messages alone: exact where no message is worth giving as a delay."""
    return make_rows(table, price, [[] for _ in table.relevant])


def make_rows(table: LabelTable, price: NDArray[np.float64], idle: list[list[int]]) -> Rows:
    """Rows of the relevant messages and, for each type, these others.

    Raises:
        TooLargeError: more than MAX_ROWS for a type.
    """
    classes: list[list[list[int]]] = []
    for relevant, others in zip(table.rows, idle, strict=True):
        alike: dict[float, list[int]] = {}
        for j in others:
            alike.setdefault(float(price[j]), []).append(j)
        classes.append([[j] for j in relevant] + list(alike.values()))
    width = max(map(len, classes))
    shape = len(classes), width
    rows = Rows(
        np.zeros(shape, np.int64),
        np.ones(shape, np.int64),
        np.zeros(shape, np.int64),
        np.zeros(shape),
        np.ones(len(classes), np.int64),
    )
    for t, own in enumerate(classes):
        count = 1
        for c, members in enumerate(own):
            rows.mask[t, c] = sum(1 << j for j in members)
            rows.stride[t, c], rows.size[t, c] = count, len(members)
            rows.price[t, c] = price[members[0]]
            count *= len(members) + 1
        if count > MAX_ROWS:
            raise TooLargeError(
                f"{len(own)} messages or prices matter to one type on this trace: {count:.1e} "
                "rows of its table; where giving messages pays as a mere delay, discount_per=step "
                "makes an end of it"
            )
        rows.number[t] = count
    return rows


def delaying(
    table: LabelTable,
    price: NDArray[np.float64],
    delay: float,
    optimal: NDArray[np.float64],
) -> list[list[int]]:
    """For each type, the messages not relevant to it that may pay as a mere delay.

    Args:
        table: of N types.
        price: [n] λ C_e.
        delay: 1 − γ', what giving one saves of all that is still to be paid.
        optimal: [m + 1, rows, N] V*_t without such messages, whose least value bounds that.
    """
    if delay <= 0:
        return [[] for _ in table.relevant]
    ahead = -optimal.min(axis=(0, 1))
    return [
        [j for j in range(len(price)) if price[j] < delay * ahead[t] and j not in own]
        for t, own in enumerate(table.rows)
    ]


def spread(table: LabelTable, rows: Rows) -> NDArray[np.float64]:
    """The table by rows: [m, rows, N]. Relevant messages are the lowest digits of a row."""
    p = np.ones((len(table.p), int(rows.number.max()), table.n_types))
    for t, own in enumerate(table.rows):
        number = int(rows.number[t])
        p[:, :number, t] = table.p[:, np.arange(number) % (1 << len(own)), t]
    return p
