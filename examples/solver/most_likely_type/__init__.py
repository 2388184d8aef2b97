"""Plans for the type that is most likely now, as if it were known (Nourbakhsh et al. 1995 for
robots that know not where they are: "most likely state")."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain import Policy, Problem
from xplain.errors import Positive, checks
from xplain.explanation.actions import Action, VisibleState
from xplain.solvers.base import Knowledge
from xplain.solvers.greedy import greedy_policy


@checks("solver")
@dataclass(frozen=True)
class MostLikelyType:
    """Args:
    memory_gib: most that the tables [steps, 2^messages, types] may take.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Each type's optimal values; nothing here is random."""
        return AsIfKnown(greedy_policy(problem, "most_likely_type", self.memory_gib))


@dataclass(frozen=True)
class AsIfKnown:
    """The greedy policy at a belief of 1 on the most likely type (the first of equals)."""

    policy: Policy

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """The messages that this type needs now."""
        return self.policy.decide(visible, self._sure(belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """This type's values."""
        return self.policy.values(visible, self._sure(belief))

    def _sure(self, belief: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.eye(len(belief))[belief.argmax()]
