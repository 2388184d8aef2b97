"""The public explainer, for users of unknown type.

    types ── Explainer ── session(trace) ── messages() / observe(labels) ── … ── finished

See docs/explainer.md.
"""

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, Range, Whole, checks, whole_number
from xplain.explanation.anybody import Open
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import OPEN, BeliefUpdate, Facts, Independent, Persistent
from xplain.explanation.habits import Assumed, Habits
from xplain.explanation.label_table import DENSE, LabelTable, join_steps
from xplain.explanation.problem import DiscountPer, Problem, expand_costs
from xplain.interaction.dialogue import Dialogue, Event
from xplain.interaction.session import FORMAT, Candidate, Session, plain
from xplain.solvers.base import LazyPolicy, Solver
from xplain.solvers.greedy import QMDP

log = logging.getLogger(__name__)


class Types(Protocol):
    """An explainer's model of users: N types, n messages.

    :class:`GivenTypes` takes plain arrays and functions; learned types are
    :class:`~xplain.learning.saved.LearnedTypes`.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """N names of the types."""

    @property
    def messages(self) -> tuple[str, ...]:
        """n names of the messages; bit j of a message set is message j."""

    @property
    def prior(self) -> ArrayLike:
        """[N] P(type) of a new user; empty for a uniform prior."""

    @property
    def habits(self) -> Habits | None:
        """People's habits of listening and answering; None if they were not learned."""

    @property
    def wrong(self) -> tuple[int, ...] | None:
        """N bitmasks of the facts that each type believes incorrectly; None if unknown."""

    @property
    def new(self) -> float:
        """P(a user has none of the types)."""

    def label_table(self, transitions: Sequence[Any]) -> LabelTable:
        """Returns P(label is 1 | type, message set) of T ≥ 1 transitions."""

    def everything(self, transitions: Sequence[Any]) -> LabelTable | None:
        """Returns P(label is 1 | message set) of these transitions for a type that believes every
        fact incorrectly; None if unknown."""


@dataclass(frozen=True)
class GivenTypes:
    """User types as a table or a function.

    Attributes:
        table: [N, T, 2^n] P(label is 1), if transitions are indices 0 … T − 1; or a function from a
            list of transitions (of any kind) to such a table. For many messages a
            ``LabelTable.by_type(relevant, tables)`` replaces the array.
        messages: n names.
        names: N names.
        prior: [N]; empty for a uniform prior.
        habits: people's habits of listening and answering, if learned.
        wrong: N bitmasks of the facts that each type believes incorrectly, if known.
        about_everything: like ``table``, for one type that believes every fact incorrectly.
        new: P(a user has none of the types).
    """

    table: ArrayLike | LabelTable | Callable[[Sequence[Any]], ArrayLike | LabelTable]
    messages: tuple[str, ...]
    names: tuple[str, ...]
    prior: ArrayLike = ()
    habits: Habits | None = None
    wrong: tuple[int, ...] | None = None
    about_everything: ArrayLike | LabelTable | Callable[..., ArrayLike | LabelTable] | None = None
    new: float = OPEN

    def __post_init__(self) -> None:
        """Raises InputError if the table has another shape or only zeros, or if ``wrong`` is
        incomplete."""
        facts = self.wrong is None, self.about_everything is None
        if any(facts) != all(facts) or len(self.wrong or self.names) != len(self.names):
            wanted = f"bitmasks of {len(self.names)} types, together with about_everything"
            raise InputError("wrong", self.wrong, wanted)
        if callable(self.table):
            return
        self.label_table(())
        if not np.any(self.table.p if isinstance(self.table, LabelTable) else self.table):
            raise InputError("table", 0, "probabilities that a label is 1; all of these are 0")

    def label_table(self, transitions: Sequence[Any]) -> LabelTable:
        """Returns P(label is 1 | type, message set) of these transitions.

        Raises:
            InputError: an index outside the table.
        """
        return self._select_rows(self.table, transitions, len(self.names))

    def everything(self, transitions: Sequence[Any]) -> LabelTable | None:
        """Returns P(label is 1 | message set) for the type that believes every fact incorrectly."""
        about = self.about_everything
        return None if about is None else self._select_rows(about, transitions, 1)

    def _select_rows(self, given: Any, transitions: Sequence[Any], types: int) -> LabelTable:
        """Returns the label table of some transitions.

        Args:
            given: a table of all transitions, or a function from transitions to their table.
            transitions: indices into the table, or arguments of the function.
            types: required number of types.

        Raises:
            InputError: the numbers of types, messages or transitions do not match, or an index is
                outside the table.
        """
        rows = given(transitions) if callable(given) else given
        table = rows if isinstance(rows, LabelTable) else LabelTable.dense(rows)
        n, width = len(self.messages), table.relevant.shape[1]
        if table.n_types != types:
            raise InputError("table", table.n_types, f"{types} types, one for each name")
        if table is not rows and width != n:
            wanted = f"2**{n} = {1 << n} sets of {n} messages, one for each name"
            raise InputError("table", 1 << width, wanted)
        if not callable(given):
            for index in transitions:
                whole_number("trace", index, 0, len(table.p) - 1)
            return table.of_steps(transitions)
        if len(table.p) != len(transitions):
            raise InputError(
                "table", len(table.p), f"{len(transitions)} rows, one for each transition"
            )
        return table


