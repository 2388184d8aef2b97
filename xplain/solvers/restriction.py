"""Planning with fewer messages: those without effect are no actions, and take no room in tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.label_table import DENSE, MAX_RELEVANT
from xplain.explanation.message_sets import compress, expand
from xplain.explanation.problem import Problem
from xplain.solvers.base import Asks, Policy


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

    def messages(self, step: int, given: int, belief: NDArray[np.float64], *asked: int) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says."""
        small = compress(given, self.kept)
        return expand(self.policy.messages(step, small, belief, *asked), self.kept)

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], *asked: int
    ) -> Mapping[int, float]:
        """What the sets or messages to choose from are worth, as
        :class:`xplain.solvers.base.Policy` says."""
        values = self.policy.values(step, compress(given, self.kept), belief, *asked)
        return {
            mask if mask < 0 else expand(mask, self.kept): value for mask, value in values.items()
        }


@dataclass(frozen=True)
class RestrictedAsking(Restricted):
    """A restricted policy that asks; questions are the same in both problems.

    Attributes:
        policy: over the kept messages.
    """

    policy: Asks

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """As :class:`xplain.solvers.base.Asks` says."""
        return self.policy.question(step, compress(given, self.kept), belief, asked)
