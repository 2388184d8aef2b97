"""Label probabilities kept by type: for each type the messages relevant to it, and a table over
their subsets.

To a user only those messages matter that change this user's labels on the trace: about facts held
wrong, or that the type's labeler looks at. So N types of r relevant messages each need
N · m · 2^r numbers, however many messages there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, TooLargeError

DENSE = 12
"""Up to so many messages dense tables are small, and quicker to work with."""
MAX_RELEVANT = 20
"""Messages that may matter to one type: its table holds 2^r entries a transition."""
NONE = -1
"""In ``relevant``: no message. Pads stand last in a row."""


@dataclass(frozen=True)
class ByType:
    """N types, m steps, n messages.

    Attributes:
        relevant: [N, r] int64, the messages relevant to a type, ascending, padded with NONE.
        p: [N, m, 2^r] P(label 1 | type, subset of its relevant messages); bit j of the last axis
            is message ``relevant[t, j]``, and where that is a pad it changes nothing.
    """

    relevant: NDArray[np.int64]
    p: NDArray[np.float64]

    @classmethod
    def checked(cls, relevant: ArrayLike, p: ArrayLike, n: int) -> ByType:
        """Arrays as anyone may write them, pads anywhere, made those of a ``ByType``.

        Raises:
            InputError: indices that are no messages or named twice, or a table of another width.
        """
        indices = np.asarray(relevant)
        if indices.ndim != 2 or (indices.size and indices.dtype.kind not in "iu"):
            raise InputError("relevant", indices.shape, "message indices [types, r], −1 pads")
        try:
            table = np.asarray(p, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("p_relevant", p, "numbers") from None
        types, width = indices.shape
        if table.ndim != 3 or min(table.shape) < 1 or len(table) != types:
            raise InputError("p_relevant", table.shape, f"a table [{types}, steps, 2**r]")
        if width > MAX_RELEVANT:
            raise InputError("relevant", indices.shape, f"at most {MAX_RELEVANT} messages a type")
        if table.shape[2] != 1 << width:
            allowed = f"2**{width} = {1 << width} entries, as relevant has {width} columns"
            raise InputError("p_relevant", table.shape, allowed)
        outside = indices[(indices < NONE) | (indices >= n)]
        if outside.size:
            raise InputError("relevant", int(outside[0]), f"a message 0 … {n - 1}, or −1")
        rows, tables = [], []
        for row, own in zip(indices.astype(np.int64), table, strict=True):
            order = [int(i) for i in np.argsort(row, kind="stable") if row[i] != NONE]
            if len(set(row[order].tolist())) < len(order):
                raise InputError("relevant", row.tolist(), "each message once a type")
            rows.append(row[order])
            tables.append(own[:, _spread(np.arange(1 << len(order)), order)])
        return cls.padded(rows, tables)

    @classmethod
    def padded(
        cls, relevant: Sequence[NDArray[np.int64]], tables: Sequence[NDArray[np.float64]]
    ) -> ByType:
        """Types with different numbers of relevant messages: rows [r_t] and tables [m, 2^r_t]."""
        width = max(len(row) for row in relevant)
        rows = np.full((len(relevant), width), NONE, dtype=np.int64)
        p = np.empty((len(tables), len(tables[0]), 1 << width))
        for t, (row, table) in enumerate(zip(relevant, tables, strict=True)):
            rows[t, : len(row)] = row
            p[t] = np.tile(table, 1 << (width - len(row)))  # pads are the highest bits
        return cls(rows, p)

    @classmethod
    def of_table(cls, table: NDArray[np.float64]) -> ByType:
        """The messages that change some label of a type, and its table over them, of a dense
        table [N, m, 2^n]."""
        rows, tables = [], []
        for own in table:
            effective = effective_bits(own)
            rows.append(np.array(effective, dtype=np.int64))
            tables.append(own[:, _spread(np.arange(1 << len(effective)), effective)])
        return cls.padded(rows, tables)

    def __len__(self) -> int:
        """N."""
        return len(self.relevant)

    def __getitem__(self, types: int | slice) -> ByType:
        """Some of the types, or one alone."""
        own = slice(types, types + 1) if isinstance(types, int) else types
        return ByType(self.relevant[own], self.p[own])

    def effective(self) -> list[tuple[int, ...]]:
        """For each type the messages that do change some label, ascending."""
        return [
            tuple(int(row[i]) for i in effective_bits(own) if row[i] != NONE)
            for row, own in zip(self.relevant, self.p, strict=True)
        ]

    def subset(self, given: int | NDArray[np.int64]) -> NDArray[np.int64]:
        """Where each type's entry for H is: [N], or [B, N] for B message sets."""
        own = np.maximum(self.relevant, 0)
        bits = (np.asarray(given)[..., None, None] >> own & 1) * (self.relevant != NONE)
        where: NDArray[np.int64] = (bits << np.arange(own.shape[1])).sum(axis=-1)
        return where

    def label_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """[N, count] P(label 1) of the first so many transitions, with message set H given."""
        return self.p[np.arange(len(self.p)), :count, self.subset(given)]

    def over(self, messages: Sequence[int]) -> NDArray[np.float64]:
        """The dense table [N, m, 2^k] over k messages; the others are never given.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages.
        """
        if len(messages) > MAX_RELEVANT:
            raise TooLargeError(
                f"{len(messages)} messages matter to some type on this trace, and a table over "
                f"all their subsets holds at most {MAX_RELEVANT}; solver=qmdp or pomcp plans "
                "type by type"
            )
        where = self.subset(_spread(np.arange(1 << len(messages)), messages))
        return np.stack([own[:, where[:, t]] for t, own in enumerate(self.p)])

    def with_messages(self, kept: Sequence[int]) -> ByType:
        """The tables where only some messages (ascending positions) are ever given; they are
        numbered anew."""
        number = {j: i for i, j in enumerate(kept)}
        rows, tables = [], []
        for row, own in zip(self.relevant.tolist(), self.p, strict=True):
            at = [i for i, j in enumerate(row) if j in number]
            rows.append(np.array([number[row[i]] for i in at], dtype=np.int64))
            tables.append(own[:, _spread(np.arange(1 << len(at)), at)])
        return ByType.padded(rows, tables)

    def of_types(self, types: Sequence[int]) -> ByType:
        """Some of the types."""
        return ByType(self.relevant[list(types)], self.p[list(types)])

    def mixed(self, weights: NDArray[np.float64]) -> ByType:
        """One type in the place of all, drawn by ``weights`` [N] anew for every label.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages matter to some type.
        """
        union = tuple(sorted(set().union(*self.effective())))
        parts = (w * self[t].over(union) for t, w in enumerate(weights.tolist()))
        p = reduce(np.add, parts).clip(0, 1)  # weights may sum to a hair more than 1
        return ByType(np.array([union], dtype=np.int64).reshape(1, -1), p)

    def worst(self) -> ByType:
        """One type in the place of all, to whom each transition is as inexplicable as to any.

        Raises:
            TooLargeError: as :meth:`mixed`.
        """
        union = tuple(sorted(set().union(*self.effective())))
        parts = (self[t].over(union) for t in range(len(self)))
        return ByType(np.array([union], dtype=np.int64).reshape(1, -1), reduce(np.minimum, parts))


