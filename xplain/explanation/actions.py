"""The state that a decision depends on, and the possible actions.

The explainer sees the number of shown transitions, the given messages, and the asked questions. The
user is hidden, and is described by a belief (mixed observability: Ong, Png, Hsu & Lee 2010).
"""

from dataclasses import dataclass
from typing import NamedTuple


class VisibleState(NamedTuple):
    """The visible state before a decision, in the explanation of a trace of m transitions.

    Attributes:
        step: k, number of transitions shown so far, 0 … m − 1.
        given: bitmask of the messages given so far.
        asked: bitmask of the questions that were asked or whose answer is already known.
    """

    step: int = 0
    given: int = 0
    asked: int = 0


@dataclass(frozen=True, slots=True)
class Explain:
    """The action *explain*: show the first k + 1 transitions of the trace if k are shown so far,
    and receive the user's labels."""


@dataclass(frozen=True, slots=True)
class GiveMessages:
    """The action *give messages*: give one or more messages, then *explain*.

    Attributes:
        messages: bitmask of the messages.
    """

    messages: int


@dataclass(frozen=True, slots=True)
class AskQuestion:
    """The action *ask a question*: ask one question, then decide again.

    Attributes:
        question: index of the question.
    """

    question: int


Action = Explain | GiveMessages | AskQuestion
EXPLAIN = Explain()


def give(messages: int) -> Action:
    """Returns the action *give messages* for a bitmask of messages, or *explain* if the bitmask is
    0."""
    return GiveMessages(messages) if messages else EXPLAIN
