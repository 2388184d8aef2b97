"""A cache of decisions: a policy is asked each question once.

Users who answer alike lead to the same questions, and a search is dear. A policy is a function of
(step, given, belief), so an answer once given holds; how long it took is kept with it, so that
what was cached does not pass for fast.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.belief import rounded
from xplain.solvers.base import Policy


class CachedPolicy:
    """A policy and the decisions that it has taken so far.

    Attributes:
        policy: the one that is asked.
        seconds: what the last decision took when the policy was asked.
        decisions: by (step, given, rounded belief): the messages, and the seconds.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.seconds = 0.0
        self.decisions: dict[tuple[int, int, bytes], tuple[int, float]] = {}

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """See :class:`xplain.solvers.base.Policy`. The policy sees the rounded belief: which of
        two that differ by rounding came first makes no difference."""
        belief = rounded(belief)
        question = step, given, belief.tobytes()
        if question not in self.decisions:
            before = time.perf_counter()
            answer = self.policy.messages(step, given, belief)
            self.decisions[question] = answer, time.perf_counter() - before
        answer, self.seconds = self.decisions[question]
        return answer

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """What the sets or messages to choose from are worth, as
        :class:`xplain.solvers.base.Policy` says."""
        return self.policy.values(step, given, belief)
