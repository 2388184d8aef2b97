"""Planning with fewer messages: those that can never pay are left out before tables are made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.message_sets import compress, expand
from xplain.solvers.base import Policy
from xplain.solvers.model import model_of, optimal_values


def messages_worth_giving(problem: Problem) -> tuple[int, ...]:
    """The messages to plan with: those with effect, and those that may pay as a mere delay.

    A message without effect costs λ C_e. Where giving it discounts, it also puts off what is
    still to be paid, which is worth (1 − γ) of that: with a low price an optimal plan does stall.
    It is left out only where it cannot: what is still to be paid under the optimum is at most
    the optimal cost of an imagined type that finds each transition as inexplicable as any type.
    """
    effective = problem.messages_with_effect()
    idle = set(range(problem.n_messages)) - set(effective)
    if not idle:
        return effective
    model = model_of(problem)
    delay = 1 - model.message_discount
    ahead = 0.0
    if delay > 0:
        worst = problem.with_messages(effective).pessimistic()
        ahead = -float(optimal_values(model_of(worst)).min())
    stalling = {j for j in idle if model.price[j] < delay * ahead}
    return tuple(sorted(stalling.union(effective)))


@dataclass(frozen=True)
class Restricted:
    """A policy of the restricted problem, spoken in the whole problem's masks.

    Attributes:
        policy: over the kept messages.
        kept: their positions in the whole problem.
    """

    policy: Policy
    kept: tuple[int, ...]

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says."""
        return expand(self.policy.messages(step, compress(given, self.kept), belief), self.kept)

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """What the sets or messages to choose from are worth, as
        :class:`xplain.solvers.base.Policy` says."""
        values = self.policy.values(step, compress(given, self.kept), belief)
        return {expand(mask, self.kept): value for mask, value in values.items()}
