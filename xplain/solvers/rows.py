"""Where a type's values for a message set H stand, where types look at messages of their own.

To one type many message sets are the same. A message relevant to it is a *digit* of its own. The
others change no label; but where giving discounts, giving one puts off what is still to be paid,
and an optimal plan does so where it is cheap enough. Of such messages with one price only how many
are given matters: they are one digit. So a row is a number whose digits count the messages given,
and one table [k, row, t] holds any function of (k, H) that a type's plans ask for. In a dense
problem every message is relevant to every type, and the row is H.

Row and H are linear: each message has a *place*, what giving it adds to the row.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.label_table import MAX_RELEVANT, NONE, LabelTable
from xplain.numba_kernels import inlined, shared_kernel

MAX_ROWS = 1 << MAX_RELEVANT
"""Rows of a table, at most."""
CHUNK = 12
"""Messages whose sets are looked up together."""


class Rows(NamedTuple):
    """For N types and C digits, of up to s messages each.

    Attributes:
        relevant: [N] bitmask of the messages with an effect on a type, or counted by a digit.
        place: [n, N] what giving a message adds to a type's row.
        part: [⌈n / CHUNK⌉, 2^CHUNK, N] what each set of CHUNK messages adds.
        bits: so many digits, the first, are single messages: bits of the row.
        stride: [C] what one more message of a digit adds.
        size: [C] how many it may count.
        price: [C, s, N] λ C_e of one more, where so many are given; inf where a type has no more,
            or it changes nothing for this type.
    """

    relevant: NDArray[np.int64]
    place: NDArray[np.int64]
    part: NDArray[np.int64]
    bits: int
    stride: NDArray[np.int64]
    size: NDArray[np.int64]
    price: NDArray[np.float64]

    @property
    def number(self) -> int:
        """Rows of a table."""
        return int(np.prod(self.size + 1))


@inlined
def row(part, given, t):  # type: ignore[no-untyped-def]
    """The row of H for type t."""
    at = part[0, given & ((1 << CHUNK) - 1), t]
    return at if len(part) == 1 else at + _further(part, given, t)


@shared_kernel
def _further(part, given, t):  # type: ignore[no-untyped-def]
    """What the messages after the first chunk add."""
    at = 0
    for i in range(1, len(part)):
        at += part[i, given >> CHUNK * i & ((1 << CHUNK) - 1), t]
    return at


@inlined
def find_rows(part, given, at):  # type: ignore[no-untyped-def]
    """Fills in ``at`` [N], the row of H for each type."""
    for t in range(len(at)):
        at[t] = row(part, given, t)


def rows_at(rows: Rows, given: int | NDArray[np.int64]) -> NDArray[np.int64]:
    """The rows of H for all types: [N], or [B, N] for B message sets."""
    return looked_up(rows.part, given)


def looked_up(parts: NDArray[np.int64], given: int | NDArray[np.int64]) -> NDArray[np.int64]:
    """What the messages of H add up to, of the parts of :class:`Rows`."""
    at: NDArray[np.int64] = parts[0, given & (1 << CHUNK) - 1]
    for i, part in enumerate(parts[1:], 1):
        at = at + part[given >> CHUNK * i & (1 << CHUNK) - 1]
    return at


def make_rows(
    table: LabelTable, price: NDArray[np.float64], idle: list[list[int]] | None = None
) -> Rows:
    """Rows of the relevant messages and, for each type, these others; without others exact where
    no message is worth giving as a delay.

    Raises:
        TooLargeError: more than MAX_ROWS.
    """
    types, bits = table.relevant.shape
    others = idle or []
    effective = table.effective()
    values = sorted({float(price[j]) for messages in others for j in messages})
    alike = [[[j for j in one if price[j] == value] for one in others] for value in values]
    size = np.array([1] * bits + [max(map(len, digit)) for digit in alike], np.int64)
    number = np.prod(size + 1.0)
    if number > max(MAX_ROWS, table.p.shape[1]):
        raise TooLargeError(
            f"{len(size)} messages or prices matter on this trace: {number:.1e} rows of its "
            "table; where giving messages pays as a mere delay, discount_per=step makes an end "
            "of it"
        )
    stride = np.cumprod(np.concatenate([[1], size + 1]))[:-1]
    place = places_of(table, len(price))
    prices = np.full((len(size), size.max(initial=1), types), np.inf)
    relevant = np.zeros(types, np.int64)
    for t, own in enumerate(effective):
        digits = [table.rows[t].index(j) for j in own]
        prices[digits, 0, t] = price[list(own)]
        relevant[t] = sum(1 << j for j in own)
    for c, of_price in enumerate(alike, bits):
        for t, messages in enumerate(of_price):
            place[messages, t] = stride[c]
            prices[c, : len(messages), t] = price[messages]
            relevant[t] |= sum(1 << j for j in messages)
    return Rows(relevant, place, parts_of(place), bits, stride, size, prices)


def places_of(table: LabelTable, messages: int) -> NDArray[np.int64]:
    """[n, N] what giving each of so many messages adds to the row of a table."""
    place = np.zeros((messages, table.n_types), np.int64)
    whose, digit = np.nonzero(table.relevant != NONE)
    place[table.relevant[whose, digit], whose] = 1 << digit
    return place


def parts_of(place: NDArray[np.int64]) -> NDArray[np.int64]:
    """[⌈n / CHUNK⌉, 2^CHUNK, N] from what each message adds, [n, N]."""
    n, types = place.shape
    chunks = -(-n // CHUNK) or 1
    parts = np.zeros((chunks, 1 << min(n, CHUNK), types), np.int64)
    for j, adds in enumerate(place):
        chunk, half = parts[j // CHUNK], 1 << j % CHUNK
        np.add(chunk[:half], adds, out=chunk[half : 2 * half])
    return parts


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
    ahead = -optimal.min(axis=(0, 1))
    return [
        [j for j in range(len(price)) if price[j] < delay * ahead[t] and j not in own]
        for t, own in enumerate(table.rows)
    ]
