"""P(label is 1 | transition, type, message set): everything that a solver knows about users.

A label is what a user thinks; costs depend on labels. The user's answer may differ from the label
by slips, guesses and errors (:mod:`xplain.explanation.habits`); beliefs depend on answers. If
answers differ from labels, a table has both.

Only messages that change a user's labels on the trace are relevant to this user: messages about
facts believed incorrectly, or messages that the type's labeler depends on. So a table stores each
type's probabilities by its relevant messages. N types with r relevant messages need m · 2^r · N
numbers, for any number of messages. In a dense table every message is relevant to every type.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, TooLargeError

MAX_MESSAGES = 62
"""Maximum number of messages; a message set is a signed 64-bit integer."""
MAX_RELEVANT = 20
"""Maximum number of relevant messages; a table has up to 2^20 entries for each transition and
type."""
DENSE = 12
"""Up to this number of messages a table is dense: still small, and faster."""
NONE = -1
"""The entry of ``relevant`` for "no message". Such pads are at the end of a row."""

Rows = Sequence[Sequence[int]]
Change = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class LabelTable:
    """A table for N types and m transitions, made by :meth:`dense` or :meth:`by_type`.

    Attributes:
        relevant: [N, r] int64 messages relevant to a type, ascending, padded with NONE.
        p: [m, 2^r, N] float64, C-contiguous, P(label is 1); bit j of the middle index is 1 if
            message ``relevant[t, j]`` is given; the bit of a pad has no effect.
        answers: [m, 2^r, N] P(answer is 1); empty if users answer what they think.
    """

    relevant: NDArray[np.int64]
    p: NDArray[np.float64]
    answers: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0, 0)))

    def __post_init__(self) -> None:
        """Converts the arrays to one memory layout, because kernels are compiled only for this
        layout."""
        for name in ("relevant", "p", "answers"):
            array = np.require(getattr(self, name), requirements=["C", "W"])
            object.__setattr__(self, name, array)

    @property
    def answered(self) -> NDArray[np.float64]:
        """[m, 2^r, N] P(answer is 1); the same array as ``p`` if users answer what they think."""
        return self.answers if self.answers.size else self.p

    def _change_arrays(self, relevant: NDArray[np.int64], change: Change) -> LabelTable:
        """Applies ``change`` to the arrays ``p`` and ``answers`` of this table. Returns a table of
        the results, with ``relevant`` as its relevant messages."""
        answers = change(self.answers) if self.answers.size else self.answers
        return LabelTable(relevant, change(self.p), answers)

    @classmethod
    def dense(cls, table: ArrayLike, answers: ArrayLike | None = None) -> LabelTable:
        """Makes a table in which every message is relevant to every type.

        Args:
            table: [N, m, 2^n] P(label is 1 | type, transition, message set).
            answers: P(answer is 1) in the same shape, if it differs from P(label is 1).

        Raises:
            InputError: an invalid table, or one of more than MAX_RELEVANT messages.
        """
        p = _check_array("p_explicable", table)
        relevant = np.tile(np.arange(p.shape[2].bit_length() - 1), (len(p), 1))
        return cls._make_checked("p_explicable", relevant, p, answers)

    @classmethod
    def by_type(
        cls, relevant: ArrayLike, tables: ArrayLike, answers: ArrayLike | None = None
    ) -> LabelTable:
        """Makes a table from one array for each type, over the messages that are relevant to the
        type.

        Args:
            relevant: [N, r] message indices in any order, −1 for none.
            tables: [N, m, 2^r] P(label is 1); bit j of the last index is 1 if message
                ``relevant[t, j]`` is given.
            answers: P(answer is 1) in the same shape, if it differs from P(label is 1).

        Raises:
            InputError: invalid or repeated indices, or a table whose last axis is not 2^r.
        """
        p, indices = _check_array("p_relevant", tables), np.asarray(relevant)
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
        return cls._make_checked("p_relevant", indices.astype(np.int64), p, answers)

    @classmethod
    def _make_checked(
        cls,
        key: str,
        relevant: NDArray[np.int64],
        p: NDArray[np.float64],
        answers: ArrayLike | None,
    ) -> LabelTable:
        """Makes a table from the arrays of :meth:`by_type`.

        Raises:
            InputError: a last axis that is not 2^r, values that are no probabilities, or a
                repeated message.
        """
        width = relevant.shape[1]
        if width > MAX_RELEVANT:
            raise InputError(key, p.shape, f"at most 2**{MAX_RELEVANT} entries a transition")
        if p.shape[2] != 1 << width:
            allowed = f"a power of two, 2**{width} = {1 << width} entries for {width} messages"
            raise InputError(key, p.shape, allowed)
        answered = [] if answers is None else [_check_array("p_answered", answers)]
        if answered and answered[0].shape != p.shape:
            raise InputError("p_answered", answered[0].shape, f"a table {p.shape}, as labels have")
        given = cls(relevant, *(each.transpose(1, 2, 0) for each in (p, *answered)))
        for row in given.rows:
            if len(set(row)) < len(row):
                raise InputError("relevant", row, "no message twice for one type")
        table = given.select_messages(
            [sorted(row) for row in given.rows]
        )  # relevant messages may be in any order, with pads anywhere
        for name, own in ((key, table.p), ("p_answered", table.answers)):
            if own.size and not (own.min() >= 0 and own.max() <= 1):  # NaN fails both
                wrong = own[~((own >= 0) & (own <= 1))]
                raise InputError(name, float(wrong[0]), "probabilities in [0, 1]")
        return table

    @classmethod
    def join_types(
        cls, relevant: Sequence[ArrayLike], tables: Sequence[NDArray[np.float64]]
    ) -> LabelTable:
        """Makes a table from types with different numbers r_t of relevant messages.

        Args:
            relevant: for each type, its r_t relevant messages, ascending.
            tables: for each type, [m, 2^r_t] P(label is 1).
        """
        rows = [np.asarray(row, dtype=np.int64).tolist() for row in relevant]
        width = max(map(len, rows))
        sets = np.arange(1 << width)
        own = [p[:, sets & (1 << len(row)) - 1] for row, p in zip(rows, tables, strict=True)]
        return cls(_pad_rows(rows, width), np.stack(own, axis=-1))

    @property
    def n_types(self) -> int:
        """N, the number of types."""
        return len(self.relevant)

    @property
    def rows(self) -> list[list[int]]:
        """The relevant messages of each type, ascending."""
        return [[j for j in row if j != NONE] for row in self.relevant.tolist()]

    def effective(self) -> list[tuple[int, ...]]:
        """Lists the messages of each type that change some label or answer, ascending."""
        return self._effective

    @cached_property
    def _effective(self) -> list[tuple[int, ...]]:
        both = self._both
        return [
            tuple(row[i] for i in _find_effective_bits(both[..., t : t + 1]) if i < len(row))
            for t, row in enumerate(self.rows)
        ]

    def effective_of_any(self) -> tuple[int, ...]:
        """Lists the messages that change some label or answer of some type, ascending."""
        return tuple(sorted(set().union(*self._effective)))

    @property
    def _both(self) -> NDArray[np.float64]:
        """[m or 2 m, 2^r, N] P(label is 1), followed by P(answer is 1) if answers differ from
        labels."""
        return np.concatenate([self.p, self.answers]) if self.answers.size else self.p

    def subset(self, given: int | NDArray[np.int64]) -> NDArray[np.int64]:
        """Returns [N] the index of message set H (``given``) in the middle axis of ``p``, which
        differs by type; [T, N] for T message sets [T, 1, 1]."""
        messages, bits = self._bits
        where: NDArray[np.int64] = ((given >> messages & 1) * bits).sum(axis=-1)
        return where

    @cached_property
    def _bits(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The arrays from which :meth:`subset` computes an index: [N, r] the relevant messages, and
        [N, r] the number that each given message adds to the index. Both are 0 for pads. Cached,
        because every step of every explanation computes an index."""
        bits = (self.relevant != NONE) << np.arange(self.relevant.shape[1])
        return np.maximum(self.relevant, 0), bits

    def label_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """Returns [N, count] P(label 1) of the first ``count`` transitions, given message set H."""
        return self._select_set(self.p, count, given)

    def answer_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """Returns [N, count] P(answer 1) of the first ``count`` transitions, given message set
        H."""
        return self._select_set(self.answered, count, given)

    def _select_set(self, p: NDArray[np.float64], count: int, given: int) -> NDArray[np.float64]:
        own = p[:count, self.subset(given), np.arange(self.n_types)]
        return np.ascontiguousarray(own.T)

    def select_messages(self, rows: Rows) -> LabelTable:
        """Makes a table in which only some messages are relevant. It has the probabilities of this
        table if no other message is given.

        Args:
            rows: for each type, its relevant messages in the new table, ascending.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages of a type.
        """
        width = max(map(len, rows))
        relevant = _pad_rows(rows, width)
        if np.array_equal(relevant, self.relevant):
            return self
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
                places[key] = _locate_subsets(row, old, width)
            where.append(places[key])

        def read(p: NDArray[np.float64]) -> NDArray[np.float64]:
            if len(places) == 1:
                return p[:, where[0]]
            return np.stack([p[:, at, t] for t, at in enumerate(where)], axis=-1)

        return self._change_arrays(relevant, read)

    def array(self, n: int) -> NDArray[np.float64]:
        """Returns [N, m, 2^n] P(label is 1 | type, transition, message set) for all sets of n
        messages.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages.
        """
        return self.select_messages([range(n)] * self.n_types).p.transpose(2, 0, 1)

    def compact(self, n: int) -> LabelTable:
        """Converts the table to the form in which tables are stored: dense if there are at most
        DENSE messages, otherwise with only the messages that change some label or answer."""
        return self.select_messages([range(n)] * self.n_types if n <= DENSE else self.effective())

    def of_types(self, types: Sequence[int]) -> LabelTable:
        """Returns the table of the types with these indices."""
        return self._change_arrays(self.relevant[list(types)], lambda p: p[:, :, list(types)])

    def of_steps(self, steps: Sequence[int]) -> LabelTable:
        """Returns the table of the transitions with these indices; row i of it is transition
        ``steps[i]``."""
        return self._change_arrays(self.relevant, lambda p: p[list(steps)])

    def repeat_types(self, times: int) -> LabelTable:
        """Returns a table with ``times`` copies of each type; the copies of a type follow each
        other."""
        return self._change_arrays(
            self.relevant.repeat(times, axis=0), lambda p: p.repeat(times, axis=-1)
        )

    def mix_types(self, weights: NDArray[np.float64]) -> LabelTable:
        """Replaces all types by one type. Its P(label is 1) is the mean over all types, weighted by
        ``weights`` [N]. Its answers equal its labels, because answers of a single type give no
        information.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages matter to some type.
        """
        together = self.select_messages([self.effective_of_any()] * self.n_types)
        # Weights may sum to slightly more than 1.
        p = (together.p * weights).sum(axis=-1, keepdims=True).clip(0, 1)
        return LabelTable(together.relevant[:1], p)


