"""Planning with fewer messages: those without effect are no actions, and take no room in tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.actions import Action, AskQuestion, GiveMessages, VisibleState, give
from xplain.explanation.label_table import DENSE, MAX_RELEVANT
from xplain.explanation.message_sets import compress, expand
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy


def restricted(problem: Problem) -> tuple[Problem, tuple[int, ...]]:
    """The problem with the messages that have an effect, and their positions. With few of them it
    is dense: searches are quicker where the tables of all types lie side by side."""
    kept = problem.messages_with_effect
    small = problem.with_messages(kept)
    return (small.dense() if len(kept) <= DENSE else small), kept


def coupled(problem: Problem, what: str) -> tuple[Problem, tuple[int, ...]]:
    """As :func:`restricted`, for who weighs sets of all types' messages together: the problem
    with at most MAX_RELEVANT messages, to be made dense where there is memory for it.

    Raises:
        TooLargeError: more have an effect.
    """
    small, kept = restricted(problem)
    if len(kept) > MAX_RELEVANT:
        raise TooLargeError(
            f"{what} weighs sets of all types' messages together: {len(kept)} matter on "
            f"this trace, at most {MAX_RELEVANT}; solver=qmdp or pomcp plans type by type"
        )
    return small, kept


@dataclass(frozen=True)
class Restricted:
    """A policy of the restricted problem, spoken in the whole problem's masks.

    Attributes:
        policy: over the kept messages.
        kept: their positions in the whole problem.
    """

    policy: Policy
    kept: tuple[int, ...]

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """As :class:`xplain.solvers.base.Policy` says."""
        return self._whole(self.policy.decide(self._small(visible), belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """As :class:`xplain.solvers.base.Policy` says."""
        values = self.policy.values(self._small(visible), belief)
        return {self._whole(action): value for action, value in values.items()}

    def _small(self, visible: VisibleState) -> VisibleState:
        return visible._replace(given=compress(visible.given, self.kept))

    def _whole(self, action: Action) -> Action:
        if isinstance(action, GiveMessages):
            return GiveMessages(expand(action.messages, self.kept))
        return action


def actions_of(values: Mapping[int, float]) -> dict[Action, float]:
    """Values by action, of values by set of messages and by ~q."""
    return {AskQuestion(~key) if key < 0 else give(key): value for key, value in values.items()}
