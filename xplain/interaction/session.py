"""A session: the explanation of one trace to one user, with names instead of bitmasks (paper,
"Explaining a plan trace")."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, one_of
from xplain.explanation.actions import AskQuestion
from xplain.explanation.asking import Question
from xplain.explanation.belief import NO_FIT
from xplain.explanation.listening import ExplanationRecord
from xplain.explanation.message_sets import mask_of, names_of
from xplain.interaction.dialogue import (
    Dialogue,
    Event,
    MessagesGiven,
    QuestionAnswered,
    QuestionAsked,
    StepLabelled,
)
from xplain.solvers.base import messages_of

FORMAT = 5
"""Version of a session's JSON."""
KINDS = {
    QuestionAsked: "ask",
    QuestionAnswered: "answer",
    MessagesGiven: "tell",
    StepLabelled: "observe",
}
"""The names of events in this JSON. Each event has the name of the method that adds it."""


@dataclass(frozen=True)
class Show:
    """The next action: say messages, then show the first transitions of the trace, and ask for a
    label of each.

    Attributes:
        messages: names; none if it is best to say nothing.
        steps: number of transitions.
    """

    messages: tuple[str, ...]
    steps: int


Move = Question | Show


@dataclass(frozen=True)
class Candidate:
    """A possible question: about a transition (a clip) or about a fact.

    Attributes:
        transition: a transition that ``types`` accepts; the answer is its label.
        text: readable text. For a question about a fact, the two sentences on two lines, in the
            order of display.
        right: for a question about a fact, index of the true sentence, 0 or 1; −1 for a clip.
    """

    transition: Any
    text: str
    right: int = -1

    def __post_init__(self) -> None:
        """Raises InputError if a question about a fact does not have two sentences."""
        one_of("clips.right", self.right, (-1, 0, 1))
        if self.right >= 0 and self.text.count("\n") != 1:
            raise InputError("clips.text", self.text, "two sentences of a belief, on two lines")


@dataclass(frozen=True)
class Why:
    """The values behind a decision.

    Attributes:
        step: number of transitions shown before the decision.
        given: messages given before the decision.
        belief: belief in each type, by name.
        fit: probability that the user has a found type and the assumed habits.
        chosen: the chosen messages; none means *explain* at once.
        values: estimated discounted return for each set of messages given next, best first; ``()``
            is *explain* at once. Some solvers evaluate only single messages.
        asked: the chosen question, if the decision was a question.
        questions: (question, estimated return if it is asked next), best first, for the questions
            that the solver evaluated.
    """

    step: int
    given: tuple[str, ...]
    belief: Mapping[str, float]
    fit: float
    chosen: tuple[str, ...]
    values: Mapping[tuple[str, ...], float]
    asked: Question | None = None
    questions: tuple[tuple[Question, float], ...] = ()

    def __str__(self) -> str:
        did = f"ask: {self.asked}" if self.asked else ", ".join(self.chosen) or "nothing to say"
        ranked = [
            *((value, f"ask: {question}") for question, value in self.questions),
            *((v, ", ".join(names) or "say nothing more") for names, v in self.values.items()),
        ]
        ranked.sort(key=lambda one: -one[0])
        lines = [f"step {self.step + 1}: {did}"] + [f"  {v:9.3f}  {t}" for v, t in ranked]
        if self.fit < NO_FIT:
            lines.insert(1, f"the answers fit none of the types (fit {self.fit:.2f})")
        return "\n".join(lines)


def plain(transition: Any) -> Any:
    """Converts numpy values to Python values, for comparisons and JSON."""
    wrapped = isinstance(transition, (np.ndarray, np.generic))
    return transition.tolist() if wrapped else transition


