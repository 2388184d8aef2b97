"""The state that a decision sees, and what may be decided.

An explainer sees how many transitions were shown, which messages were given, and which questions
were asked; what it does not see, the user, is a belief beside it (mixed observability: Ong, Png,
Hsu & Lee 2010).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple


class VisibleState(NamedTuple):
    """What is visible before a decision.

    Attributes:
        step: k, transitions shown so far, 0 … m − 1.
        given: bitmask of the messages given so far.
        asked: bitmask of the questions asked so far, or whose answer is known already.
    """

    step: int = 0
    given: int = 0
    asked: int = 0


@dataclass(frozen=True, slots=True)
class Explain:
    """Show the first k + 1 transitions, and hear the user's labels of them."""


@dataclass(frozen=True, slots=True)
class GiveMessages:
    """Give messages, then *explain*.

    Attributes:
        messages: bitmask of at least one message.
    """

    messages: int


@dataclass(frozen=True, slots=True)
class AskQuestion:
    """Ask a question, then decide again.

    Attributes:
        question: its number.
    """

    question: int


Action = Explain | GiveMessages | AskQuestion
EXPLAIN = Explain()


def give(messages: int) -> Action:
    """To give these messages (a bitmask) and then explain; of none, to explain at once."""
    return GiveMessages(messages) if messages else EXPLAIN
