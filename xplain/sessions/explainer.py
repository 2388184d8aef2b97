"""What people embed: an explainer for users of unknown type.

    types ── Explainer ── session(trace) ── messages() / observe(labels) ── … ── finished

See docs/explainer.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError
from xplain.explanation.belief import BeliefUpdate, Independent
from xplain.explanation.problem import MAX_MESSAGES, DiscountPer, Problem
from xplain.sessions.session import FORMAT, Session
from xplain.solvers.base import Solver
from xplain.solvers.qmdp import QMDP


class Types(Protocol):
    """What an explainer knows of users: N types, n messages.

    :class:`GivenTypes` takes plain arrays and functions; learned types are
    :class:`~xplain.learning.saved_types.LearnedTypes`.
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

    def p_explicable(self, transitions: Sequence[Any]) -> NDArray[np.float64]:
        """P(label is 1 | type, message set) of T ≥ 1 transitions: [N, T, 2^n]."""
        ...


@dataclass(frozen=True)
class GivenTypes:
    """User types as a table or a function.

    Attributes:
        table: [N, T, 2^n], a transition being its index among T; or a function from a list of
            transitions (whatever they are) to such a table of them.
        messages: n names.
        names: N names.
        prior: [N]; empty for all alike.
    """

    table: ArrayLike | Callable[[Sequence[Any]], ArrayLike]
    messages: tuple[str, ...]
    names: tuple[str, ...]
    prior: ArrayLike = ()

    def p_explicable(self, transitions: Sequence[Any]) -> NDArray[np.float64]:
        """See :class:`Types`.

        Raises:
            InputError: an index outside the table.
        """
        if callable(self.table):
            return np.asarray(self.table(transitions), dtype=np.float64)
        table = np.asarray(self.table, dtype=np.float64)
        for index in transitions:
            if not isinstance(index, (int, np.integer)) or not 0 <= index < table.shape[1]:
                raise InputError("trace", index, f"indices 0 … {table.shape[1] - 1} of the table")
        return np.asarray(table[:, list(transitions)])


@dataclass(frozen=True)
class Explainer:
    """Explains traces to people of unknown type.

    Attributes:
        types: who the users may be.
        solver: plans the messages; any that does without knowing the user's type.
        trade_off: λ ≥ 0, cost of communication against inexplicability.
        message_cost: C_e, one number or one a message.
        inexplicability_cost: C_inexp of each label 0.
        discount: γ_E in (0, 1], for planning.
        discount_per: see :class:`~xplain.explanation.problem.Problem`.
        belief_update: which labels are evidence. People repeat themselves:
            :class:`~xplain.explanation.belief.Persistent` counts an answer once.
        seed: of solvers that search at random.
    """

    types: Types
    solver: Solver = field(default_factory=QMDP)
    trade_off: float = 1.0
    message_cost: ArrayLike = 1.0
    inexplicability_cost: float = 1.0
    discount: float = 0.95
    discount_per: DiscountPer = "action"
    belief_update: BeliefUpdate = field(default_factory=Independent)
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises InputError: a value that no session could plan with."""
        for key in ("messages", "names"):
            names = getattr(self.types, key)
            if isinstance(names, str) or len(set(names)) < len(names):
                raise InputError(f"types.{key}", names, "names, each once")
        if len(self.types.messages) > MAX_MESSAGES:
            raise InputError("types.messages", len(self.types.messages), f"at most {MAX_MESSAGES}")
        if self.solver.knows in ("type", "labels"):
            raise InputError(
                "solver", type(self.solver).__name__, "a solver that need not know the user's type"
            )
        self.problem(self.unknown(1))

    def session(self, trace: Sequence[Any] | NDArray[Any] = (), expected_steps: int = 0) -> Session:
        """Begins to explain a trace to somebody new.

        Args:
            trace: the transitions known already, as ``types`` takes them (learned types: rows of
                features). Give the whole plan where the robot has one.
            expected_steps: transitions that the trace is expected to have in the end. The planner
                takes those not yet known to be explicable to everybody: each shows the prefix
                once more, and that is all. At 0 it takes the trace to end with the last known one.

        Raises:
            InputError: a transition or number that is not allowed.
        """
        if isinstance(expected_steps, bool) or expected_steps < 0:
            raise InputError("expected_steps", expected_steps, "a whole number ≥ 0")
        session = Session(self, expected_steps)
        session.extend(trace)
        return session

    def from_json(self, text: str) -> Session:
        """Takes up a session of :meth:`Session.to_json` where it stood, in this process or another.

        The belief is worked out again from the user's answers.

        Raises:
            InputError: no such text, or a session with other messages or types.
        """
        try:
            state = json.loads(text)
            written = state["format"]
            known = {key: tuple(state[key]) for key in ("messages", "types")}
            trace, said, answers = (list(state[key]) for key in ("trace", "said", "answers"))
            expected = int(state["expected_steps"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError("session", text, f"JSON of Session.to_json ({error!r})") from None
        if written != FORMAT:
            raise InputError("session.format", written, f"{FORMAT}")
        for key, mine in (("messages", self.types.messages), ("types", self.types.names)):
            if known[key] != tuple(mine):
                raise InputError(f"session.{key}", known[key], f"must be {', '.join(mine)}")
        if not len(answers) <= len(said) <= min(len(answers) + 1, len(trace)):
            raise InputError("session.said", said, "one entry a step, and at most one unanswered")
        session = self.session(trace, expected)
        for k, names in enumerate(said):
            session.tell(names)
            if k < len(answers):
                session.observe(answers[k])
        return session

    def unknown(self, steps: int) -> NDArray[np.float64]:
        """[N, steps, 2^n] of transitions that nobody finds inexplicable."""
        return np.ones((len(self.types.names), steps, 1 << len(self.types.messages)))

    def problem(self, table: NDArray[np.float64]) -> Problem:
        """What the solver plans for, given the table [N, m, 2^n] of a trace."""
        return Problem(
            p_explicable=table,
            message_cost=np.asarray(self.message_cost, dtype=np.float64),
            inexplicability_cost=self.inexplicability_cost,
            trade_off=self.trade_off,
            discount=self.discount,
            prior=np.asarray(self.types.prior, dtype=np.float64),
            discount_per=self.discount_per,
            message_names=tuple(self.types.messages),
            type_names=tuple(self.types.names),
        )