class Session:
    """The explanation of one trace to one user, made by :meth:`xplain.Explainer.session`.

    At each step say the :meth:`messages`, show the first ``shown`` transitions, then pass the
    user's labels to :meth:`observe`. :meth:`extend` may be called at any time. If questions are
    allowed, :meth:`next` returns the next action, and :meth:`answer` takes the user's answer.

    Args:
        begin: makes the dialogue about the known transitions, after some events.
        trace: the known transitions.
        expected_steps, clips: see :meth:`xplain.Explainer.session`.

    Attributes:
        trace: all transitions known so far, in order, as given.
    """

    def __init__(
        self,
        begin: Callable[[Sequence[Any], Sequence[Event]], Dialogue],
        trace: Sequence[Any],
        expected_steps: int,
        clips: tuple[Candidate, ...],
    ) -> None:
        self._begin = begin
        self.trace = tuple(trace)
        self._expected_steps = expected_steps
        self._clips = clips
        self._talk = begin(self.trace, ())

    def restart(self) -> Session:
        """Begins to explain the same trace to another person. Both sessions share one plan, so two
        threads must not compute decisions at the same time."""
        other = copy(self)
        other._talk = self._talk.at(0)
        return other

    @property
    def shown(self) -> int:
        """Number of transitions that are shown to the user at this step."""
        return self._talk.state.visible.step + (not self.finished)

    @property
    def finished(self) -> bool:
        """True if the user has labelled all known transitions."""
        return self._talk.state.visible.step == len(self.trace)

    @property
    def said(self) -> tuple[str, ...]:
        """Names of all messages given so far, sorted."""
        return self._name_messages(self._talk.state.visible.given)

    @property
    def again(self) -> tuple[str, ...]:
        """Names of this step's messages that were also given at an earlier step, because users may
        miss or forget messages."""
        *earlier, now = self._talk.said or [0]
        return self._name_messages(now & int(np.bitwise_or.reduce([0, *earlier])))

    @property
    def explained(self) -> ExplanationRecord:
        """The messages and labels of this person, for
        :func:`~xplain.explanation.listening.learn_habits`."""
        answers = tuple(np.array(labels, np.uint8) for labels in self._talk.labels)
        return ExplanationRecord(self._talk.problem, self._talk.said, answers)

    @property
    def belief(self) -> dict[str, float]:
        """``{type: probability}``, given all labels so far; the probabilities sum to 1."""
        return self._name_types(self._talk.state.belief)

    @property
    def fit(self) -> float:
        """The probability that the user has one of the found types, as assumed. The rest is the
        probability of further hidden types (:mod:`xplain.explanation.anybody`)."""
        return self._talk.problem.fit(self._talk.state.belief)

    @property
    def cost(self) -> float:
        """The undiscounted cost so far (Definition 2 of the paper), plus κ for each answered
        question."""
        return self._talk.cost(sum(labels.count(0) for labels in self._talk.labels))

    def extend(self, transitions: Sequence[Any] | NDArray[Any]) -> None:
        """Adds transitions at the end, because the robot did (or plans) more.

        The next decision is planned with the new transitions. Earlier messages and answers are
        kept.

        Raises:
            InputError: a transition that ``types`` does not accept.
        """
        if new := [plain(row) for row in transitions]:
            self._talk = self._begin((*self.trace, *new), self._talk.events)
            self.trace = (*self.trace, *new)

    def next(self) -> Move:
        """Returns the next action: ask a question, then call :meth:`answer`; or say messages and
        show steps, then call :meth:`observe`. Repeated calls before :meth:`answer` or
        :meth:`observe` return the same action.

        Raises:
            InputError: all known transitions are labelled.
        """
        talk = self._talk
        if talk.state.open is None and talk.state.new is None and not self.finished:
            self._decide(asking=True)
        if talk.state.open is not None:
            return talk.problem.questions.question(talk.state.open)
        return Show(self.messages(), self.shown)

    def ask(self, number: int) -> None:
        """Asks the question with this number of ``clips``, independent of the plan; call
        :meth:`answer` next.

        Raises:
            InputError: the question does not exist or was already asked, or this step's messages
                were given.
        """
        one_of("question", number, range(len(self._clips)), "number of a clip")
        self._check_step_is_open("question", number)
        if self._talk.state.visible.asked >> number & 1:
            raise InputError("question", number, "a question that was not asked yet")
        self._talk.hear(QuestionAsked(number))

    def answer(self, answer: int) -> None:
        """Takes the user's answer to the question of :meth:`next`: 1 (or True) for yes, or for the
        true sentence about a fact.

        Raises:
            InputError: another answer, or no question was asked.
        """
        if self._talk.state.open is None:
            raise InputError("answer", answer, "a question comes first: next()")
        self._talk.hear(QuestionAnswered(int(one_of("answer", answer, (0, 1)))))

    def messages(self) -> tuple[str, ...]:
        """Returns the messages to say before the first ``shown`` transitions are shown; empty if
        silence is best. A repeated call before :meth:`observe` returns the same messages. The
        policy asks no question before these messages.

        Raises:
            InputError: all known transitions are labelled.
        """
        if self._talk.state.new is None:
            if self.finished:
                raise InputError("session", len(self.trace), "is finished; extend the trace first")
            self._decide(asking=False)
        return self._name_messages(self._talk.state.new or 0)

    def tell(self, names: Sequence[str]) -> None:
        """Gives these messages at this step, independent of the plan.

        Raises:
            InputError: :meth:`messages` was already called, or a message is unknown, or was given
                before and cannot be repeated.
        """
        self._check_step_is_open("session", tuple(names))
        new = mask_of(names, self._talk.problem.message_names, "session")
        if new & ~self._talk.problem.may_give(self._talk.state.visible.given):
            wanted = f"messages that may be said after {self.said}"
            raise InputError("session", tuple(names), wanted)
        self._talk.hear(MessagesGiven(new))

    def observe(self, labels: ArrayLike) -> None:
        """Takes the user's labels of the first ``shown`` transitions, 1 = explicable.

        Raises:
            InputError: another number of labels, labels other than 0 and 1, or the messages of this
                step were not decided before.
        """
        if self._talk.state.new is None:
            raise InputError("labels", labels, "messages() comes first")
        given = np.asarray(labels)
        if given.shape != (self.shown,) or not np.isin(given, (0, 1)).all():
            wanted = f"{self.shown} labels, 0 or 1 for each transition shown so far"
            raise InputError("labels", given.tolist(), wanted)
        self._talk.hear(StepLabelled(tuple(given.astype(int).tolist())))

    def why(self) -> Why:
        """Returns the values behind the last decision.

        Raises:
            InputError: there is no decision yet.
        """
        events, questions = self._talk.events, self._talk.problem.questions
        decided = [
            i for i, event in enumerate(events) if isinstance(event, QuestionAsked | MessagesGiven)
        ]
        if not decided:
            raise InputError("session", 0, "messages() comes first")
        before, event = self._talk.at(decided[-1]), events[decided[-1]]
        messages, asked = dict[tuple[str, ...], float](), list[tuple[Question, float]]()
        for action, value in sorted(before.values().items(), key=lambda item: -item[1]):
            match action:
                case AskQuestion(question):
                    asked.append((questions.question(question), value))
                case _:
                    messages[self._name_messages(messages_of(action))] = value
        visible = before.state.visible
        return Why(
            step=visible.step,
            given=self._name_messages(visible.given),
            belief=self._name_types(before.state.belief),
            fit=before.problem.fit(before.state.belief),
            chosen=self._name_messages(event.messages) if isinstance(event, MessagesGiven) else (),
            values=messages,
            asked=questions.question(event.question) if isinstance(event, QuestionAsked) else None,
            questions=tuple(asked),
        )

    def take_up(self, events: Sequence[tuple[str, Any]]) -> None:
        """Repeats the events of a session.

        Args:
            events: (name of the method, its argument) for each event, as :meth:`to_json` writes
                them.

        Raises:
            InputError: see :meth:`ask`, :meth:`answer`, :meth:`tell` and :meth:`observe`; or an
                unknown kind of event.
        """
        methods: dict[str, Callable[[Any], None]] = {
            "ask": self.ask,
            "answer": self.answer,
            "tell": self.tell,
            "observe": self.observe,
        }
        for kind, content in events:
            methods[one_of("session.events", kind, tuple(methods), "event")](content)

    def to_json(self) -> str:
        """Writes the whole session as text; :meth:`xplain.Explainer.from_json` restores it.

        Raises:
            InputError: JSON cannot represent a transition.
        """
        talk = self._talk
        contents = [
            self._name_messages(e.messages) if isinstance(e, MessagesGiven) else e[0]
            for e in talk.events
        ]
        kinds = [KINDS[type(event)] for event in talk.events]
        state = {
            "format": FORMAT,
            "messages": talk.problem.message_names,
            "types": talk.problem.found_types,
            "trace": self.trace,
            "expected_steps": self._expected_steps,
            "clips": [[clip.transition, clip.text, clip.right] for clip in self._clips],
            "events": list(zip(kinds, contents, strict=True)),
        }
        try:
            return json.dumps(state)
        except TypeError as error:
            first = [*self.trace, *(clip.transition for clip in self._clips)][0]
            raise InputError("trace", first, f"transitions that JSON allows ({error})") from None

    def _decide(self, asking: bool) -> None:
        """Lets the policy choose the next action, and adds the action to the dialogue's events. If
        ``asking`` is False, the action is not a question."""
        match self._talk.decide(asking):
            case AskQuestion(question):
                self._talk.hear(QuestionAsked(question))
            case action:
                self._talk.hear(MessagesGiven(messages_of(action)))

    def _check_step_is_open(self, key: str, value: object) -> None:
        """Raises InputError if this step's messages were given, or the trace is at its end."""
        if self._talk.state.new is not None or self.finished:
            raise InputError(key, value, "only once at each step, before messages()")

    def _name_types(self, belief: NDArray[np.float64]) -> dict[str, float]:
        problem = self._talk.problem
        return dict(zip(problem.type_names, problem.type_belief(belief).tolist(), strict=True))

    def _name_messages(self, mask: int) -> tuple[str, ...]:
        return names_of(mask, self._talk.problem.message_names)