@checks()
@dataclass(frozen=True)
class Explainer:
    """Explains traces to people of unknown type.

    Attributes:
        types: the possible types of users.
        solver: plans the messages; any solver that does not need the user's type.
        trade_off: λ, the cost of a message in inexplicable labels.
        message_cost: C_e, one number for all messages or one for each.
        inexplicability_cost: C_inexp of each label 0.
        discount: γ_E, for planning.
        discount_per: see :class:`~xplain.explanation.problem.Problem`.
        belief_update: decides which labels are evidence, and how users err. The default None
            depends on the types. If ``types.wrong`` is known and there are at most DENSE messages,
            it means :class:`~xplain.explanation.anybody.Open` (people may have no type). Otherwise,
            if the types include the observers' error rates, it means ``Persistent("learned")``
            (people repeat themselves and err as observers did). Otherwise it means the paper's
            :class:`~xplain.explanation.belief.Independent`. ``Open`` and ``Persistent`` use the
            observers' error rates, and the learned rate of acceptance if observers missed messages.
        seed: seed of randomised solvers.
        ask: cost and number of questions; None for none.
    """

    types: Types
    solver: Solver = field(default_factory=QMDP)
    trade_off: Annotated[float, Range(0)] = 1.0
    message_cost: ArrayLike = 1.0
    inexplicability_cost: Annotated[float, Range(0)] = 1.0
    discount: Annotated[float, Range(0, 1, "(]")] = 0.95
    discount_per: DiscountPer = "action"
    belief_update: BeliefUpdate | None = None
    seed: Whole = 0
    ask: Limits | None = None

    def __post_init__(self) -> None:
        """Raises InputError for a value that no session could plan with."""
        for key in ("messages", "names"):
            names = getattr(self.types, key, "")
            if isinstance(names, str) or len(set(names)) < len(names):
                raise InputError(f"types.{key}", names, "names without repetition")
        for key, example in (
            ("solver", "QMDP()"),
            ("belief_update", "Independent()"),
            ("ask", "Limits()"),
        ):
            given = getattr(self, key)
            if isinstance(given, str | float | type):
                raise InputError(key, given, f"an object, such as {example}")
        if self.solver.knows in ("type", "labels"):
            wanted = "a solver that need not know the user's type"
            raise InputError("solver", type(self.solver).__name__, wanted)
        if self.belief_update is None and self.types.wrong is not None and not self.beliefs.open:
            log.warning("all users are assumed to have one of the types: over %d messages", DENSE)
        self._make_dialogue(0, (), (), ())

    @property
    def beliefs(self) -> BeliefUpdate:
        """The belief update: how labels change the belief."""
        if self.belief_update is not None:
            return self.belief_update
        habits = self.types.habits
        error: Assumed = 0.0 if habits is None else "learned"
        accept: Assumed = "learned" if habits is not None and (habits.accept < 1).any() else 1.0
        if self.types.wrong is not None and len(self.types.messages) <= DENSE:
            return Open(error, accept)
        return Independent() if habits is None else Persistent(error, accept)

    def session(
        self,
        trace: Sequence[Any] | NDArray[Any] = (),
        expected_steps: int = 0,
        clips: Sequence[Any] | NDArray[Any] | Mapping[str, Any] = (),
    ) -> Session:
        """Begins to explain a trace to a new person.

        Args:
            trace: the transitions known so far, as ``types`` accepts them (learned types: rows of
                features). If the robot has a whole plan, give all of it.
            expected_steps: expected length of the whole trace. The solver assumes that the
                remaining transitions are explicable to everybody; at each of the remaining steps
                the user labels the known transitions once more. If it is 0, the trace ends with the
                last known transition.
            clips: transitions that the user may be asked about, on the trace or not, nearest to the
                trace first: a list of transitions, or a mapping from readable names to transitions.

        Raises:
            InputError: a transition or number that is not allowed, or clips although ``ask`` is
                None.
        """
        whole_number("expected_steps", expected_steps, 0)
        named = (
            clips.items() if isinstance(clips, Mapping) else [(str(clip), clip) for clip in clips]
        )
        may_ask = tuple(
            clip if isinstance(clip, Candidate) else Candidate(plain(clip), text)
            for text, clip in named
        )
        if may_ask and self.ask is None:
            raise InputError(
                "clips", len(may_ask), "none; Explainer(..., ask=Limits()) allows some"
            )
        begin = partial(self._make_dialogue, expected_steps, may_ask)
        return Session(begin, [plain(row) for row in trace], expected_steps, may_ask)

    def from_json(self, text: str) -> Session:
        """Restores a session of :meth:`Session.to_json`, in this process or another. The belief is
        computed again from the user's answers.

        Raises:
            InputError: an invalid text, or a session with other messages or types.
        """
        expected = {
            "format": FORMAT,
            "messages": [*self.types.messages],
            "types": [*self.types.names],
        }
        try:
            state = json.loads(text)
            written = {key: state[key] for key in expected}
            trace, steps = list(state["trace"]), int(state["expected_steps"])
            clips = [Candidate(*clip) for clip in state["clips"]]
            events = [(str(kind), content) for kind, content in state["events"]]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError("session", text, f"JSON of Session.to_json ({error!r})") from None
        for key, own in expected.items():
            if written[key] != own:
                raise InputError(f"session.{key}", written[key], f"must be {own}")
        session = self.session(trace, steps, clips)
        session.take_up(events)
        return session

    def _make_dialogue(
        self,
        expected_steps: int,
        clips: Sequence[Candidate],
        trace: Sequence[Any],
        events: Sequence[Event],
    ) -> Dialogue:
        """Makes the dialogue about the known part of a trace, after these events. The policy is
        planned at its first use."""
        known, types = len(trace), len(self.types.names)
        steps = max(expected_steps if known else 0, known, 1)
        # Unknown steps are assumed to be explicable to everybody.
        ahead = LabelTable(np.empty((types, 0), np.int64), np.ones((steps - known, 1, types)))
        table = join_steps([self.types.label_table(trace), ahead]) if known else ahead
        facts, beliefs, wrong = None, self.beliefs, self.types.wrong
        if beliefs.open and wrong is not None:
            everything = self.types.everything(trace) if known else None
            one, about = ahead.of_types([0]), [clip.transition for clip in clips]
            everything = one if everything is None else join_steps([everything, one])
            asked = self.types.everything(about) if about else None
            facts = Facts(everything, wrong, asked, self.types.new)
        problem = Problem(
            table,
            message_cost=expand_costs(self.message_cost, len(self.types.messages)),
            inexplicability_cost=self.inexplicability_cost,
            trade_off=self.trade_off,
            discount=self.discount,
            prior=np.asarray(self.types.prior),
            discount_per=self.discount_per,
            message_names=tuple(self.types.messages),
            type_names=tuple(self.types.names),
            questions=self._make_questions(clips, trace, steps),
            copies=np.array([*map(trace.index, trace), *range(known, steps)], np.int64),
        )
        problem = beliefs.people(problem, self.types.habits, facts)
        policy = LazyPolicy(partial(self.solver.plan, problem, self.seed))
        return Dialogue(problem, policy, beliefs, list(events))

    def _make_questions(
        self, clips: Sequence[Candidate], trace: Sequence[Any], steps: int
    ) -> Questions:
        """Makes the questions of a session.

        Args:
            clips: candidates for questions, the nearest to the trace first.
            trace: the known transitions.
            steps: number of transitions that the whole trace will have.
        """
        if not clips or self.ask is None:
            return Questions()
        shows = np.zeros((len(clips), steps), np.bool_)
        shows[:, : len(trace)] = [
            [clip.right < 0 and clip.transition == one for one in trace] for clip in clips
        ]
        table = self.types.label_table([clip.transition for clip in clips])
        texts = tuple(clip.text for clip in clips)
        return Questions(table, self.ask, shows, texts, np.array([clip.right for clip in clips]))
