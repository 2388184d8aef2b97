"""A cache of decisions: a policy is asked each question once.

Users who answer alike lead to the same questions, and a search takes long. A policy is a function
of the visible state and the belief, so a decision once taken holds; how long it took is kept with
it, so that what was cached does not pass for fast.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import Action, VisibleState
from xplain.explanation.belief import rounded
from xplain.solvers.base import Policy


class CachedPolicy:
    """A policy and the decisions that it has taken so far.

    Attributes:
        policy: the one that is asked.
        seconds: what the last decision took when the policy was asked.
        decisions: action and seconds, by visible state and rounded belief.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.seconds = 0.0
        self.decisions: dict[tuple[VisibleState, bytes], tuple[Action, float]] = {}

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """See :class:`xplain.solvers.base.Policy`. The policy sees the rounded belief: which of
        two that differ by rounding came first makes no difference."""
        belief = rounded(belief)
        key = visible, belief.tobytes()
        if key not in self.decisions:
            before = time.perf_counter()
            action = self.policy.decide(visible, belief)
            self.decisions[key] = action, time.perf_counter() - before
        action, self.seconds = self.decisions[key]
        return action

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """See :class:`xplain.solvers.base.Policy`."""
        return self.policy.values(visible, belief)
