"""Dual-mode control (Cassandra, Kaelbling & Kurien 1996): while the hidden state is too uncertain,
ask the most informative question; otherwise act as if the most likely state were known."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.special import entr

from xplain import Policy, Problem
from xplain.errors import Positive, Range, checks
from xplain.explanation.actions import Action, AskQuestion, VisibleState
from xplain.solvers.base import Knowledge
from xplain.solvers.greedy import Greedy, greedy_policy
from xplain.solvers.voi import telling_questions


@checks("solver")
@dataclass(frozen=True)
class DualMode:
    """Args:
    entropy: a question is asked if the entropy of the belief, in nats, is larger.
    memory_gib: maximum memory of the tables of known states.
    """

    entropy: Annotated[float, Range(0)] = 0.3
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Computes each state's optimal values; nothing is random."""
        return DualModePolicy(greedy_policy(problem, "dual_mode", self.memory_gib), self.entropy)


@dataclass(frozen=True)
class DualModePolicy:
    """Asks at an uncertain belief. Otherwise it is the greedy policy at a belief of 1 in the most
    likely state (the first of several)."""

    greedy: Greedy
    entropy: float

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses a question, or the messages that the most likely state needs now."""
        if entr(belief).sum() > self.entropy:
            questions, _ = telling_questions(self.greedy.process, visible, belief, most=1)
            if questions:
                return AskQuestion(questions[0])
        return self.greedy.decide(visible, self._assume_most_likely(belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the most likely state's values."""
        return self.greedy.values(visible, self._assume_most_likely(belief))

    def _assume_most_likely(self, belief: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.eye(len(belief))[belief.argmax()]
