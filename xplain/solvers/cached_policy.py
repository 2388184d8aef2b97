"""A cache of decisions: a policy is asked each question once.

Users who answer alike lead to the same questions, and a search is dear. A policy is a function of
(step, given, belief), so an answer once given holds; how long it took is kept with it, so that
what was cached does not pass for fast.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.belief import rounded
from xplain.solvers.base import Asks, Policy, asking


class CachedPolicy:
    """A policy and the decisions that it has taken so far.

    Attributes:
        policy: the one that is asked.
        seconds: what the last decision took when the policy was asked.
        decisions: by what was to decide and (step, given, rounded belief, asked): the messages or
            the question, and the seconds.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self._asks = isinstance(policy, Asks)  # once: it takes as long as a decision
        self.seconds = 0.0
        self.decisions: dict[tuple[object, ...], tuple[int, float]] = {}

    def messages(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """See :class:`xplain.solvers.base.Policy`. The policy sees the rounded belief: which of
        two that differ by rounding came first makes no difference."""
        if self._asks:
            return self._decide(self.policy.messages, step, given, rounded(belief), asked)
        return self._decide(self.policy.messages, step, given, rounded(belief))

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """See :class:`xplain.solvers.base.Asks`."""
        return self._decide(asking(self.policy).question, step, given, rounded(belief), asked)

    def _decide(
        self,
        decide: Callable[..., int],
        step: int,
        given: int,
        belief: NDArray[np.float64],
        *asked: int,
    ) -> int:
        key = decide.__name__, step, given, belief.tobytes(), *asked
        if key not in self.decisions:
            before = time.perf_counter()
            answer = decide(step, given, belief, *asked)
            self.decisions[key] = answer, time.perf_counter() - before
        answer, self.seconds = self.decisions[key]
        return answer

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0
    ) -> Mapping[int, float]:
        """What the actions to choose from are worth, as :class:`xplain.solvers.base.Policy`
        says."""
        if isinstance(self.policy, Asks):
            return self.policy.values(step, given, belief, asked)
        return self.policy.values(step, given, belief)
