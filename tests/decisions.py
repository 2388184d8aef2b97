"""What policies decide and value, as numbers: sets of messages are bitmasks, question q is ~q."""

from __future__ import annotations

import numpy as np

from xplain.explanation.actions import AskQuestion, VisibleState
from xplain.solvers.base import Policy, messages_of


def messages_given(
    policy: Policy, step: int, given: int, belief: np.ndarray, asked: int = 0
) -> int:
    """The messages that a policy gives, where it asks nothing."""
    action = policy.decide(VisibleState(step, given, asked), belief)
    assert not isinstance(action, AskQuestion)
    return messages_of(action)


def question_asked(
    policy: Policy, step: int, given: int, belief: np.ndarray, asked: int = 0
) -> int | None:
    """The question that a policy asks; None where it asks none."""
    action = policy.decide(VisibleState(step, given, asked), belief)
    return action.question if isinstance(action, AskQuestion) else None


def worths(
    policy: Policy, step: int, given: int, belief: np.ndarray, asked: int = 0
) -> dict[int, float]:
    """The values behind a decision."""
    found = policy.values(VisibleState(step, given, asked), belief).items()
    return {
        ~action.question if isinstance(action, AskQuestion) else messages_of(action): value
        for action, value in found
    }
