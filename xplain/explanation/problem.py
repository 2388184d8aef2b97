"""The explanation problem of one trace: all that a solver needs to know (docs/method.md §5).

The literal POMDP has states ⟨k, L, E_given, E_next, t⟩. Labels are drawn afresh each step, so
(k, H, belief) with H = E_given ∪ E_next is a sufficient state, and one table of label
probabilities (:mod:`xplain.explanation.label_table`) is the whole model.
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, number
from xplain.explanation.again import Again
from xplain.explanation.asking import PREFIX, Questions
from xplain.explanation.habits import PAPER, Habits
from xplain.explanation.label_table import MAX_MESSAGES, LabelTable, joined
from xplain.explanation.message_sets import indices

DiscountPer = Literal["action", "step"]


@dataclass(frozen=True)
class Problem:
    """One trace of m transitions, n messages, N hidden types.

    A hidden type is a user type or, where habits differ or users fail, a user type with a habit
    (:meth:`with_habits`): then M user types with F habits are N = M F hidden types. Beliefs are
    over the hidden types, [N]; where messages may be missed or forgotten, over what each knows as
    well, [rows · N], a row being a set of facts relevant to the type.

    Attributes:
        table: P(label of transition i is 1 | type t, message set H); given as an array
            [N, m, 2^n], it becomes a dense :class:`LabelTable`.
        message_cost: [n] float64 ≥ 0, C_e of each message (undiscounted, before λ).
        inexplicability_cost: C_inexp ≥ 0 of each label 0.
        trade_off: λ ≥ 0.
        discount: γ_E in (0, 1].
        prior: [N] float64, sums to 1.
        discount_per: "action" (the paper: each message and each *explain* discounts) or "step"
            (only *explain* does).
        message_names, type_names: for people; n and M names.
        habits: the F habits, side by side within a user type. The table's answers have their
            errors already.
        questions: that may be asked, of the same hidden types; None for none (the paper).
        again: of messages said again, where users may miss or forget some.
    """

    table: LabelTable
    message_cost: NDArray[np.float64]
    inexplicability_cost: float = 1.0
    trade_off: float = 1.0
    discount: float = 0.95
    prior: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    discount_per: DiscountPer = "action"
    message_names: tuple[str, ...] = ()
    type_names: tuple[str, ...] = ()
    habits: Habits = PAPER
    questions: Questions | None = None
    again: Again = field(default_factory=Again)

    def __post_init__(self) -> None:
        """Checks every field: one clear line each."""
        given: Any = self.table
        table = given if isinstance(given, LabelTable) else LabelTable.dense(given)
        types, steps = table.n_types, len(table.p)
        if steps < 1:
            raise InputError("p_explicable", table.p.shape, "at least one transition")
        cost = _numbers("message_cost", self.message_cost)
        if not isinstance(given, LabelTable):
            n = table.relevant.shape[1]
        elif self.message_names or cost.ndim == 1:
            n = len(self.message_names or cost)
        else:
            raise InputError("message_cost", cost.tolist(), "one cost a message, or message_names")
        if n > MAX_MESSAGES:
            raise InputError("message_cost", n, f"at most {MAX_MESSAGES} messages")
        if self.tracks_knowledge and n * self.again.levels > MAX_MESSAGES:
            wanted = f"at most {MAX_MESSAGES // n} with {n} messages, or null for no limit"
            raise InputError("again.most", self.again.most, wanted)
        cost = np.full(n, float(cost)) if cost.ndim == 0 else cost
        if cost.shape != (n,) or (cost < 0).any():
            raise InputError("message_cost", cost.tolist(), f"{n} costs ≥ 0, one a message")
        unknown = table.relevant[table.relevant >= n]
        if unknown.size:
            raise InputError("relevant", int(unknown[0]), f"a message 0 … {n - 1}, or −1")
        prior = np.asarray(self.prior)
        prior = np.full(types, 1 / types) if prior.size == 0 else _numbers("prior", prior)
        if prior.shape != (types,) or (prior < 0).any() or abs(prior.sum() - 1) > 1e-6:
            raise InputError("prior", prior.tolist(), f"{types} probabilities that sum to 1")
        # A prior that sums to 1 but for rounding stays to the last bit, however often a problem is
        # made of another: decisions and replays must not hang on it.
        if abs(prior.sum() - 1) > 1e-12:
            prior = prior / prior.sum()
        if self.questions is not None:
            self.questions.check(types, n, steps)
        known, left = divmod(types, len(self.habits))
        if left:
            wanted = f"a divisor of {types}, the columns of the table"
            raise InputError("habits", len(self.habits), wanted)
        checked: dict[str, Any] = {
            "table": table,
            "message_cost": cost,
            "prior": prior,
            "inexplicability_cost": _number("inexplicability_cost", self.inexplicability_cost),
            "trade_off": _number("lambda", self.trade_off),
            "discount": _number("discount", self.discount),
            "message_names": tuple(self.message_names) or tuple(f"message_{j}" for j in range(n)),
            "type_names": tuple(self.type_names) or tuple(f"type_{t}" for t in range(known)),
        }
        if checked["inexplicability_cost"] < 0:
            raise InputError("inexplicability_cost", self.inexplicability_cost, "a number ≥ 0")
        if checked["trade_off"] < 0:
            raise InputError("lambda", self.trade_off, "a number ≥ 0")
        if not 0 < checked["discount"] <= 1:
            raise InputError("discount", self.discount, "a number in (0, 1]")
        if self.discount_per not in ("action", "step"):
            raise InputError("discount_per", self.discount_per, "action or step")
        for key, length in (("message_names", n), ("type_names", known)):
            if len(checked[key]) != length:
                raise InputError(key, checked[key], f"{length} names")
        cost.flags.writeable = False
        for key, value in checked.items():
            object.__setattr__(self, key, value)

    @classmethod
    def of_before(cls, content: Mapping[str, Any]) -> Mapping[str, Any]:
        """Stored with ``p_explicable`` or with ``relevant`` and ``p_relevant``, as before there was
        one form of table (:class:`~xplain.storage.WasOtherwise`)."""
        rest = dict(content)
        dense, relevant, p = (rest.pop(k, ()) for k in ("p_explicable", "relevant", "p_relevant"))
        if "table" in rest:
            return rest
        own = np.size(p) or np.size(relevant)
        table = LabelTable.by_type(relevant, p) if own else LabelTable.dense(dense)
        return rest | {"table": {"relevant": table.relevant, "p": table.p}}

    @property
    def n_types(self) -> int:
        """N, the number of hidden types."""
        return self.table.n_types

    @property
    def n_user_types(self) -> int:
        """M, the number of user types."""
        return len(self.type_names)

    @property
    def n_steps(self) -> int:
        """m, the transitions of the trace; the horizon in *explain* actions."""
        return len(self.table.p)

    @property
    def n_messages(self) -> int:
        """n, the number of messages."""
        return len(self.message_cost)

    @property
    def is_dense(self) -> bool:
        """Whether every type's probabilities stand over all n messages."""
        tables = (self.table, self.questions.table) if self.questions else (self.table,)
        return all(table.is_dense(self.n_messages) for table in tables)

    @property
    def p_explicable(self) -> NDArray[np.float64]:
        """[N, m, 2^n] P(label is 1 | type, transition, message set), of all message sets.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages.
        """
        table = self.table.array(self.n_messages).view()
        table.flags.writeable = False
        return table

    def label_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """[N, count] P(label 1) of the first so many transitions, with message set H given."""
        return self.table.label_probabilities(count, given)

    def answer_probabilities(self, count: int, given: int) -> NDArray[np.float64]:
        """[N, count] P(answer 1) of the first so many transitions, with message set H given."""
        return self.table.answer_probabilities(count, given)

    def type_belief(self, belief: NDArray[np.float64]) -> NDArray[np.float64]:
        """[M] over user types, of a belief [N] over hidden types."""
        if self.tracks_knowledge:
            belief = belief.reshape(-1, self.n_types).sum(axis=0)
        if self.n_user_types == self.n_types:
            return belief
        user_types: NDArray[np.float64] = belief.reshape(self.n_user_types, -1).sum(axis=1)
        return user_types

    @property
    def tracks_knowledge(self) -> bool:
        """Whether beliefs are over what users know as well: a message said is no fact known."""
        return not self.habits.take_all_in

    @property
    def levels(self) -> int:
        """Of :class:`~xplain.explanation.again.Again`, where a message may be said again."""
        return self.again.levels if self.tracks_knowledge else 0

    def may_say(self, said: int) -> int:
        """Bitmask of the messages that may come after these."""
        n = self.n_messages
        used = self.again.exhausted(said, n) if self.tracks_knowledge else said
        return (1 << n) - 1 & ~used

    def message_costs(self, said: int) -> NDArray[np.float64]:
        """[n] C_e of each message, where these were said at earlier steps."""
        repeated = [said >> j & 1 for j in range(self.n_messages)]
        return self.message_cost * np.where(repeated, self.again.price, 1.0)

    def prices(self, said: int) -> NDArray[np.float64]:
        """[n] λ C_e of each message, where these were said at earlier steps."""
        return self.trade_off * self.message_costs(said)

    def communication(self, said: Iterable[int]) -> float:
        """Σ C_e of all messages said, of bitmasks in order."""
        total, before = 0.0, 0
        for new in said:
            total += float(sum(self.message_costs(before)[indices(new)].tolist()))
            before |= new
        return total

    @property
    def accept(self) -> NDArray[np.float64]:
        """[N] α of each hidden type."""
        return np.tile(self.habits.accept, self.n_user_types)

    @property
    def forget(self) -> NDArray[np.float64]:
        """[N] φ of each hidden type."""
        return np.tile(self.habits.forget, self.n_user_types)

    @property
    def start(self) -> NDArray[np.float64]:
        """The belief before the first step: the prior, and nobody knows anything."""
        if not self.tracks_knowledge:
            return self.prior.copy()
        belief = np.zeros((self.table.p.shape[1], self.n_types))
        belief[0] = self.prior
        return belief.ravel()

    def sure(self, hidden_type: int, known: int) -> NDArray[np.float64]:
        """The belief of who sees a user's hidden type and, as a bitmask, the facts they have."""
        belief = np.zeros((self.table.p.shape[1], self.n_types))
        belief[self.table.subset(known)[hidden_type], hidden_type] = 1
        return belief.ravel() if self.tracks_knowledge else belief.sum(axis=0)

    def with_habits(self, habits: Habits) -> Problem:
        """The problem where users have one of these habits, independent of their types.

        Raises:
            TooLargeError: what users may know takes too many rows.
        """
        if habits.never_err and habits.take_all_in:
            return self
        tables = self._tables(lambda table: _erring(table, habits))
        table, asking = tables["table"], tables["questions"]
        if not habits.take_all_in:
            # A row is what somebody knows: of facts that change nothing it does not matter who
            # does. Labels and answers to questions come of the same knowledge.
            whole = joined([table, asking.table]) if asking else table
            whole = whole.over(whole.effective())
            table = whole.of_steps(range(self.n_steps))
            if asking:
                rows = range(self.n_steps, self.n_steps + len(asking))
                asking = replace(asking, table=whole.of_steps(rows))
        prior = np.outer(self.prior, habits.prior).ravel()
        return replace(self, table=table, prior=prior, habits=habits, questions=asking)

    def dense(self) -> Problem:
        """The same problem with one dense table.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages.
        """
        rows = [range(self.n_messages)] * self.n_types
        return self if self.is_dense else replace(self, **self._tables(lambda t: t.over(rows)))

    def _tables(self, change: Callable[[LabelTable], LabelTable]) -> dict[str, Any]:
        """The fields ``table`` and ``questions``, both changed alike."""
        asking = self.questions
        changed = asking and replace(asking, table=change(asking.table))
        return {"table": change(self.table), "questions": changed}

    def with_types(self, table: LabelTable, type_names: tuple[str, ...]) -> Problem:
        """The same trace and costs with other user types, equally likely a priori."""
        count = len(type_names)
        prior = np.full(count, 1 / count)
        return replace(
            self, table=table, type_names=type_names, prior=prior, habits=PAPER, questions=None
        )

    def only_types(self, types: Sequence[int]) -> Problem:
        """The same trace and costs with some of the hidden types, equally likely a priori."""
        names = tuple(self.type_names[t // len(self.habits)] for t in types)
        return self.with_types(self.table.of_types(types), names)

    def mixture(self, weights: NDArray[np.float64], name: str = "everyone") -> Problem:
        """The same trace and costs with one type, whose labels are as likely as those of a user
        drawn from the types by ``weights`` [N], anew for every label.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages matter to some type.
        """
        return self.with_types(self.table.mixed(weights), (name,))

    def pessimistic(self) -> Problem:
        """The same trace and costs with one type, to whom each transition is as inexplicable as
        to any.

        Raises:
            TooLargeError: as :meth:`mixture`.
        """
        return self.with_types(self.table.worst(), ("pessimist",))

    def messages_with_effect(self) -> tuple[int, ...]:
        """The positions of the messages that change some P[t, i, H], ascending."""
        return self.table.effective_of_any()

    def with_messages(self, kept: tuple[int, ...]) -> Problem:
        """The problem with only some messages (ascending positions); the others are never
        given."""
        if len(kept) == self.n_messages:
            return self
        return replace(
            self,
            **self._tables(lambda table: table.with_messages(kept)),
            message_cost=self.message_cost[list(kept)],
            message_names=tuple(self.message_names[j] for j in kept),
        )

    def save(self, path: str | Path) -> None:
        """Writes an ``.npz`` file that :meth:`load` reads; arrays of numbers and text only. The
        table is ``p_explicable`` [N, m, 2^n] where messages are few, else ``relevant`` [N, r] and
        ``p_relevant`` [N, m, 2^r]. Where users fail there are ``p_answered``, of the same shape,
        and ``habits`` [4, F], the fields of :class:`~xplain.explanation.habits.Habits`; where
        something may be asked, the arrays of :meth:`~xplain.explanation.asking.Questions.arrays`.
        """
        table = self.table.compact(self.n_messages)
        p = table.p.transpose(2, 0, 1)
        dense = table.is_dense(self.n_messages)
        tables = {"p_explicable": p} if dense else {"relevant": table.relevant, "p_relevant": p}
        if table.answers.size:
            tables["p_answered"] = table.answers.transpose(2, 0, 1)
        habits = self.habits
        if not (habits.never_err and habits.take_all_in):
            fields = (habits.error, habits.accept, habits.forget, habits.prior)
            tables["habits"] = np.stack(fields)
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
            again=[self.again.price, self.again.most or 0],
            **(self.questions.arrays() if self.questions else {}),
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
                arrays = {key: file[key] for key in file.files}
        except (OSError, zipfile.BadZipFile, EOFError, ValueError, TypeError) as error:
            # A ValueError means that numpy would have to unpickle, which is never done here; a
            # TypeError, that it holds one array.
            reason = getattr(error, "strerror", None) or "it must hold named arrays of numbers"
            raise InputError("problem", str(path), f"not a readable .npz file ({reason})") from None
        questions = Questions.of_arrays(arrays)
        arrays = {key: value for key, value in arrays.items() if not key.startswith(PREFIX)}
        by_type, dense = {"relevant", "p_relevant"}, {"p_explicable"}
        fields = (
            set(cls.__dataclass_fields__) - {"table", "questions"}
            | by_type
            | dense
            | {"p_answered"}
        )
        tables = by_type if arrays.keys() & by_type else dense
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
        own = [values.pop(key) for key in ("relevant", "p_relevant") if key in values]
        if own and "p_explicable" in values:
            raise InputError("problem", "p_explicable", "not beside relevant and p_relevant")
        if "again" in values:
            price, most = _numbers("again", values["again"]).tolist()
            values["again"] = Again(price, int(most) or None)
        if "habits" in values:
            values["habits"] = Habits(*_numbers("habits", values["habits"]))
        answers = values.pop("p_answered", None)
        table: Any = None if own else values.pop("p_explicable")
        if own:
            table = LabelTable.by_type(own[0], own[1], answers)
        elif answers is not None:
            table = LabelTable.dense(table, answers)
        return cls(table, questions=questions, **values)


def _erring(table: LabelTable, habits: Habits) -> LabelTable:
    """A table of users with these habits, side by side within a type."""
    erring = table.repeated(len(habits))
    if habits.never_err:
        return erring
    return replace(erring, answers=habits.answered(table.answered))


def _numbers(key: str, value: ArrayLike) -> NDArray[np.float64]:
    """A float64 copy without NaN or infinities."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, value, "numbers") from None
    if not np.isfinite(array).all():
        raise InputError(key, array[~np.isfinite(array)].flat[0].item(), "finite numbers")
    return array


def _number(key: str, value: Any) -> float:
    if isinstance(value, float):  # most are, and a problem is often made of another
        return number(key, value)
    array = _numbers(key, value)
    if array.ndim != 0:
        raise InputError(key, value, "one number")
    return float(array)
