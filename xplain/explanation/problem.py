"""The explanation problem of one trace: all that a solver needs to know (docs/method.md §5).

The literal POMDP has states ⟨k, L, E_given, E_next, t⟩. Labels are drawn afresh each step, so
(k, H, belief) with H = E_given ∪ E_next is a sufficient state, and one table of label
probabilities, ``p_explicable[t, i, H]``, is the whole model. Where messages are many, each type's
table is kept over the messages relevant to it (:mod:`xplain.explanation.by_type`).
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, number
from xplain.explanation.by_type import DENSE, ByType, LabelTable, effective_bits

MAX_MESSAGES = 62
"""A message set is a signed integer of 64 bits."""
MAX_DENSE = 20
"""A dense table holds 2^messages entries; with more messages it is kept by type."""

DiscountPer = Literal["action", "step"]


@dataclass(frozen=True)
class Problem:
    """One trace of m transitions, n messages, N user types.

    Attributes:
        p_explicable: [N, m, 2^n] float64, P(label of transition i is 1 | type t, message set H).
            Kept without a copy where it is a float64 array: leave it as it is afterwards.
            Kept by type, it is an empty array [N, m, 0].
        message_cost: [n] float64 ≥ 0, C_e of each message (undiscounted, before λ).
        inexplicability_cost: C_inexp ≥ 0 of each label 0.
        trade_off: λ ≥ 0.
        discount: γ_E in (0, 1].
        prior: [N] float64, sums to 1.
        discount_per: "action" (the paper: each message and each *explain* discounts) or "step"
            (only *explain* does).
        message_names, type_names: for people; as long as n and N.
        relevant: [N, r] int64, the messages that change some label of a type, −1 pads; with
        p_relevant: [N, m, 2^r] P(label 1 | type, subset of these), bit j being message
            ``relevant[t, j]``. Both are empty where the table is dense.
    """

    p_explicable: NDArray[np.float64]
    message_cost: NDArray[np.float64]
    inexplicability_cost: float = 1.0
    trade_off: float = 1.0
    discount: float = 0.95
    prior: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    discount_per: DiscountPer = "action"
    message_names: tuple[str, ...] = ()
    type_names: tuple[str, ...] = ()
    relevant: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 0), np.int64))
    p_relevant: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0, 0)))

    def __post_init__(self) -> None:
        """Checks every field (one clear line each) and makes the arrays read-only."""
        cost = _numbers("message_cost", self.message_cost)
        by_type = None
        if np.size(self.p_relevant) or np.size(self.relevant):
            if cost.ndim == 0 and self.message_names:
                cost = np.full(len(self.message_names), float(cost))
            by_type = self._checked_by_type(cost)
            p, n = np.empty((*by_type.p.shape[:2], 0)), len(cost)
        else:
            p = _checked_table(self.p_explicable)
            n = int(p.shape[2]).bit_length() - 1
        cost = np.full(n, float(cost)) if cost.ndim == 0 else cost
        if cost.shape != (n,) or (cost < 0).any():
            raise InputError("message_cost", cost.tolist(), f"{n} costs ≥ 0, one a message")
        prior = np.asarray(self.prior)
        prior = np.full(len(p), 1 / len(p)) if prior.size == 0 else _numbers("prior", prior)
        if prior.shape != p.shape[:1] or (prior < 0).any() or abs(prior.sum() - 1) > 1e-6:
            raise InputError("prior", prior.tolist(), f"{len(p)} probabilities that sum to 1")
        # A prior that sums to 1 but for rounding stays to the last bit, however often a problem is
        # made of another: decisions and replays must not hang on it.
        if abs(prior.sum() - 1) > 1e-12:
            prior = prior / prior.sum()
        checked: dict[str, Any] = {
            "p_explicable": p,
            "message_cost": cost,
            "prior": prior,
            "inexplicability_cost": _number("inexplicability_cost", self.inexplicability_cost),
            "trade_off": _number("lambda", self.trade_off),
            "discount": _number("discount", self.discount),
            "message_names": tuple(self.message_names) or tuple(f"message_{j}" for j in range(n)),
            "type_names": tuple(self.type_names) or tuple(f"type_{t}" for t in range(len(p))),
        }
        none = np.empty((0, 0), np.int64), np.empty((0, 0, 0))
        checked["relevant"], checked["p_relevant"] = (
            none if by_type is None else (by_type.relevant, by_type.p)
        )
        if checked["inexplicability_cost"] < 0:
            raise InputError("inexplicability_cost", self.inexplicability_cost, "a number ≥ 0")
        if checked["trade_off"] < 0:
            raise InputError("lambda", self.trade_off, "a number ≥ 0")
        if not 0 < checked["discount"] <= 1:
            raise InputError("discount", self.discount, "a number in (0, 1]")
        if self.discount_per not in ("action", "step"):
            raise InputError("discount_per", self.discount_per, "action or step")
        for key, length in (("message_names", n), ("type_names", len(p))):
            if len(checked[key]) != length:
                raise InputError(key, checked[key], f"{length} names")
        for key, value in checked.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, key, value)

    def _checked_by_type(self, cost: NDArray[np.float64]) -> ByType:
        if np.size(self.p_explicable):
            shape = np.shape(self.p_explicable)
            raise InputError("p_explicable", shape, "empty beside relevant and p_relevant")
        if cost.ndim != 1:
            raise InputError("message_cost", cost.tolist(), "one cost a message, or message_names")
        if len(cost) > MAX_MESSAGES:
            raise InputError("message_cost", len(cost), f"at most {MAX_MESSAGES} messages")
        by_type = ByType.checked(self.relevant, self.p_relevant, len(cost))
        _check_probabilities("p_relevant", by_type.p)
        return by_type

    @classmethod
    def of_table(cls, table: LabelTable, message_cost: NDArray[np.float64], **rest: Any) -> Problem:
        """A problem with a table of either form; ``rest`` are the other fields, by name."""
        if isinstance(table, ByType):
            return cls.of_types(table, message_cost, **rest)
        return cls(table, message_cost, **rest)

    @classmethod
    def of_types(cls, by_type: ByType, message_cost: NDArray[np.float64], **rest: Any) -> Problem:
        """A problem with tables kept by type; ``rest`` are the other fields, by name."""
        none = np.empty((*by_type.p.shape[:2], 0))
        arrays: dict[str, Any] = {"relevant": by_type.relevant, "p_relevant": by_type.p}
        return cls(none, message_cost, **arrays, **rest)

    @property
    def by_type(self) -> ByType | None:
        """The tables kept by type; None where one dense table is kept."""
        return ByType(self.relevant, self.p_relevant) if self.p_relevant.size else None

    @property
    def n_types(self) -> int:
        """N, the number of user types."""
        return int(self.p_explicable.shape[0])

    @property
    def n_steps(self) -> int:
        """m, the transitions of the trace; the horizon in *explain* actions."""
        return int(self.p_explicable.shape[1])

    @property
    def n_messages(self) -> int:
        """n, the number of messages."""
        return len(self.message_cost)

    def label_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """[N, count] P(label 1) of the first so many transitions, with message set H given."""
        if self.by_type is not None:
            return self.by_type.label_probabilities(count, given)
        return self.p_explicable[:, :count, given]

    def dense(self) -> Problem:
        """The same problem with one dense table.

        Raises:
            TooLargeError: more than MAX_DENSE messages.
        """
        if self.by_type is None:
            return self
        return self._with_table(self.by_type.over(range(self.n_messages)))

    def _with_table(self, table: LabelTable, **changes: Any) -> Problem:
        """Another table, dense or by type."""
        tables: dict[str, Any]
        if isinstance(table, ByType):
            none = np.empty((*table.p.shape[:2], 0))
            tables = {"p_explicable": none, "relevant": table.relevant, "p_relevant": table.p}
        else:
            empty = np.empty((0, 0), np.int64), np.empty((0, 0, 0))
            tables = {"p_explicable": table, "relevant": empty[0], "p_relevant": empty[1]}
        return replace(self, **tables, **changes)

    def with_types(self, p_explicable: LabelTable, type_names: tuple[str, ...]) -> Problem:
        """The same trace and costs with other user types, equally likely a priori."""
        count = len(type_names)
        uniform = np.full(count, 1 / count)
        return self._with_table(p_explicable, type_names=type_names, prior=uniform)

    def only_types(self, types: Sequence[int]) -> Problem:
        """The same trace and costs with some of the user types, equally likely a priori."""
        names = tuple(self.type_names[t] for t in types)
        if self.by_type is not None:
            return self.with_types(self.by_type.of_types(types), names)
        return self.with_types(self.p_explicable[list(types)], names)

    def mixture(self, weights: NDArray[np.float64], name: str = "everyone") -> Problem:
        """The same trace and costs with one type, whose labels are as likely as those of a user
        drawn from the types by ``weights`` [N], anew for every label.

        Raises:
            TooLargeError: kept by type, and more than MAX_DENSE messages matter to some type.
        """
        if self.by_type is not None:
            return self.with_types(self.by_type.mixed(weights), (name,))
        # Weights may sum to a hair more than 1.
        mixed = np.minimum(np.tensordot(weights, self.p_explicable, 1)[None], 1)
        return self.with_types(mixed, (name,))

    def pessimistic(self) -> Problem:
        """The same trace and costs with one type, to whom each transition is as inexplicable as
        to any.

        Raises:
            TooLargeError: as :meth:`mixture`.
        """
        if self.by_type is not None:
            return self.with_types(self.by_type.worst(), ("pessimist",))
        return self.with_types(self.p_explicable.min(axis=0, keepdims=True), ("pessimist",))

    def messages_with_effect(self) -> tuple[int, ...]:
        """The positions of the messages that change some P[t, i, H], ascending."""
        if self.by_type is not None:
            return tuple(sorted(set().union(*self.by_type.effective())))
        return effective_bits(self.p_explicable)

    def with_messages(self, kept: tuple[int, ...]) -> Problem:
        """The problem with only some messages (ascending positions); the others are never
        given."""
        if len(kept) == self.n_messages:
            return self
        changes: dict[str, Any] = {
            "message_cost": self.message_cost[list(kept)],
            "message_names": tuple(self.message_names[j] for j in kept),
        }
        if self.by_type is not None:
            return self._with_table(self.by_type.with_messages(kept), **changes)
        sets = np.arange(1 << len(kept))
        whole = sum(((sets >> i & 1) << j for i, j in enumerate(kept)), start=np.zeros_like(sets))
        return self._with_table(self.p_explicable[:, :, whole], **changes)

    def save(self, path: str | Path) -> None:
        """Writes an ``.npz`` file that :meth:`load` reads; arrays of numbers and text only. The
        table is written by type where that is smaller, but with few messages it is dense."""
        tables: dict[str, Any] = {"p_explicable": self.p_explicable}
        if self.n_messages > DENSE:
            by_type = self.by_type or ByType.of_table(self.p_explicable)
            if self.by_type or by_type.p.size < self.p_explicable.size:
                tables = {"relevant": by_type.relevant, "p_relevant": by_type.p}
        elif self.by_type:
            tables = {"p_explicable": self.dense().p_explicable}
        np.savez_compressed(
            path,
            **tables,
            message_cost=self.message_cost,
            inexplicability_cost=self.inexplicability_cost,
            trade_off=self.trade_off,
            discount=self.discount,
            discount_per=self.discount_per,
            prior=self.prior,
            message_names=np.array(self.message_names, dtype=np.str_),
            type_names=np.array(self.type_names, dtype=np.str_),
        )

    @classmethod
    def load(cls, path: str | Path) -> Problem:
        """Reads a file of :meth:`save` (or of anyone: only ``message_cost`` and either
        ``p_explicable`` or ``relevant`` and ``p_relevant`` are mandatory), never unpickling.

        Raises:
            InputError: no such file, not an ``.npz``, a missing or unknown array, or values out
                of range.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                if not hasattr(file, "files"):
                    raise InputError("problem", str(path), "an .npz file of named arrays")
                arrays = {key: file[key] for key in file.files}
        except (OSError, zipfile.BadZipFile, EOFError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            # A ValueError means that numpy would have to unpickle, which is never done here.
            reason = getattr(error, "strerror", None) or "it must hold named arrays of numbers"
            raise InputError("problem", str(path), f"not a readable .npz file ({reason})") from None
        fields = set(cls.__dataclass_fields__)
        by_type = {"relevant", "p_relevant"}
        tables = by_type if arrays.keys() & by_type else {"p_explicable"}
        missing = ({"message_cost"} | tables) - arrays.keys()
        if missing:
            raise InputError("problem", str(path), f"lacks {', '.join(sorted(missing))}")
        unknown = arrays.keys() - fields
        if unknown:
            raise InputError(
                "problem", sorted(unknown)[0], f"unknown array; known: {', '.join(sorted(fields))}"
            )
        values: dict[str, Any] = dict(arrays)
        for key in ("inexplicability_cost", "trade_off", "discount", "discount_per"):
            if key in values and values[key].ndim == 0:
                values[key] = values[key].item()
        for key in ("message_names", "type_names"):
            if key in values:
                values[key] = tuple(str(name) for name in values[key].tolist())
        return cls(**{"p_explicable": np.empty((0, 0, 0))} | values)


def _numbers(key: str, value: ArrayLike) -> NDArray[np.float64]:
    """A float64 copy without NaN or infinities."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, value, "numbers") from None
    if not np.isfinite(array).all():
        raise InputError(key, array[~np.isfinite(array)].flat[0].item(), "finite numbers")
    return array


def _checked_table(value: ArrayLike) -> NDArray[np.float64]:
    """A view, not a copy: the table may be the largest thing in memory."""
    try:
        p = np.ascontiguousarray(value, dtype=np.float64).view()
    except (TypeError, ValueError):
        raise InputError("p_explicable", value, "numbers") from None
    if p.ndim != 3 or min(p.shape) < 1:
        raise InputError("p_explicable", p.shape, "a table [types, steps, 2**messages]")
    n = int(p.shape[2]).bit_length() - 1
    if n > MAX_DENSE:
        allowed = f"at most 2**{MAX_DENSE} message sets; relevant and p_relevant hold more"
        raise InputError("p_explicable", p.shape, allowed)
    if p.shape[2] != 1 << n:
        raise InputError("p_explicable", p.shape, "the last axis must be a power of two")
    _check_probabilities("p_explicable", p)
    return p


def _check_probabilities(key: str, p: NDArray[np.float64]) -> None:
    """Raises InputError for what is outside [0, 1], NaN among it."""
    if not (p.min() >= 0 and p.max() <= 1):
        raise InputError(key, float(p[~((p >= 0) & (p <= 1))][0]), "probabilities in [0, 1]")


def _number(key: str, value: Any) -> float:
    if isinstance(value, float):  # most are, and a problem is often made of another
        return number(key, value)
    array = _numbers(key, value)
    if array.ndim != 0:
        raise InputError(key, value, "one number")
    return float(array)
