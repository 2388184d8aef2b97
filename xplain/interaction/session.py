"""A session: one trace explained to one user, by names (paper, "Explaining a plan trace")."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, one_of
from xplain.explanation.actions import AskQuestion
from xplain.explanation.label_table import LabelTable, joined
from xplain.explanation.listening import Explained
from xplain.explanation.message_sets import mask_of, names_of
from xplain.explanation.problem import Problem
from xplain.interaction.dialogue import (
    Answered,
    Asked,
    Dialogue,
    Event,
    Given,
    Labelled,
    Told,
    all_given,
    all_labels,
)
from xplain.interaction.moves import Candidate, Move, Say, Show, Why, plain, questions_of
from xplain.interaction.planner import Planner
from xplain.solvers.base import messages_of

FORMAT = 4
"""Version of a session's JSON."""


class Session:
    """One trace, one user. Made by :meth:`xplain.Explainer.session`.

    Each step: :meth:`messages` to say, then the first ``shown`` transitions to show, then
    :meth:`observe` with the user's labels of them. :meth:`extend` at any time. Where something may
    be asked, :meth:`next` says what to do, and :meth:`answer` takes the user's answers.
    """

    def __init__(
        self, planner: Planner, expected_steps: int = 0, clips: tuple[Candidate, ...] = ()
    ) -> None:
        self._planner = planner
        self._expected_steps = expected_steps
        self._clips = clips
        self._trace: list[Any] = []
        self._table = planner.unknown(0)
        self._asked_about: LabelTable | None = None
        if clips:
            self._asked_about = planner.types.label_table([clip.transition for clip in clips])
        self._talk = self._dialogue(self._problem(planner.unknown(1)))

    def _dialogue(self, problem: Problem, events: Sequence[Event] = ()) -> Dialogue:
        planner = self._planner
        return Dialogue(problem, planner.plan(problem), planner.beliefs, list(events))

    @property
    def trace(self) -> tuple[Any, ...]:
        """All transitions known so far, in order, as they were given."""
        return tuple(self._trace)

    @property
    def shown(self) -> int:
        """How many transitions are shown to the user at this step."""
        return self._step + (not self.finished)

    @property
    def finished(self) -> bool:
        """Whether the user has labelled the whole trace known so far."""
        return self._step == len(self._trace)

    @property
    def _step(self) -> int:
        return self._talk.state.visible.step

    @property
    def said(self) -> tuple[str, ...]:
        """Names of all messages given so far, sorted."""
        return self._names(self._talk.state.visible.given)

    @property
    def again(self) -> tuple[str, ...]:
        """Names of the messages of this step that had been said before, as users may miss or
        forget some."""
        *earlier, now = all_given(self._talk.events) or [0]
        return self._names(now & int(np.bitwise_or.reduce(np.array([0, *earlier]))))

    @property
    def explained(self) -> Explained:
        """What was said and answered, of one person: the data of
        :func:`~xplain.explanation.listening.learned_habits`."""
        events = self._talk.events
        answers = tuple(np.array(labels, np.uint8) for labels in all_labels(events))
        return Explained(self._talk.problem, tuple(all_given(events)), answers)

    @property
    def belief(self) -> dict[str, float]:
        """``{type: probability}``, given all labels so far; they sum to 1."""
        return self._by_name(self._talk.state.belief)

    @property
    def cost(self) -> float:
        """Definition 2 of the paper for what happened so far, undiscounted; and κ for each
        question answered."""
        problem, events = self._talk.problem, self._talk.events
        said = problem.communication(all_given(events))
        zeros = sum(labels.count(0) for labels in all_labels(events))
        asked = sum(isinstance(event, Answered) for event in events)
        price = problem.questions.limits.cost * asked
        return problem.trade_off * said + problem.inexplicability_cost * zeros + price

    def extend(self, transitions: Sequence[Any] | NDArray[Any]) -> None:
        """The robot did (or plans) more: they follow the known transitions.

        The next decision is planned with them. What was said and answered stays.

        Raises:
            InputError: a transition that ``types`` does not take.
        """
        new = [plain(row) for row in transitions]
        if not new:
            return
        table = joined([self._table, self._planner.types.label_table(new)])
        known = len(self._trace) + len(new)
        ahead = self._planner.unknown(max(self._expected_steps - known, 0))
        problem = self._problem(joined([table, ahead]), [*self._trace, *new])
        self._table = table
        self._trace += new
        self._talk = self._dialogue(problem, self._talk.events)

    def _problem(self, table: LabelTable, trace: Sequence[Any] = ()) -> Problem:
        """What is planned for: the table of a trace, of which so much is known, and what may be
        asked."""
        planner, about = self._planner, self._asked_about
        copies = [trace.index(transition) for transition in trace]
        copies += range(len(trace), len(table.p))
        if about is None or planner.ask is None:
            return planner.problem(table, copies=copies)
        asked = questions_of(self._clips, about, planner.ask, trace, len(table.p))
        return planner.problem(table, asked, copies)

    def next(self) -> Move:
        """What to do now: ask a question, then :meth:`answer`; say messages, then ``next`` again;
        or show steps, then :meth:`observe`. Called again before that, it answers the same; once
        messages were told of, it is their steps.

        Raises:
            InputError: every transition known is answered.
        """
        talk = self._talk
        if talk.state.open is None and not self._waits and not self.finished:
            action = talk.decide()
            if isinstance(action, AskQuestion):
                talk.hear(Asked(action.question))
            else:
                talk.hear(Given(messages_of(action)))
        if talk.state.open is not None:
            return talk.problem.questions.question(talk.state.open)
        said = self.messages()
        if said and not talk.state.told:
            talk.hear(Told())
            return Say(said)
        return Show(self.shown)

    def ask(self, number: int) -> None:
        """Asks this of the ``clips``, by its number, whatever the plan; :meth:`answer` follows.

        Raises:
            InputError: there is none, it was asked already, or this step's messages are said.
        """
        one_of("question", number, range(len(self._clips)), "number of a clip")
        if self._waits or self.finished or self._talk.state.visible.asked >> number & 1:
            raise InputError("question", number, "one not asked yet, before the step's messages")
        self._talk.hear(Asked(number))

    def answer(self, answer: int) -> None:
        """The user's answer to the question of :meth:`next`: 1 (or True) for yes, and for who has
        a fact right.

        Raises:
            InputError: another answer, or nothing was asked.
        """
        if self._talk.state.open is None:
            raise InputError("answer", answer, "a question comes first: next()")
        if answer not in (0, 1):
            raise InputError("answer", answer, "0 or 1")
        self._talk.hear(Answered(int(answer)))

    @property
    def _waits(self) -> bool:
        """Whether messages were said, and the labels are not heard yet."""
        return self._talk.state.new is not None

    def messages(self) -> tuple[str, ...]:
        """The messages to say now, before the first ``shown`` transitions are shown; none if it
        is best to say nothing. Asked again before :meth:`observe`, it answers the same. No
        question comes before them.

        Raises:
            InputError: every transition known is answered.
        """
        if not self._waits:
            if self.finished:
                raise InputError("session", len(self._trace), "is finished; extend the trace first")
            self._talk.hear(Given(messages_of(self._talk.decide(asking=False))))
        return self._names(self._talk.state.new or 0)

    def tell(self, names: Sequence[str]) -> None:
        """Says these messages at this step, whatever the plan.

        Raises:
            InputError: :meth:`messages` was called already, or a message is unknown, or was said
                and is known since.
        """
        if self._waits or self.finished:
            raise InputError("session", tuple(names), "told once a step, before messages()")
        new = mask_of(names, self._talk.problem.message_names, "session")
        if new & ~self._talk.problem.may_give(self._talk.state.visible.given):
            wanted = f"messages that may be said after {self.said}"
            raise InputError("session", tuple(names), wanted)
        self._talk.hear(Given(new))

    def observe(self, labels: ArrayLike) -> None:
        """The user's labels of the first ``shown`` transitions, 1 = explicable.

        Raises:
            InputError: not so many labels, others than 0 and 1, or nothing was asked.
        """
        if not self._waits:
            raise InputError("labels", labels, "messages() comes first")
        given = np.asarray(labels)
        if given.shape != (self.shown,) or not np.isin(given, (0, 1)).all():
            wanted = f"{self.shown} labels, 0 or 1 for each transition shown so far"
            raise InputError("labels", given.tolist(), wanted)
        self._talk.hear(Labelled(tuple(given.astype(int).tolist())))

    def why(self) -> Why:
        """The values behind the last decision.

        Raises:
            InputError: nothing was decided yet.
        """
        found = self._talk.before_last_decision()
        if found is None:
            raise InputError("session", 0, "messages() comes first")
        (before, event), questions = found, self._talk.problem.questions
        ranked = sorted(before.values().items(), key=lambda item: -item[1])
        visible = before.state.visible
        return Why(
            step=visible.step,
            given=self._names(visible.given),
            belief=self._by_name(before.state.belief),
            chosen=self._names(event.messages) if isinstance(event, Given) else (),
            values={
                self._names(messages_of(action)): value
                for action, value in ranked
                if not isinstance(action, AskQuestion)
            },
            asked=questions.question(event.question) if isinstance(event, Asked) else None,
            questions=tuple(
                (questions.question(action.question), value)
                for action, value in ranked
                if isinstance(action, AskQuestion)
            ),
        )

    def take_up(self, events: Sequence[tuple[str, Any]]) -> None:
        """All that happened, as :meth:`to_json` writes it.

        Raises:
            InputError: as :meth:`ask`, :meth:`answer`, :meth:`tell` and :meth:`observe`; or another
                kind of event.
        """
        methods: dict[str, Callable[[Any], None]] = {
            "ask": self.ask,
            "answer": self.answer,
            "give": self.tell,
            "told": lambda _: self._talk.hear(Told()),
            "labels": self.observe,
        }
        for kind, content in events:
            methods[one_of("session.events", kind, tuple(methods), "event")](content)

    def _written(self, event: Event) -> tuple[str, Any]:
        match event:
            case Asked(question):
                return "ask", question
            case Answered(answer):
                return "answer", answer
            case Given(messages):
                return "give", self._names(messages)
            case Told():
                return "told", None
            case Labelled(labels):
                return "labels", labels

    def to_json(self) -> str:
        """The whole session as text; :meth:`xplain.Explainer.from_json` takes it up again.

        Raises:
            InputError: a transition is nothing that JSON can hold.
        """
        state = {
            "format": FORMAT,
            "messages": self._planner.types.messages,
            "types": self._planner.types.names,
            "trace": self._trace,
            "expected_steps": self._expected_steps,
            "clips": [[clip.transition, clip.text, clip.right] for clip in self._clips],
            "events": [self._written(event) for event in self._talk.events],
        }
        try:
            return json.dumps(state)
        except TypeError as error:
            first = [*self._trace, *(clip.transition for clip in self._clips)][0]
            raise InputError("trace", first, f"transitions for JSON ({error})") from None

    def _by_name(self, belief: NDArray[np.float64]) -> dict[str, float]:
        problem = self._talk.problem
        return dict(zip(problem.type_names, problem.type_belief(belief).tolist(), strict=True))

    def _names(self, mask: int) -> tuple[str, ...]:
        return names_of(mask, self._talk.problem.message_names)
