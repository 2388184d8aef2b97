"""A dialogue: the events of one explanation, and the state that follows from them.

Belief and visible state are a fold of the events, so a dialogue can be restored from its events
alone. Experiments, the study and embedded sessions all use it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import Action, VisibleState
from xplain.explanation.asking import bitmask
from xplain.explanation.belief import BeliefUpdate, answered, told, update
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy


class Asked(NamedTuple):
    """A question was asked, by its number."""

    question: int


class Answered(NamedTuple):
    """The question was answered, 0 or 1."""

    answer: int


class Given(NamedTuple):
    """The messages of a step (a bitmask; 0 for none) were decided and given."""

    messages: int


class Told(NamedTuple):
    """The calling program received these messages."""


class Labelled(NamedTuple):
    """*Explain* showed one more transition; these are the user's labels of all shown
    transitions."""

    labels: tuple[int, ...]


Event = Asked | Answered | Given | Told | Labelled


class DialogueState(NamedTuple):
    """The state of a dialogue.

    Attributes:
        visible: step, messages and questions.
        belief: [S] over hidden states.
        open: the unanswered question; None for none.
        new: bitmask of the messages given before the next labels; None before the decision.
        told: True if the calling program received these messages.
        repeats: True if users who repeat themselves would repeat their last labels.
        clips: bitmask of the questions since the last message; their answers are labels.
    """

    visible: VisibleState
    belief: NDArray[np.float64]
    open: int | None = None
    new: int | None = None
    told: bool = False
    repeats: bool = False
    clips: int = 0


def advance(
    problem: Problem, belief_update: BeliefUpdate, state: DialogueState, event: Event
) -> DialogueState:
    """The state after an event.

    Raises:
        ValueError: messages that do not exist, or may not be given any more.
    """
    visible, belief = state.visible, state.belief
    match event:
        case Asked(question):
            return state._replace(open=question)
        case Answered(answer):
            assert state.open is not None
            bit = 1 << state.open
            return state._replace(
                visible=visible._replace(asked=visible.asked | bit),
                belief=answered(problem, belief, visible.given, state.open, answer),
                open=None,
                clips=state.clips | bit,
            )
        case Given(messages):
            if messages & ~problem.may_give(visible.given):
                raise ValueError(
                    f"policy gave message set {messages:b} at step {visible.step}, "
                    f"{visible.given:b} already said"
                )
            given = state._replace(
                visible=visible._replace(given=visible.given | messages),
                belief=told(problem, belief, messages),
                open=None,
                new=messages,
                told=False,
            )
            # After a new message, a repeated question is a new question.
            return given._replace(repeats=False, clips=0) if messages else given
        case Told():
            return state._replace(told=True)
        case Labelled(labels):
            heard = np.array(labels, np.uint8)
            evidence = slice(None) if belief_update.fresh_labels else _news(problem, state, heard)
            # The same holds if people may have forgotten something.
            forgets = bool(problem.habits.forget.any())
            return DialogueState(
                visible._replace(step=len(labels)),
                update(problem, belief, visible.given, heard, evidence),
                repeats=not forgets,
                clips=0 if forgets else state.clips,
            )


def _news(problem: Problem, state: DialogueState, labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """[k + 1] True for new labels that are evidence if people repeat themselves: labels not given
    since the last message, and only the first one of equal transitions."""
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
        belief_update: the labels that change the belief.
        events: the events, in order.
        state: the state that follows from them.
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
        """Adds events.

        Raises:
            ValueError: see :func:`advance`.
        """
        for event in events:
            self.state = advance(self.problem, self.belief_update, self.state, event)
            self.events.append(event)

    def before_last_decision(self) -> tuple[Dialogue, Event] | None:
        """The dialogue before the last decision, and that decision; None without a decision."""
        decided = [i for i, e in enumerate(self.events) if isinstance(e, Asked | Given)]
        if not decided:
            return None
        last = decided[-1]
        before = Dialogue(self.problem, self.policy, self.belief_update, self.events[:last])
        return before, self.events[last]

    @property
    def visible(self) -> VisibleState:
        """The state that the policy sees. Questions whose answers are known from labels count as
        asked."""
        state, shows = self.state, self.problem.questions.shows
        if not state.repeats or self.belief_update.fresh_labels:
            return state.visible
        heard = np.flatnonzero(shows[:, : state.visible.step].any(axis=1))
        return state.visible._replace(asked=state.visible.asked | bitmask(heard.tolist()))

    def decide(self, asking: bool = True) -> Action:
        """The policy's next action; ``asking=False`` excludes questions."""
        visible = self.visible
        if not asking:
            visible = visible._replace(asked=(1 << len(self.problem.questions)) - 1)
        return self.policy.decide(visible, self.state.belief)

    def values(self) -> Mapping[Action, float]:
        """The values of the possible actions."""
        return self.policy.values(self.visible, self.state.belief)


def all_given(events: Iterable[Event]) -> list[int]:
    """The messages of each step, as bitmasks."""
    return [event.messages for event in events if isinstance(event, Given)]


def all_labels(events: Iterable[Event]) -> list[tuple[int, ...]]:
    """The labels of each step."""
    return [event.labels for event in events if isinstance(event, Labelled)]
