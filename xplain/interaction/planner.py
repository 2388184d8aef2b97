"""What a session plans with: who users may be, what costs what, and the solver.

types ── Planner.problem(table of a trace) ── Planner.plan(problem) ── policy
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, number, whole_number
from xplain.explanation.actions import Action, VisibleState
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import BeliefUpdate, Independent, Persistent
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import MAX_MESSAGES, LabelTable
from xplain.explanation.problem import DiscountPer, Problem, each_cost
from xplain.solvers.base import Policy, Solver
from xplain.solvers.greedy import QMDP


class Types(Protocol):
    """What an explainer knows of users: N types, n messages.

    :class:`~xplain.interaction.explainer.GivenTypes` takes plain arrays and functions; learned
    types are :class:`~xplain.learning.saved.LearnedTypes`.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """N names of the types."""
        ...

    @property
    def messages(self) -> tuple[str, ...]:
        """n names of the messages; bit j of a message set is message j."""
        ...

    @property
    def prior(self) -> ArrayLike:
        """[N] P(type) of a user not seen before; empty for all alike."""
        ...

    @property
    def habits(self) -> Habits | None:
        """How people listen and answer; None where nothing was learned of it."""
        ...

    def label_table(self, transitions: Sequence[Any]) -> LabelTable:
        """P(label is 1 | type, message set) of T ≥ 1 transitions."""
        ...


@dataclass(frozen=True)
class Planner:
    """Plans the explanation of any trace to people of unknown type.

    Attributes:
        types: who the users may be.
        solver: plans the messages; any that does without knowing the user's type.
        trade_off: λ ≥ 0, cost of communication against inexplicability.
        message_cost: C_e, one number or one a message.
        inexplicability_cost: C_inexp of each label 0.
        discount: γ_E in (0, 1], for planning.
        discount_per: see :class:`~xplain.explanation.problem.Problem`.
        belief_update: which labels are evidence, and how users err. None: people repeat themselves
            and err as observers did (``Persistent("learned")``) where the types tell how these
            erred; else the paper's :class:`~xplain.explanation.belief.Independent`.
        seed: of solvers that search at random.
        ask: what questions cost and how many are asked; None for none.
    """

    types: Types
    solver: Solver = field(default_factory=QMDP)
    trade_off: float = 1.0
    message_cost: ArrayLike = 1.0
    inexplicability_cost: float = 1.0
    discount: float = 0.95
    discount_per: DiscountPer = "action"
    belief_update: BeliefUpdate | None = None
    seed: int = 0
    ask: Limits | None = None

    def __post_init__(self) -> None:
        """Raises InputError: a value that no session could plan with."""
        for key in ("messages", "names"):
            names = getattr(self.types, key, "")
            if isinstance(names, str) or len(set(names)) < len(names):
                raise InputError(f"types.{key}", names, "names, each once")
        for key, example in (("solver", "QMDP()"), ("belief_update", "Independent()")):
            given = getattr(self, key)
            if isinstance(given, str | type):
                raise InputError(key, given, f"an object, such as {example}")
        for key in ("trade_off", "inexplicability_cost", "discount"):
            number(key, getattr(self, key))
        whole_number("seed", self.seed, 0)
        if not isinstance(self.ask, Limits | None):
            raise InputError("ask", self.ask, "Limits(cost=0.1), or None")
        if len(self.types.messages) > MAX_MESSAGES:
            raise InputError("types.messages", len(self.types.messages), f"at most {MAX_MESSAGES}")
        if self.solver.knows in ("type", "labels"):
            raise InputError(
                "solver", type(self.solver).__name__, "a solver that need not know the user's type"
            )
        self.problem(self.unknown(1))

    def unknown(self, steps: int) -> LabelTable:
        """So many transitions that nobody finds inexplicable, whatever is said."""
        types = len(self.types.names)
        return LabelTable(np.empty((types, 0), np.int64), np.ones((steps, 1, types)))

    @property
    def beliefs(self) -> BeliefUpdate:
        """How labels change the belief."""
        usual = Independent() if self.types.habits is None else Persistent("learned")
        return usual if self.belief_update is None else self.belief_update

    def problem(
        self, table: LabelTable, questions: Questions | None = None, copies: Sequence[int] = ()
    ) -> Problem:
        """What the solver plans for, given the table of a trace, what may be asked, and the first
        transition that each is equal to."""
        problem = Problem(
            table,
            message_cost=each_cost(self.message_cost, len(self.types.messages)),
            inexplicability_cost=self.inexplicability_cost,
            trade_off=self.trade_off,
            discount=self.discount,
            prior=np.asarray(self.types.prior),
            discount_per=self.discount_per,
            message_names=tuple(self.types.messages),
            type_names=tuple(self.types.names),
            questions=questions or Questions(),
            copies=np.array(copies, np.int64),
        )
        return problem.with_habits(self.beliefs.habits(self.types.habits))

    def plan(self, problem: Problem) -> Policy:
        """A policy for the problem, planned when it is first asked."""
        return LazyPolicy(self.solver, problem, self.seed)


@dataclass(frozen=True)
class LazyPolicy:
    """A policy that is planned at the first question: a trace that grows by ten transitions
    before the next decision is planned for once."""

    solver: Solver
    problem: Problem
    seed: int

    @cached_property
    def _policy(self) -> Policy:
        return self.solver.plan(self.problem, self.seed)

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """See :class:`xplain.solvers.base.Policy`."""
        return self._policy.decide(visible, belief)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """See :class:`xplain.solvers.base.Policy`."""
        return self._policy.values(visible, belief)
