"""The explanation problem of one trace: all that a solver needs to know (docs/method.md §5).

The literal POMDP has states ⟨k, L, E_given, E_next, t⟩. Labels are drawn afresh each step, so
(k, H, belief) with H = E_given ∪ E_next is a sufficient state, and one table of label
probabilities, ``p_explicable[t, i, H]``, is the whole model.
"""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError

MAX_MESSAGES = 20
"""Tables over message sets hold 2^messages entries; beyond 2^20 no solver here is of use."""

DiscountPer = Literal["action", "step"]


@dataclass(frozen=True)
class Problem:
    """One trace of m transitions, n messages, N user types.

    Attributes:
        p_explicable: [N, m, 2^n] float64, P(label of transition i is 1 | type t, message set H).
            Kept without a copy where it is a float64 array: leave it as it is afterwards.
        message_cost: [n] float64 ≥ 0, C_e of each message (undiscounted, before λ).
        inexplicability_cost: C_inexp ≥ 0 of each label 0.
        trade_off: λ ≥ 0.
        discount: γ_E in (0, 1].
        prior: [N] float64, sums to 1.
        discount_per: "action" (the paper: each message and each *explain* discounts) or "step"
            (only *explain* does).
        message_names, type_names: for people; as long as n and N.
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

    def __post_init__(self) -> None:
        """Checks every field (one clear line each) and makes the arrays read-only."""
        p = _table(self.p_explicable)
        if p.ndim != 3 or min(p.shape) < 1:
            raise InputError("p_explicable", p.shape, "a table [types, steps, 2**messages]")
        n = int(p.shape[2]).bit_length() - 1
        if n > MAX_MESSAGES:
            raise InputError("p_explicable", p.shape, f"at most 2**{MAX_MESSAGES} message sets")
        if p.shape[2] != 1 << n:
            raise InputError("p_explicable", p.shape, "the last axis must be a power of two")
        if not (p.min() >= 0 and p.max() <= 1):
            raise InputError("p_explicable", _first_outside(p), "probabilities in [0, 1]")
        cost = _numbers("message_cost", self.message_cost)
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
        return int(self.p_explicable.shape[2]).bit_length() - 1

    def label_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """[N, count] P(label 1) of the first so many transitions, with message set H given."""
        return self.p_explicable[:, :count, given]

    def with_types(self, p_explicable: NDArray[np.float64], type_names: tuple[str, ...]) -> Problem:
        """The same trace and costs with other user types, equally likely a priori."""
        uniform = np.full(len(p_explicable), 1 / len(p_explicable))
        return replace(self, p_explicable=p_explicable, type_names=type_names, prior=uniform)

    def only_types(self, types: Sequence[int]) -> Problem:
        """The same trace and costs with some of the user types, equally likely a priori."""
        names = tuple(self.type_names[t] for t in types)
        return self.with_types(self.p_explicable[list(types)], names)

    def mixture(self, weights: NDArray[np.float64], name: str = "everyone") -> Problem:
        """The same trace and costs with one type, whose labels are as likely as those of a user
        drawn from the types by ``weights`` [N], anew for every label."""
        return self.with_types(np.tensordot(weights, self.p_explicable, 1)[None], (name,))

    def pessimistic(self) -> Problem:
        """The same trace and costs with one type, to whom each transition is as inexplicable as
        to any."""
        return self.with_types(self.p_explicable.min(axis=0, keepdims=True), ("pessimist",))

    def messages_with_effect(self) -> tuple[int, ...]:
        """The positions of the messages that change some P[t, i, H], ascending."""
        alone = self.p_explicable[:, :, [1 << j for j in range(self.n_messages)]]
        clear = (alone != self.p_explicable[:, :, :1]).any(axis=(0, 1))
        table, effective = self.p_explicable, []
        for j in reversed(range(self.n_messages)):
            pairs = table.reshape(-1, 2, 1 << j)
            if clear[j] or (pairs[:, 0] != pairs[:, 1]).any():
                effective.append(j)
            else:
                table = pairs[:, 0]  # without this message half of the table is left
        return tuple(reversed(effective))

    def with_messages(self, kept: tuple[int, ...]) -> Problem:
        """The problem with only some messages (ascending positions); the others are never
        given."""
        if len(kept) == self.n_messages:
            return self
        sets = np.arange(1 << len(kept))
        whole = sum(((sets >> i & 1) << j for i, j in enumerate(kept)), start=np.zeros_like(sets))
        return replace(
            self,
            p_explicable=self.p_explicable[:, :, whole],
            message_cost=self.message_cost[list(kept)],
            message_names=tuple(self.message_names[j] for j in kept),
        )

    def save(self, path: str | Path) -> None:
        """Writes an ``.npz`` file that :meth:`load` reads; arrays of numbers and text only."""
        np.savez_compressed(
            path,
            p_explicable=self.p_explicable,
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
        """Reads a file of :meth:`save` (or of anyone: only ``p_explicable`` and
        ``message_cost`` are mandatory), never unpickling.

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
        missing = {"p_explicable", "message_cost"} - arrays.keys()
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
        return cls(**values)


def _numbers(key: str, value: ArrayLike) -> NDArray[np.float64]:
    """A float64 copy without NaN or infinities."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, value, "numbers") from None
    if not np.isfinite(array).all():
        raise InputError(key, array[~np.isfinite(array)].flat[0].item(), "finite numbers")
    return array


def _table(value: ArrayLike) -> NDArray[np.float64]:
    """A view, not a copy: the table may be the largest thing in memory. Its range is checked by
    the caller, which finds NaN too."""
    try:
        return np.ascontiguousarray(value, dtype=np.float64).view()
    except (TypeError, ValueError):
        raise InputError("p_explicable", value, "numbers") from None


def _number(key: str, value: Any) -> float:
    array = _numbers(key, value)
    if array.ndim != 0:
        raise InputError(key, value, "one number")
    return float(array)


def _first_outside(p: NDArray[np.float64]) -> float:
    return float(p[~((p >= 0) & (p <= 1))][0])