LabelTable = NDArray[np.float64] | ByType
"""P(label 1) of N types: dense [N, m, 2^n], or kept by type."""


def joined(parts: Sequence[LabelTable]) -> LabelTable:
    """Tables of one trace's parts, one after the other; dense where all are."""
    dense = [part for part in parts if not isinstance(part, ByType)]
    if len(dense) == len(parts):
        return np.concatenate(dense, axis=1)
    kept = [part if isinstance(part, ByType) else ByType.of_table(part) for part in parts]
    rows, tables = [], []
    for t in range(len(kept[0])):
        union = sorted({int(j) for part in kept for j in part.relevant[t] if j != NONE})
        if len(union) > MAX_RELEVANT:
            raise TooLargeError(
                f"{len(union)} messages matter to one type on this trace, more than {MAX_RELEVANT}"
            )
        rows.append(np.array(union, dtype=np.int64))
        tables.append(np.concatenate([part[t].over(union)[0] for part in kept]))
    return ByType.padded(rows, tables)


def _spread(sets: NDArray[np.int64], positions: Sequence[int]) -> NDArray[np.int64]:
    """Subsets, bit i of each moved to ``positions[i]``."""
    spread = np.zeros_like(sets)
    for i, j in enumerate(positions):
        spread |= (sets >> i & 1) << j
    return spread


def effective_bits(table: NDArray[np.float64]) -> tuple[int, ...]:
    """The bits of the last axis [.., 2^n] that change some entry, ascending."""
    n = table.shape[-1].bit_length() - 1
    alone = table[..., [1 << j for j in range(n)]]
    clear = (alone != table[..., :1]).any(axis=tuple(range(table.ndim - 1)))
    effective = []
    for j in reversed(range(n)):
        pairs = table.reshape(-1, 2, 1 << j)
        if clear[j] or (pairs[:, 0] != pairs[:, 1]).any():
            effective.append(j)
        else:
            table = pairs[:, 0]  # without this message half of the table is left
    return tuple(reversed(effective))
