"""Planning with fewer messages: those that can never pay are left out before tables are made."""

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
from xplain.solvers.model import model_of, optimal_values


def messages_worth_giving(problem: Problem) -> tuple[int, ...]:
    """The messages to plan with: those with effect, and those that may pay as a mere delay.

    A message without effect costs λ C_e. Where giving it discounts, it also puts off what is
    still to be paid, which is worth (1 − γ) of that: with a low price an optimal plan does stall.
    It is left out only where it cannot: what is still to be paid under the optimum is at most
    the optimal cost of an imagined type that finds each transition as inexplicable as any type.
    """
    effective = problem.table.effective_of_any()
    idle = set(range(problem.n_messages)) - set(effective)
    if not idle:
        return effective
    price = problem.trade_off * problem.message_cost
    delay = 1 - problem.discount if problem.discount_per == "action" else 0.0
    if delay <= 0:
        return effective
    small = problem.with_messages(effective)
    stalling = {j for j in idle if price[j] < delay * _saying_everything(small)}
    if stalling and len(effective) <= MAX_RELEVANT:
        imagined = small.with_types(small.table.worst(), ("worst",))
        ahead = -float(optimal_values(model_of(imagined.dense())).min())
        stalling = {j for j in stalling if price[j] < delay * ahead}
    return tuple(sorted(stalling.union(effective)))


def _saying_everything(small: Problem) -> float:
    """What the imagined type has still to pay under the optimum, at most, from any step on and
    whatever was given: all messages are given at once, and then nothing is said."""
    everything = (1 << small.n_messages) - 1
    p = small.table.label_probabilities(small.n_steps, everything).min(axis=0)
    left, most = 0.0, 0.0
    for cost in reversed((small.inexplicability_cost * np.cumsum(1 - p)).tolist()):
        left = cost + small.discount * left
        most = max(most, left)
    return small.trade_off * float(small.message_cost.sum()) + most


def restricted(problem: Problem) -> tuple[Problem, tuple[int, ...]]:
    """The problem with the messages worth giving, and their positions. With few of them it is
    dense: searches are quicker where the tables of all types lie side by side."""
    kept = messages_worth_giving(problem)
    small = problem.with_messages(kept)
    return (small.dense() if len(kept) <= DENSE else small), kept


def coupled(problem: Problem, what: str) -> tuple[Problem, tuple[int, ...]]:
    """As :func:`restricted`, for who weighs sets of all types' messages together: the problem
    with at most MAX_RELEVANT messages, to be made dense where there is memory for it.

    Raises:
        TooLargeError: more are worth giving.
    """
    small, kept = restricted(problem)
    if len(kept) > MAX_RELEVANT:
        raise TooLargeError(
            f"{what} weighs sets of all types' messages together: {len(kept)} are worth giving on "
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
