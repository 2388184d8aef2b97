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
from xplain.explanation.actions import Action, AskQuestion, Explain, GiveMessages, give
from xplain.explanation.asking import Question
from xplain.explanation.belief import NO_FIT
from xplain.explanation.listening import ExplanationRecord
from xplain.explanation.message_sets import mask_of, names_of
from xplain.interaction.dialogue import Dialogue, Event, QuestionAnswered, StepLabelled
from xplain.solvers.base import messages_of

FORMAT = 5
"""Version of a session's JSON."""


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


NamedAction = Question | tuple[str, ...]
"""An action with names: a question, or messages and then *explain*."""


@dataclass(frozen=True)
class Why:
    """The values behind a decision.

    Attributes:
        step: number of transitions shown before the decision.
        given: messages given before the decision.
        belief: belief in each type, by name.
        fit: probability that the user has a found type and the assumed habits.
        chosen: the chosen action; ``()`` is *explain* at once.
        values: estimated discounted return of each action that the solver evaluated, best first.
            Some solvers evaluate only single messages.
    """

    step: int
    given: tuple[str, ...]
    belief: Mapping[str, float]
    fit: float
    chosen: NamedAction
    values: Mapping[NamedAction, float]

    def __str__(self) -> str:
        lines = [f"step {self.step + 1}: {_describe(self.chosen, 'nothing to say')}"]
        if self.fit < NO_FIT:
            lines.append(f"the answers fit none of the types (fit {self.fit:.2f})")
        for action, value in self.values.items():
            lines.append(f"  {value:9.3f}  {_describe(action, 'say nothing more')}")
        return "\n".join(lines)


def _describe(action: NamedAction, nothing: str) -> str:
    """Describes an action in words. ``nothing`` describes *explain* without messages."""
    return f"ask: {action}" if isinstance(action, Question) else ", ".join(action) or nothing


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
        if talk.state.pending is None and not self.finished:
            talk.hear(talk.decide())
        if isinstance(talk.state.pending, AskQuestion):
            return talk.problem.questions.question(talk.state.pending.question)
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
        self._talk.hear(AskQuestion(number))

    def answer(self, answer: int) -> None:
        """Takes the user's answer to the question of :meth:`next`: 1 (or True) for yes, or for the
        true sentence about a fact.

        Raises:
            InputError: another answer, or no question was asked.
        """
        if not isinstance(self._talk.state.pending, AskQuestion):
            raise InputError("answer", answer, "a question comes first: next()")
        self._talk.hear(QuestionAnswered(int(one_of("answer", answer, (0, 1)))))

    def messages(self) -> tuple[str, ...]:
        """Returns the messages to say before the first ``shown`` transitions are shown; empty if
        silence is best. A repeated call before :meth:`observe` returns the same messages. The
        policy asks no question before these messages.

        Raises:
            InputError: all known transitions are labelled.
        """
        if not self._has_decided:
            if self.finished:
                raise InputError("session", len(self.trace), "is finished; extend the trace first")
            self._talk.hear(self._talk.decide(asking=False))
        return self._name_messages(self._talk.said[-1])

    def tell(self, names: Sequence[str]) -> None:
        """Gives these messages at this step, independent of the plan.

        Raises:
            InputError: :meth:`messages` was already called, or a message is unknown, or was given
                before and cannot be repeated.
        """
        self._check_step_is_open("session", tuple(names))
        self._talk.hear(give(mask_of(names, self._talk.problem.message_names, "session")))

    def observe(self, labels: ArrayLike) -> None:
        """Takes the user's labels of the first ``shown`` transitions, 1 = explicable.

        Raises:
            InputError: another number of labels, labels other than 0 and 1, or the messages of this
                step were not decided before.
        """
        if not self._has_decided:
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
        events = self._talk.events
        decided = [(i, event) for i, event in enumerate(events) if isinstance(event, Action)]
        if not decided:
            raise InputError("session", 0, "messages() comes first")
        count, chosen = decided[-1]
        before = self._talk.at(count)
        ranked = sorted(before.values().items(), key=lambda item: -item[1])
        return Why(
            step=before.state.visible.step,
            given=self._name_messages(before.state.visible.given),
            belief=self._name_types(before.state.belief),
            fit=before.problem.fit(before.state.belief),
            chosen=self._name_action(chosen),
            values={self._name_action(action): value for action, value in ranked},
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
        state = {
            "format": FORMAT,
            "messages": talk.problem.message_names,
            "types": talk.problem.found_types,
            "trace": self.trace,
            "expected_steps": self._expected_steps,
            "clips": [[clip.transition, clip.text, clip.right] for clip in self._clips],
            "events": [self._name_event(event) for event in talk.events],
        }
        try:
            return json.dumps(state)
        except TypeError as error:
            first = [*self.trace, *(clip.transition for clip in self._clips)][0]
            raise InputError("trace", first, f"transitions that JSON allows ({error})") from None

    @property
    def _has_decided(self) -> bool:
        """True if this step's messages are decided, and its labels are not known yet."""
        return isinstance(self._talk.state.pending, Explain | GiveMessages)

    def _check_step_is_open(self, key: str, value: object) -> None:
        """Raises InputError if this step's messages were given, or the trace is at its end."""
        if self._has_decided or self.finished:
            raise InputError(key, value, "only once at each step, before messages()")

    def _name_types(self, belief: NDArray[np.float64]) -> dict[str, float]:
        problem = self._talk.problem
        return dict(zip(problem.type_names, problem.type_belief(belief).tolist(), strict=True))

    def _name_messages(self, mask: int) -> tuple[str, ...]:
        return names_of(mask, self._talk.problem.message_names)

    def _name_action(self, action: Action) -> NamedAction:
        if isinstance(action, AskQuestion):
            return self._talk.problem.questions.question(action.question)
        return self._name_messages(messages_of(action))

    def _name_event(self, event: Event) -> tuple[str, Any]:
        """Returns the name of the method that adds this event, and the argument of the method."""
        match event:
            case AskQuestion(question):
                return "ask", question
            case QuestionAnswered(answer):
                return "answer", answer
            case StepLabelled(labels):
                return "observe", labels
            case _:
                return "tell", self._name_messages(messages_of(event))
