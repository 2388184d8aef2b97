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

from xplain.errors import InputError
from xplain.explanation.actions import Action, AskQuestion, Explain, GiveMessages, VisibleState
from xplain.explanation.asking import bitmask
from xplain.explanation.belief import (
    BeliefUpdate,
    update,
    update_by_answer,
    update_by_messages,
)
from xplain.explanation.message_sets import names_of
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy, messages_of


class QuestionAnswered(NamedTuple):
    """The event that the user answered the last question, with 0 or 1."""

    answer: int


class StepLabelled(NamedTuple):
    """The event that *explain* showed one more transition, and the user labelled all transitions
    shown so far: 0, 1, or 2 for "cannot tell"."""

    labels: tuple[int, ...]


Event = Action | QuestionAnswered | StepLabelled
"""An event: an action was taken, or the user reacted to an action."""


class DialogueState(NamedTuple):
    """The state of a dialogue.

    Attributes:
        visible: step, messages given, and questions asked.
        belief: [S] over the hidden states.
        known: [m] True for each transition that the user has labelled 0 or 1, or answered a
            question about, since the last message (or since the last step, if users may forget).
            Users who repeat themselves label such a transition in the same way again.
        pending: the action to which the user has not reacted yet; None before the next decision.
    """

    visible: VisibleState
    belief: NDArray[np.float64]
    known: NDArray[np.bool_]
    pending: Action | None = None


def advance(
    problem: Problem, belief_update: BeliefUpdate, state: DialogueState, event: Event
) -> DialogueState:
    """Computes the state after an event.

    Raises:
        InputError: messages that do not exist, or may not be given any more.
    """
    visible, belief, known, pending = state
    match event:
        case AskQuestion():
            return state._replace(pending=event)
        case QuestionAnswered(answer):
            assert isinstance(pending, AskQuestion)
            question, shows = pending.question, problem.questions.shows[pending.question]
            if belief_update.fresh_labels or not (shows & known).any():  # no repeated label
                belief = update_by_answer(problem, belief, visible.given, question, answer)
            visible = visible._replace(asked=visible.asked | 1 << question)
            return DialogueState(visible, belief, known | shows)
        case StepLabelled(labels):
            heard = np.array(labels, np.uint8)
            told = np.flatnonzero(heard < 2)  # not 2, "cannot tell"
            first = told[np.unique(problem.copies[told], return_index=True)[1]]
            # If people repeat themselves, only labels that they could not repeat are evidence.
            evidence = slice(None) if belief_update.fresh_labels else first[~known[first]]
            return DialogueState(
                visible._replace(step=len(heard)),
                update(problem, belief, visible.given, heard, evidence),
                # After facts were forgotten, the same person may give another label.
                np.zeros_like(known)
                if problem.habits.forget.any()
                else known | np.isin(problem.copies, problem.copies[first]),
            )
        case _:
            messages = messages_of(event)
            if messages & ~problem.may_give(visible.given):
                names = problem.message_names
                wanted = f"messages that may be said after {names_of(visible.given, names)}"
                raise InputError("messages", names_of(messages, names) or bin(messages), wanted)
            return DialogueState(
                visible._replace(given=visible.given | messages),
                update_by_messages(problem, belief, messages),
                # After a message, the same person may give another label.
                np.zeros_like(known) if messages else known,
                event,
            )


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
        self.state = DialogueState(
            VisibleState(), self.problem.start, np.zeros(self.problem.n_steps, np.bool_)
        )
        events, self.events = self.events, []
        self.hear(*events)

    def hear(self, *events: Event) -> None:
        """Adds events, and computes the state after them.

        Raises:
            InputError: see :func:`advance`.
        """
        for event in events:
            self.state = advance(self.problem, self.belief_update, self.state, event)
            self.events.append(event)

    def at(self, count: int) -> Dialogue:
        """Returns the dialogue after its first ``count`` events."""
        return Dialogue(self.problem, self.policy, self.belief_update, self.events[:count])

    @property
    def visible(self) -> VisibleState:
        """The visible state that the policy receives. If users repeat themselves, a question about
        a transition whose label is known counts as asked."""
        visible = self.state.visible
        if self.belief_update.fresh_labels:
            return visible
        answered = (self.problem.questions.shows & self.state.known).any(axis=1)
        return visible._replace(asked=visible.asked | bitmask(np.flatnonzero(answered).tolist()))

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
        taken = (event for event in self.events if isinstance(event, Explain | GiveMessages))
        return tuple(messages_of(action) for action in taken)

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
