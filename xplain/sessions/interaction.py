"""One step of an explanation after the other: decide, say, hear, believe.

The experiments and the sessions that people embed run this same loop.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.belief import BeliefUpdate, told, update
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy


@dataclass
class Interaction:
    """One trace being explained (docs/method.md, section 5), by masks and arrays.

    Attributes:
        problem: what the agent believes of users.
        policy: planned for that problem. Both may be replaced between steps, by those of a trace
            that begins with the same transitions.
        belief_update: which labels change the belief.
        belief: over what is hidden, at first the prior.
        step: k, transitions shown so far.
        given: bitmask of the messages given so far.
    """

    problem: Problem
    policy: Policy
    belief_update: BeliefUpdate
    belief: NDArray[np.float64] = field(init=False)
    step: int = field(init=False)
    given: int = field(init=False)
    _answered: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Nothing was said or shown yet."""
        self.belief, self.step, self.given, self._answered = self.problem.start, 0, 0, None

    def say(self) -> int:
        """Decides which messages come before the next *explain*: a bitmask, given from now on.

        Raises:
            ValueError: as :meth:`give`.
        """
        new = self.policy.messages(self.step, self.given, self.belief)
        self.give(new)
        return new

    def give(self, new: int) -> None:
        """These messages are said; again, where users may have missed or forgotten them.

        Raises:
            ValueError: one does not exist, or was given before and is known since.
        """
        problem = self.problem
        again = 0 if problem.tracks_knowledge else new & self.given
        if again or new >> problem.n_messages:
            raise ValueError(
                f"policy gave message set {new:b} at step {self.step}, {self.given:b} already given"
            )
        self.given |= new
        self.belief = told(problem, self.belief, new)
        if new:
            self._answered = None  # who heard something new is asked something new

    def hear(self, labels: NDArray[np.uint8]) -> None:
        """*Explain* showed the first ``step + 1`` transitions; these are the user's labels."""
        count = self.step + 1
        evidence = self.belief_update.evidence(self.given, self._answered, count)
        self.belief = update(self.problem, self.belief, self.given, labels, evidence)
        # Who may have forgotten something is asked something new, too.
        self._answered = None if self.problem.habits.forget.any() else self.given
        self.step = count
