"""P(label is 1 | transition, type, message set): all that a solver knows of the users.

A label is what a user thinks; it is what costs are made of. What the user answers may differ, by
slips, guesses and errors (:mod:`xplain.explanation.habits`); it is what beliefs are made of.
Where the two differ a table holds both.

Only those messages matter to a user that change this user's labels on the trace: messages about
facts believed incorrectly, or messages that the type's labeler looks at. So a table stores each
type's probabilities by the messages relevant to that type, and N types of r relevant messages need
m · 2^r · N numbers, however many messages there are. A dense table is the case where every message
is relevant to every type.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, TooLargeError

MAX_MESSAGES = 62
"""A message set is a signed integer of 64 bits."""
MAX_RELEVANT = 20
"""Messages that a table is over: it holds 2^20 entries a transition and type at most."""
DENSE = 12
"""Up to so many messages a table is dense: small all the same, and quicker to work with."""
NONE = -1
"""In ``relevant``: no message. Pads stand last in a row."""

Rows = Sequence[Sequence[int]]
Change = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class LabelTable:
    """N types, m transitions. Made by :meth:`dense` and :meth:`by_type`.

    Attributes:
        relevant: [N, r] int64, the messages relevant to a type, ascending, padded with NONE.
        p: [m, 2^r, N] float64, C-contiguous, P(label is 1); bit j of the middle axis is message
            ``relevant[t, j]``, and where that is a pad it changes nothing.
        answers: [m, 2^r, N] P(answer is 1); empty where users answer what they think.
    """

    relevant: NDArray[np.int64]
    p: NDArray[np.float64]
    answers: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0, 0)))

    def __post_init__(self) -> None:
        """One layout, whatever the table was taken from: kernels are compiled for it alone."""
        for name in ("relevant", "p", "answers"):
            array = np.require(getattr(self, name), requirements=["C", "W"])
            object.__setattr__(self, name, array)

    @property
    def answered(self) -> NDArray[np.float64]:
        """[m, 2^r, N] P(answer is 1): the very array ``p`` where users answer what they think."""
        return self.answers if self.answers.size else self.p

    def _changed(self, relevant: NDArray[np.int64], change: Change) -> LabelTable:
        """The table with another ``relevant``, after the same change of both of its arrays."""
        answers = change(self.answers) if self.answers.size else self.answers
        return LabelTable(relevant, change(self.p), answers)

    @classmethod
    def dense(cls, table: ArrayLike, answers: ArrayLike | None = None) -> LabelTable:
        """Of P(label is 1 | type, transition, message set), [N, m, 2^n], and of answers.

        Raises:
            InputError: no such table, or one of more than MAX_RELEVANT messages.
        """
        p = _table_array("p_explicable", table)
        relevant = np.tile(np.arange(p.shape[2].bit_length() - 1), (len(p), 1))
        return cls._checked("p_explicable", relevant, p, answers)

    @classmethod
    def by_type(
        cls, relevant: ArrayLike, tables: ArrayLike, answers: ArrayLike | None = None
    ) -> LabelTable:
        """Of tables that each type has over messages of its own.

        Args:
            relevant: [N, r] message indices in any order, −1 for none.
            tables: [N, m, 2^r]; bit j of the last axis is message ``relevant[t, j]``.
            answers: of the same shape, P(answer is 1) where it differs.

        Raises:
            InputError: indices that are no messages or named twice, or a table of another width.
        """
        p, indices = _table_array("p_relevant", tables), np.asarray(relevant)
        if (
            indices.ndim != 2
            or len(indices) != len(p)
            or (indices.size and indices.dtype.kind not in "iu")
        ):
            wanted = f"message indices [{len(p)} types, r], −1 pads"
            raise InputError("relevant", indices.shape, wanted)
        if not ((indices >= NONE) & (indices < MAX_MESSAGES)).all():
            wanted = f"messages 0 … {MAX_MESSAGES - 1}, or −1"
            raise InputError("relevant", indices.tolist(), wanted)
        return cls._checked("p_relevant", indices.astype(np.int64), p, answers)

    @classmethod
    def _checked(
        cls,
        key: str,
        relevant: NDArray[np.int64],
        p: NDArray[np.float64],
        answers: ArrayLike | None,
    ) -> LabelTable:
        """Of arrays as :meth:`by_type` has them.

        Raises:
            InputError: tables of other widths, of no probabilities, or a message named twice.
        """
        width = relevant.shape[1]
        if width > MAX_RELEVANT:
            raise InputError(key, p.shape, f"at most 2**{MAX_RELEVANT} entries a transition")
        if p.shape[2] != 1 << width:
            allowed = f"a power of two, 2**{width} = {1 << width} entries for {width} messages"
            raise InputError(key, p.shape, allowed)
        answered = [] if answers is None else [_table_array("p_answered", answers)]
        if answered and answered[0].shape != p.shape:
            raise InputError("p_answered", answered[0].shape, f"a table {p.shape}, as labels have")
        given = cls(relevant, *(each.transpose(1, 2, 0) for each in (p, *answered)))
        for row in given.rows:
            if len(set(row)) < len(row):
                raise InputError("relevant", row, "each message once a type")
        table = given._read_over(
            [sorted(row) for row in given.rows]
        )  # in whatever order, pads anywhere
        for name, own in ((key, table.p), ("p_answered", table.answers)):
            if own.size and not (own.min() >= 0 and own.max() <= 1):  # NaN is neither
                wrong = own[~((own >= 0) & (own <= 1))]
                raise InputError(name, float(wrong[0]), "probabilities in [0, 1]")
        return table

    @classmethod
    def joined_types(
        cls, relevant: Sequence[ArrayLike], tables: Sequence[NDArray[np.float64]]
    ) -> LabelTable:
        """Of types with different numbers of relevant messages: rows [r_t], ascending, and tables
        [m, 2^r_t]."""
        rows = [np.asarray(row, dtype=np.int64).tolist() for row in relevant]
        width = max(map(len, rows))
        sets = np.arange(1 << width)
        own = [p[:, sets & (1 << len(row)) - 1] for row, p in zip(rows, tables, strict=True)]
        return cls(_padded(rows, width), np.stack(own, axis=-1))

    @property
    def n_types(self) -> int:
        """N."""
        return len(self.relevant)

    @property
    def rows(self) -> list[list[int]]:
        """For each type its relevant messages, ascending."""
        return [[j for j in row if j != NONE] for row in self.relevant.tolist()]

    def is_dense(self, n: int) -> bool:
        """Whether each type looks at all of n messages: a row of ``p`` is a message set."""
        return self.relevant.shape[1] == n and bool((self.relevant == np.arange(n)).all())

    def effective(self) -> list[tuple[int, ...]]:
        """For each type the messages that do change some label, ascending."""
        return self._effective

    @cached_property
    def _effective(self) -> list[tuple[int, ...]]:
        both = self._both
        return [
            tuple(row[i] for i in _effective_bits(both[..., t : t + 1]) if i < len(row))
            for t, row in enumerate(self.rows)
        ]

    def effective_of_any(self) -> tuple[int, ...]:
        """The messages that change some label of some type, ascending."""
        return tuple(sorted(set().union(*self._effective)))

    @property
    def _both(self) -> NDArray[np.float64]:
        """[m or 2 m, 2^r, N] labels and, where they differ, answers."""
        return np.concatenate([self.p, self.answers]) if self.answers.size else self.p

    def subset(self, given: int) -> NDArray[np.int64]:
        """[N] where each type's entry for H is."""
        messages, bits = self._bits
        where: NDArray[np.int64] = ((given >> messages & 1) * bits).sum(axis=-1)
        return where

    @cached_property
    def _bits(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """[N, r] the relevant messages, and what each adds to an entry's number; 0 and 0 of pads:
        an entry is looked up at every step of every explanation."""
        bits = (self.relevant != NONE) << np.arange(self.relevant.shape[1])
        return np.maximum(self.relevant, 0), bits

    def label_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """[N, count] P(label 1) of the first so many transitions, with message set H given."""
        return self._of_set(self.p, count, given)

    def answer_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """[N, count] P(answer 1) of the first so many transitions, with message set H given."""
        return self._of_set(self.answered, count, given)

    def _of_set(self, p: NDArray[np.float64], count: int, given: int) -> NDArray[np.float64]:
        own = p[:count, self.subset(given), np.arange(self.n_types)]
        return np.ascontiguousarray(own.T)

    def over(self, rows: Rows) -> LabelTable:
        """The table over these messages of each type, ascending; the others are never given.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages of a type.
        """
        same = np.array_equal(_padded(rows, max(map(len, rows))), self.relevant)
        return self if same else self._read_over(rows)

    def _read_over(self, rows: Rows) -> LabelTable:
        width = max(map(len, rows))
        if width > MAX_RELEVANT:
            raise TooLargeError(
                f"{width} messages matter to some type on this trace, and a table over "
                f"all their subsets holds at most {MAX_RELEVANT}; solver=qmdp or pomcp plans "
                "type by type"
            )
        places: dict[tuple[tuple[int, ...], tuple[int, ...]], NDArray[np.int64]] = {}
        where = []
        for row, old in zip(rows, self.relevant.tolist(), strict=True):
            key = tuple(row), tuple(old)
            if key not in places:
                places[key] = _places(row, old, width)
            where.append(places[key])

        def read(p: NDArray[np.float64]) -> NDArray[np.float64]:
            if len(places) == 1:
                return p[:, where[0]]
            return np.stack([p[:, at, t] for t, at in enumerate(where)], axis=-1)

        return self._changed(_padded(rows, width), read)

    def array(self, n: int) -> NDArray[np.float64]:
        """[N, m, 2^n] P(label is 1 | type, transition, message set) of n messages, all sets.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages.
        """
        return self.over([range(n)] * self.n_types).p.transpose(2, 0, 1)

    def compact(self, n: int) -> LabelTable:
        """As tables are kept: dense where messages are few, else over what changes some label."""
        return self.over([range(n)] * self.n_types if n <= DENSE else self.effective())

    def of_types(self, types: Sequence[int]) -> LabelTable:
        """Some of the types."""
        return self._changed(self.relevant[list(types)], lambda p: p[:, :, list(types)])

    def of_steps(self, steps: Sequence[int]) -> LabelTable:
        """Selects some of the transitions, in this order."""
        return self._changed(self.relevant, lambda p: p[list(steps)])

    def repeated(self, times: int) -> LabelTable:
        """Each type so many times, one after the other."""
        return self._changed(
            self.relevant.repeat(times, axis=0), lambda p: p.repeat(times, axis=-1)
        )

    def mixed(self, weights: NDArray[np.float64]) -> LabelTable:
        """One type in the place of all, drawn by ``weights`` [N] anew for every label. It answers
        what it thinks: of one type answers teach nothing.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages matter to some type.
        """
        together = self.over([self.effective_of_any()] * self.n_types)
        # Weights may sum to a hair more than 1.
        p = (together.p * weights).sum(axis=-1, keepdims=True).clip(0, 1)
        return LabelTable(together.relevant[:1], p)


def joined(parts: Sequence[LabelTable]) -> LabelTable:
    """Tables of one trace's parts, one after the other.

    Raises:
        TooLargeError: more than MAX_RELEVANT messages matter to one type.
    """
    types = range(parts[0].n_types)
    union = [sorted({j for part in parts for j in part.rows[t]}) for t in types]
    whole = [part.over(union) for part in parts]
    relevant, p = whole[0].relevant, np.concatenate([part.p for part in whole])
    if not any(part.answers.size for part in whole):
        return LabelTable(relevant, p)
    return LabelTable(relevant, p, np.concatenate([part.answered for part in whole]))


def stacked(parts: Sequence[LabelTable]) -> LabelTable:
    """Tables of the same transitions, the types of one after those of the other."""
    rows = [row for part in parts for row in part.rows]
    tables = [part.p[:, :, t] for part in parts for t in range(part.n_types)]
    return LabelTable.joined_types(rows, tables)


def _padded(rows: Rows, width: int) -> NDArray[np.int64]:
    relevant = np.full((len(rows), width), NONE, dtype=np.int64)
    for own, row in zip(relevant, rows, strict=True):
        own[: len(row)] = row
    return relevant


def _places(row: Sequence[int], old: Sequence[int], width: int) -> NDArray[np.int64]:
    """[2^width] where the entries of subsets of ``row`` are in a table over ``old``."""
    sets = np.arange(1 << width)
    where = np.zeros_like(sets)
    for i, j in enumerate(row):
        if j in old:
            where |= (sets >> i & 1) << old.index(j)
    return where


def _table_array(key: str, value: ArrayLike) -> NDArray[np.float64]:
    """A table [types, steps, entries].

    Raises:
        InputError: it is none.
    """
    try:
        p = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, value, "numbers") from None
    if p.ndim != 3 or min(p.shape[0], p.shape[2]) < 1:
        raise InputError(key, p.shape, "a table [types, steps, 2**messages]")
    return p


def _effective_bits(p: NDArray[np.float64]) -> tuple[int, ...]:
    """The bits of the middle axis [m, 2^n, N] that change some entry, ascending."""
    n = p.shape[1].bit_length() - 1
    alone = (p[:, [1 << j for j in range(n)]] != p[:, :1]).any(axis=(0, 2))
    effective = []
    for j in reversed(range(n)):
        pairs = p.reshape(len(p), p.shape[1] >> j + 1, 2, 1 << j, p.shape[2])
        if alone[j] or (pairs[:, :, 0] != pairs[:, :, 1]).any():
            effective.append(j)
        else:
            p = pairs[:, :, 0].reshape(len(p), p.shape[1] >> 1, p.shape[2])  # half is left
    return tuple(reversed(effective))