def join_steps(parts: Sequence[LabelTable]) -> LabelTable:
    """Concatenates the transitions of several tables for the same types.

    Raises:
        TooLargeError: more than MAX_RELEVANT messages matter to one type.
    """
    by_type = zip(*(part.rows for part in parts), strict=True)
    union = [sorted(set().union(*rows)) for rows in by_type]
    whole = [part.select_messages(union) for part in parts]
    relevant, p = whole[0].relevant, np.concatenate([part.p for part in whole])
    if not any(part.answers.size for part in whole):
        return LabelTable(relevant, p)
    return LabelTable(relevant, p, np.concatenate([part.answered for part in whole]))


def stack_types(parts: Sequence[LabelTable]) -> LabelTable:
    """Concatenates the types of several tables for the same transitions."""
    rows = [row for part in parts for row in part.rows]
    tables = [part.p[:, :, t] for part in parts for t in range(part.n_types)]
    return LabelTable.join_types(rows, tables)


def _pad_rows(rows: Rows, width: int) -> NDArray[np.int64]:
    relevant = np.full((len(rows), width), NONE, dtype=np.int64)
    for own, row in zip(relevant, rows, strict=True):
        own[: len(row)] = row
    return relevant


def _locate_subsets(row: Sequence[int], old: Sequence[int], width: int) -> NDArray[np.int64]:
    """Computes, for each subset of the messages ``row``, its index in a table over the messages
    ``old``. A message that is not in ``old`` has no effect.

    Args:
        row: messages; bit i of a subset's number is message ``row[i]``.
        old: relevant messages of the table.
        width: number of bits of a subset's number, at least ``len(row)``; further bits have no
            effect.

    Returns:
        [2^width] the index of each subset in the table.
    """
    sets = np.arange(1 << width)
    where = np.zeros_like(sets)
    for i, j in enumerate(row):
        if j in old:
            where |= (sets >> i & 1) << old.index(j)
    return where


def _check_array(key: str, value: ArrayLike) -> NDArray[np.float64]:
    """Converts a table to an array [types, steps, entries] of float64.

    Raises:
        InputError: the table has another shape, or has values that are not numbers.
    """
    try:
        p = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, value, "numbers") from None
    if p.ndim != 3 or min(p.shape[0], p.shape[2]) < 1:
        raise InputError(key, p.shape, "a table [types, steps, 2**messages]")
    return p


def _find_effective_bits(p: NDArray[np.float64]) -> tuple[int, ...]:
    """Finds the bits of the middle index that change some entry of ``p`` [m, 2^n, N], ascending."""
    n = p.shape[1].bit_length() - 1
    alone = (p[:, [1 << j for j in range(n)]] != p[:, :1]).any(axis=(0, 2))
    effective = []
    for j in reversed(range(n)):
        pairs = p.reshape(len(p), p.shape[1] >> j + 1, 2, 1 << j, p.shape[2])
        if alone[j] or (pairs[:, :, 0] != pairs[:, :, 1]).any():
            effective.append(j)
        else:
            p = pairs[:, :, 0].reshape(len(p), p.shape[1] >> 1, p.shape[2])  # without bit j
    return tuple(reversed(effective))
