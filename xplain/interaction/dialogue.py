"""A dialogue: the events of one explanation, and the state that follows from them.

The belief and the visible state are computed from the events alone (:func:`advance`), so a stored
dialogue can be continued. Experiments, studies, and sessions in people's own programs all run this
code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import Action, VisibleState
from xplain.explanation.asking import bitmask
from xplain.explanation.belief import BeliefUpdate, update, update_by_answer, update_by_messages
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy


class QuestionAsked(NamedTuple):
    """The event that the question with this number was asked."""

    question: int


class QuestionAnswered(NamedTuple):
    """The event that the user answered the last question, with 0 or 1."""

    answer: int


class MessagesGiven(NamedTuple):
    """The event that the messages of a step were given (a bitmask; 0 is none)."""

    messages: int


class StepLabelled(NamedTuple):
    """The event that *explain* showed one more transition, and the user labelled all transitions
    shown so far."""

    labels: tuple[int, ...]


Event = QuestionAsked | QuestionAnswered | MessagesGiven | StepLabelled


class DialogueState(NamedTuple):
    """The state of a dialogue.

    Attributes:
        visible: step, messages given, and questions asked.
        belief: [S] over the hidden states.
        open: the question that the user has not answered yet; None for none.
        new: bitmask of the messages given at the current step; None before they are decided.
        repeats: True if the user has received no message and forgotten nothing since the last
            labels. Users who repeat themselves then give the same labels again.
        clips: bitmask of the questions answered since the last message (or since the last step, if
            users may forget). Users who repeat themselves label a transition as they answered the
            question about it.
    """

    visible: VisibleState
    belief: NDArray[np.float64]
    open: int | None = None
    new: int | None = None
    repeats: bool = False
    clips: int = 0


def advance(
    problem: Problem, belief_update: BeliefUpdate, state: DialogueState, event: Event
) -> DialogueState:
    """Computes the state after an event.

    Raises:
        ValueError: messages that do not exist, or may not be given any more.
    """
    visible, belief = state.visible, state.belief
    match event:
        case QuestionAsked(question):
            return state._replace(open=question)
        case QuestionAnswered(answer):
            assert state.open is not None
            bit = 1 << state.open
            return state._replace(
                visible=visible._replace(asked=visible.asked | bit),
                belief=update_by_answer(problem, belief, visible.given, state.open, answer),
                open=None,
                clips=state.clips | bit,
            )
        case MessagesGiven(messages):
            if messages & ~problem.may_give(visible.given):
                raise ValueError(
                    f"policy gave message set {messages:b} at step {visible.step}, "
                    f"{visible.given:b} already said"
                )
            given = state._replace(
                visible=visible._replace(given=visible.given | messages),
                belief=update_by_messages(problem, belief, messages),
                open=None,
                new=messages,
            )
            # After a message, the answer to the same question may differ.
            return given._replace(repeats=False, clips=0) if messages else given
        case StepLabelled(labels):
            heard = np.array(labels, np.uint8)
            evidence = (
                slice(None) if belief_update.fresh_labels else _find_evidence(problem, state, heard)
            )
            # The answer may also differ after facts were forgotten.
            forgets = bool(problem.habits.forget.any())
            return DialogueState(
                visible._replace(step=len(labels)),
                update(problem, belief, visible.given, heard, evidence),
                repeats=not forgets,
                clips=0 if forgets else state.clips,
            )


def _find_evidence(
    problem: Problem, state: DialogueState, labels: NDArray[np.uint8]
) -> NDArray[np.bool_]:
    """Finds the labels that are evidence if people repeat themselves. A label is evidence if its
    transition is the first of equal transitions, and the person has neither labelled the transition
    nor answered a question about it since the last message.

    Returns:
        [k + 1] True for a label that is evidence.
    """
    count = len(labels)
    news: NDArray[np.bool_] = problem.copies[:count] == np.arange(count)
    if state.repeats:
        news[:-1] = False
    shows = problem.questions.shows[indices(state.clips), :count]  # possibly without columns
    news[: shows.shape[1]] &= ~shows.any(axis=0)
    return news


@dataclass
class Dialogue:
    """The explanation of one trace (docs/method.md, section 5), in masks and arrays.

    Attributes:
        problem: the agent's model of users.
        policy: planned for that problem.
        belief_update: decides which labels change the belief.
        events: the events so far, in order.
        state: the state after these events.
    """

    problem: Problem
    policy: Policy
    belief_update: BeliefUpdate
    events: list[Event] = field(default_factory=list)
    state: DialogueState = field(init=False)

    def __post_init__(self) -> None:
        self.state = DialogueState(VisibleState(), self.problem.start)
        events, self.events = self.events, []
        self.hear(*events)

    def hear(self, *events: Event) -> None:
        """Adds events, and computes the state after them.

        Raises:
            ValueError: see :func:`advance`.
        """
        for event in events:
            self.state = advance(self.problem, self.belief_update, self.state, event)
            self.events.append(event)

    def at(self, count: int) -> Dialogue:
        """Returns the dialogue after its first ``count`` events."""
        return Dialogue(self.problem, self.policy, self.belief_update, self.events[:count])

    @property
    def visible(self) -> VisibleState:
        """The visible state that the policy receives. If users repeat themselves, a question whose
        transition the user has just labelled counts as asked, because its answer is known."""
        state, shows = self.state, self.problem.questions.shows
        if not state.repeats or self.belief_update.fresh_labels:
            return state.visible
        heard = np.flatnonzero(shows[:, : state.visible.step].any(axis=1))
        return state.visible._replace(asked=state.visible.asked | bitmask(heard.tolist()))

    def decide(self, asking: bool = True) -> Action:
        """Returns the policy's action. If ``asking`` is False, the action is not a question."""
        visible = self.visible
        if not asking:
            visible = visible._replace(asked=(1 << len(self.problem.questions)) - 1)
        return self.policy.decide(visible, self.state.belief)

    def values(self) -> Mapping[Action, float]:
        """Returns the policy's estimated value of each action that the policy compared."""
        return self.policy.values(self.visible, self.state.belief)

    @property
    def said(self) -> tuple[int, ...]:
        """The messages of each step, as bitmasks."""
        return tuple(event.messages for event in self.events if isinstance(event, MessagesGiven))

    @property
    def labels(self) -> tuple[tuple[int, ...], ...]:
        """The labels of each step."""
        return tuple(event.labels for event in self.events if isinstance(event, StepLabelled))

    def cost(self, zeros: int) -> float:
        """Computes the undiscounted cost of Definition 2 for this number of labels 0, plus κ for
        each answered question."""
        problem = self.problem
        answers = sum(isinstance(event, QuestionAnswered) for event in self.events)
        return (
            problem.trade_off * problem.communication(self.said)
            + problem.inexplicability_cost * zeros
            + problem.questions.limits.cost * answers
        )
