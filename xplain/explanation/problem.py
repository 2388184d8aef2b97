"""The explanation problem of one trace: everything that a solver needs (docs/method.md §5).

The literal POMDP has states ⟨k, L, E_given, E_next, t⟩. Labels are drawn independently each step,
so (k, H, belief) with H = E_given ∪ E_next is a sufficient state, and one table of label
probabilities (:mod:`xplain.explanation.label_table`) is the whole model.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, Range, number, one_of
from xplain.explanation.asking import Questions
from xplain.explanation.habits import PAPER, Habits
from xplain.explanation.label_table import MAX_MESSAGES, LabelTable, join_steps
from xplain.explanation.message_sets import indices

DiscountPer = Literal["action", "step"]
COST = Range(0)


@dataclass(frozen=True)
class Problem:
    """One trace of m transitions, n messages, N hidden types.

    A hidden type is a user type or, if habits differ or users err, a user type with a habit
    (:meth:`with_habits`). M user types with F habits are then N = M F hidden types. Beliefs are
    over the hidden types, [N]. If messages may be missed or forgotten, beliefs are over each type's
    knowledge as well, [rows · N]; a row is a set of facts relevant to the type.

    Attributes:
        table: P(label of transition i is 1 | type t, message set H); an array [N, m, 2^n] becomes a
            dense :class:`LabelTable`.
        message_cost: [n] float64 ≥ 0, C_e of each message (undiscounted, before λ).
        inexplicability_cost: C_inexp ≥ 0 of each label 0.
        trade_off: λ ≥ 0.
        discount: γ_E in (0, 1].
        prior: [N] float64, sums to 1.
        discount_per: "action" (the paper: each message and each *explain* discounts) or "step"
            (only *explain* does).
        message_names, type_names: n and M readable names.
        habits: the F habits; hidden type t has habit ``t mod F``. The table's answers already
            include the errors of the habits.
        questions: possible questions, for the same hidden types; none in the paper.
        whose: [N] user type of each hidden type; by default, hidden type t has user type
            ``t // F``.
        as_found: [N] True if a hidden type is a found user type with the assumed habits; by default
            True for all.
        copies: [m] for each transition, the index of the first equal transition. People who repeat
            themselves give equal labels and errors to copies. By default no two transitions are
            equal.
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
    questions: Questions = field(default_factory=Questions)
    copies: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    whose: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    as_found: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))

    def __post_init__(self) -> None:
        """Checks and converts every field. Raises InputError, with a message of one line, for an
        invalid field."""
        given: Any = self.table
        table = given if isinstance(given, LabelTable) else LabelTable.dense(given)
        types, steps = table.n_types, len(table.p)
        if steps < 1:
            raise InputError("p_explicable", table.p.shape, "at least one transition")
        # A table by type does not have the number of messages.
        count = (len(self.message_names) or None) if given is table else table.relevant.shape[1]
        cost = expand_costs(self.message_cost, count)
        n = len(cost)
        asking = self.questions or Questions(table.of_steps([]))
        if not asking.shows.size:  # no question is about a transition of the trace
            asking = replace(asking, shows=np.zeros((len(asking), steps), np.bool_))
        if asking.table.n_types != types or asking.shows.shape[1] != steps:
            found = asking.table.n_types, asking.shows.shape[1]
            raise InputError("questions", found, f"{types} types and {steps} steps, or 0 steps")
        for key, own in (
            ("relevant", table.relevant),
            ("questions.relevant", asking.table.relevant),
        ):
            if own.max(initial=-1) >= n:
                raise InputError(key, int(own.max()), f"a message 0 … {n - 1}, or −1")
        copies = np.asarray(self.copies) if len(self.copies) else np.arange(steps)
        if copies.shape != (steps,) or not ((copies >= 0) & (copies <= np.arange(steps))).all():
            raise InputError(
                "copies",
                copies.tolist(),
                f"for each of {steps} steps, the index of that step or of an earlier step",
            )
        known, left = divmod(types, len(self.habits))
        if left:
            wanted = f"a divisor of {types}, the columns of the table"
            raise InputError("habits", len(self.habits), wanted)
        whose, as_found = np.asarray(self.whose), np.asarray(self.as_found)
        if not len(whose):
            whose = np.repeat(np.arange(known), len(self.habits))
        if not len(as_found):
            as_found = np.ones(types, np.bool_)
        if whose.shape != (types,) or as_found.shape != (types,):
            raise InputError("whose", whose.shape, f"a user type of each of {types} hidden types")
        one_of("discount_per", self.discount_per, get_args(DiscountPer))
        checked: dict[str, Any] = {
            "table": table,
            "message_cost": cost,
            "prior": check_distribution(self.prior, types),
            "inexplicability_cost": number("inexplicability_cost", self.inexplicability_cost, COST),
            "trade_off": number("lambda (trade_off)", self.trade_off, COST),
            "discount": number("discount", self.discount, Range(0, 1, "(]")),
            "message_names": check_names("message_names", self.message_names, n, "message"),
            "type_names": check_names("type_names", self.type_names, int(whose.max()) + 1, "type"),
            "questions": asking,
            "copies": copies,
            "whose": whose,
            "as_found": as_found,
        }
        for key, value in checked.items():
            object.__setattr__(self, key, value)

    @property
    def n_types(self) -> int:
        """N, the number of hidden types."""
        return self.table.n_types

    @property
    def n_user_types(self) -> int:
        """M, the number of user types."""
        return len(self.type_names)

    @property
    def found_types(self) -> tuple[str, ...]:
        """The names of the user types that were found."""
        return self.type_names[: 1 + int(self.whose[self.as_found].max())]

    @property
    def n_steps(self) -> int:
        """m, the number of transitions, which is the horizon in *explain* actions."""
        return len(self.table.p)

    @property
    def n_messages(self) -> int:
        """n, the number of messages."""
        return len(self.message_cost)

    @cached_property
    def messages_with_effect(self) -> tuple[int, ...]:
        """The messages, ascending, that change a label of the trace or an answer to a question for
        at least one hidden type. Only these are useful actions."""
        tables = self.table, self.questions.table
        return tuple(sorted({j for table in tables for j in table.effective_of_any()}))

    @property
    def p_explicable(self) -> NDArray[np.float64]:
        """[N, m, 2^n] P(label is 1 | type, transition, message set).

        Raises:
            TooLargeError: more than MAX_RELEVANT messages.
        """
        table = self.table.array(self.n_messages).view()
        table.flags.writeable = False
        return table

    def type_belief(self, belief: NDArray[np.float64]) -> NDArray[np.float64]:
        """Computes [M] the belief over user types from a belief over hidden states."""
        if not self.messages_land:
            belief = belief.reshape(-1, self.n_types).sum(axis=0)
        if self.n_user_types == self.n_types:
            return belief
        return np.asarray(np.bincount(self.whose, belief, self.n_user_types), np.float64)

    def fit(self, belief: NDArray[np.float64]) -> float:
        """Computes the probability that the user has a found user type and the assumed habits, from
        a belief over hidden states."""
        return float(belief.reshape(-1, self.n_types)[:, self.as_found].sum())

    @property
    def messages_land(self) -> bool:
        """True if messages always correct the fact, as in the paper. If messages may be missed or
        forgotten, beliefs also cover users' knowledge."""
        return self.habits.take_all_in

    @property
    def message_discount(self) -> float:
        """γ', the discount of a message: γ if every action discounts (the paper), 1 if only
        *explain* does. It is also 1 if messages may be missed or forgotten: then a message can be
        repeated, and each repetition would delay later costs and so reduce them."""
        return self.discount if self.discount_per == "action" and self.messages_land else 1.0

    @property
    def prices(self) -> NDArray[np.float64]:
        """[n] λ C_e of each message."""
        return self.trade_off * self.message_cost

    def may_give(self, given: int) -> int:
        """Returns the bitmask of the messages that may still be given, after the messages
        ``given``."""
        return (1 << self.n_messages) - 1 & ~(given if self.messages_land else 0)

    def communication(self, said: Iterable[int]) -> float:
        """Computes Σ C_e over all given messages, from a list of bitmasks."""
        return float(sum(self.message_cost[indices(new)].sum() for new in said))

    @property
    def accept(self) -> NDArray[np.float64]:
        """[N] α of each hidden type."""
        return np.tile(self.habits.accept, self.n_types // len(self.habits))

    @property
    def forget(self) -> NDArray[np.float64]:
        """[N] φ of each hidden type."""
        return np.tile(self.habits.forget, self.n_types // len(self.habits))

    @property
    def start(self) -> NDArray[np.float64]:
        """The belief before the first step: the prior, with no known facts."""
        if self.messages_land:
            return self.prior.copy()
        belief = np.zeros((self.table.p.shape[1], self.n_types))
        belief[0] = self.prior
        return belief.ravel()

    def sure(self, hidden_type: int, known: int) -> NDArray[np.float64]:
        """Returns the belief of an agent who knows the user's hidden type and known facts (a
        bitmask)."""
        belief = np.zeros((self.table.p.shape[1], self.n_types))
        belief[self.table.subset(known)[hidden_type], hidden_type] = 1
        return belief.ravel() if not self.messages_land else belief.sum(axis=0)

    def with_habits(self, habits: Habits) -> Problem:
        """Returns the problem of users who have one of these habits, independent of their types.

        Raises:
            TooLargeError: users' knowledge needs too many rows.
        """
        if habits.never_err and habits.take_all_in:
            return self
        table, asked = self.table, self.questions.table
        if not habits.take_all_in:
            # A row is a set of known facts. Facts that change neither labels nor answers to
            # questions are left out.
            whole = join_steps([table, asked])
            whole = whole.select_messages(whole.effective())
            table = whole.of_steps(range(self.n_steps))
            asked = whole.of_steps(range(self.n_steps, len(whole.p)))
        return replace(
            self,
            table=_add_errors(table, habits),
            prior=np.outer(self.prior, habits.prior).ravel(),
            habits=habits,
            questions=replace(self.questions, table=_add_errors(asked, habits)),
            whose=self.whose.repeat(len(habits)),
            as_found=self.as_found.repeat(len(habits)),
        )

    def with_types(self, table: LabelTable, type_names: tuple[str, ...]) -> Problem:
        """Returns the problem of the same trace and costs for other user types, with equal prior
        probabilities."""
        count = len(type_names)
        prior = np.full(count, 1 / count)
        return replace(
            self,
            table=table,
            type_names=type_names,
            prior=prior,
            habits=PAPER,
            questions=Questions(),
            whose=np.arange(count),
            as_found=np.ones(count, np.bool_),
        )

    def mixture(self, weights: NDArray[np.float64], name: str = "everyone") -> Problem:
        """Returns the problem of the same trace and costs for a single type. P(label is 1) of this
        type is the weighted mean over all types; its labels are independent of each other.

        Args:
            weights: [N] weight of each type.
            name: name of the single type.

        Raises:
            TooLargeError: more than MAX_RELEVANT messages matter to some type.
        """
        return self.with_types(self.table.mix_types(weights), (name,))


def _add_errors(table: LabelTable, habits: Habits) -> LabelTable:
    """Makes the table of users who have these habits. Hidden type t of the new table has type
    ``t // F`` and habit ``t mod F``."""
    erring = table.repeat_types(len(habits))
    if habits.never_err:
        return erring
    return replace(erring, answers=habits.add_errors(table.answered))


def check_numbers(key: str, value: ArrayLike) -> NDArray[np.float64]:
    """Converts numbers to a float64 copy, and refuses NaN and infinities."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(key, value, "numbers") from None
    if not np.isfinite(array).all():
        raise InputError(key, array[~np.isfinite(array)].flat[0].item(), "finite numbers")
    return array


def check_distribution(given: ArrayLike, types: int) -> NDArray[np.float64]:
    """Checks a prior [N] and returns it. An empty prior is replaced by the uniform prior."""
    prior = np.asarray(given)
    prior = np.full(types, 1 / types) if prior.size == 0 else check_numbers("prior", prior)
    if prior.shape != (types,) or (prior < 0).any() or abs(prior.sum() - 1) > 1e-6:
        raise InputError("prior", prior.tolist(), f"{types} probabilities that sum to 1")
    # A prior whose sum is 1 up to rounding stays unchanged when problems are made from it:
    # decisions and replays must not depend on that.
    return prior / prior.sum() if abs(prior.sum() - 1) > 1e-12 else prior


def expand_costs(given: ArrayLike, count: int | None) -> NDArray[np.float64]:
    """Returns [n] read-only costs of messages, from one cost for all messages or a cost for each.
    If ``count`` is unknown, n is the number of given costs."""
    cost = check_numbers("message_cost", given)
    if cost.ndim == 0 and count is not None:
        cost = np.full(count, float(cost))
    n = cost.size if count is None else count
    if cost.shape != (n,) or n > MAX_MESSAGES or (cost < 0).any():
        wanted = f"{n} costs ≥ 0, one a message, of at most {MAX_MESSAGES}"
        raise InputError("message_cost", cost.tolist(), wanted)
    cost.flags.writeable = False
    return cost


def check_names(key: str, given: Sequence[str], count: int, kind: str) -> tuple[str, ...]:
    """Checks that there are exactly ``count`` names; makes numbered names if none are given."""
    names = tuple(given) or tuple(f"{kind}_{i}" for i in range(count))
    if len(names) != count:
        raise InputError(key, names, f"{count} names")
    return names
