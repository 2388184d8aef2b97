"""Solvers that search for nothing.

- *QHR* takes the best set of messages if nothing could be said after the next step:
  Q(b, a) = −(λ C_e(a) + Σ_{j > k}^{m} Σ_{i ≤ j} C_inexp (1 − P[t, i, H ∪ a])), expected over the
  belief (the paper, "Myopic Approximation: QHR", after Fern et al. 2014). The sum over j begins
  with the prefix that the next *explain* shows. As in the paper nothing is discounted.
- *Silent* says nothing: its cost is that of all labels 0 under the empty message set.
- *Say all* gives every message before the first step: λ Σ_j C_e(j), and what stays inexplicable.
- *Ask first* asks the questions whose answers tell the most (greedy mutual information), whatever
  they cost, before the first step; from then on it is QMDP.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Positive, TooLargeError, checks
from xplain.explanation.actions import Action, AskQuestion, VisibleState, give
from xplain.explanation.label_table import MAX_RELEVANT
from xplain.explanation.message_sets import indices, subsets
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy, best_of
from xplain.solvers.greedy import greedy_policy
from xplain.solvers.known_type import known_values
from xplain.solvers.process import (
    Process,
    all_given,
    before_step,
    expected_after_forgetting,
    make_process,
)
from xplain.solvers.voi import telling_questions, with_questions

MAX_MISSED = 10
"""Messages whose sets are weighed together where they may be missed, at most: a set then leads to
a belief of its own."""


def weighable(process: Process, what: str) -> int:
    """Bitmask of the messages with an effect, for solvers that weigh sets of them together.

    Raises:
        TooLargeError: they are too many.
    """
    messages = int(np.bitwise_or.reduce(process.relevant))
    most = MAX_RELEVANT if process.jump is None else MAX_MISSED
    if messages.bit_count() > most:
        raise TooLargeError(
            f"{what} weighs sets of messages together: {messages.bit_count()} matter on this "
            f"trace, at most {most}; solver=qmdp or pomcp says one after the other"
        )
    return messages


@dataclass(frozen=True)
class QHR:
    """No options: a closed form, computed when asked."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says.

        Raises:
            TooLargeError: too many messages have an effect.
        """
        process = make_process(problem)
        messages = weighable(process, "qhr")
        shown = np.empty(process.p.shape)
        later = np.zeros(process.p.shape[1])
        for k in reversed(range(process.n_steps)):
            later = process.explain_cost[k] + expected_after_forgetting(process, later)
            shown[k] = later
        policy = QHRPolicy(process, messages, shown)
        if not problem.questions:
            return policy
        return with_questions(policy, process, known_values(process), seed)


@dataclass(frozen=True)
class QHRPolicy:
    """Maximises QHR's closed form. Ties: fewest messages first, then message order.

    Attributes:
        process: the model.
        messages: bitmask of those with an effect.
        shown: [m, cells] what the prefixes from k on cost, where nothing more is said.
    """

    process: Process
    messages: int
    shown: NDArray[np.float64]

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """As :class:`xplain.solvers.base.Policy` says."""
        return give(best_of(*self._all(visible, belief)))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Of *explain*, of each message alone, and of the set chosen."""
        sets, values = self._all(visible, belief)
        listed = np.flatnonzero((np.bitwise_count(sets) <= 1) | (values == values.max()))
        return {give(int(sets[i])): float(values[i]) for i in listed}

    def _all(
        self, visible: VisibleState, belief: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Every set of messages that may be given, ascending, and its value."""
        process = self.process
        said = before_step(process, visible.given)
        free = indices(self.messages & ~said)
        sets, heard = subsets(free), belief[None]
        if process.jump is not None:
            heard = all_given(process, belief, free)
        costs = self.shown[visible.step, process.cells.of_sets(sets | said)]
        price = np.zeros(len(sets))
        for j in free:
            price += process.price[j] * (sets >> j & 1)
        return sets, -(price + (costs * heard).sum(axis=1))


@dataclass(frozen=True)
class Silent:
    """Never gives a message."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """See :class:`xplain.solvers.base.Solver`."""
        return OpenLoop(0)


@dataclass(frozen=True)
class SayAll:
    """Gives all messages at once, those too that change nothing."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """See :class:`xplain.solvers.base.Solver`."""
        return OpenLoop((1 << problem.n_messages) - 1)


@dataclass(frozen=True)
class OpenLoop:
    """Gives a set of messages at the first opportunity, whatever the user answers.

    Attributes:
        chosen: the set, a bitmask.
    """

    chosen: int

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Gives those of the set that are not yet given."""
        return give(self.chosen & ~visible.given)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """None: nothing was weighed."""
        return {}


@checks("solver")
@dataclass(frozen=True)
class AskFirst:
    """Args:
    memory_gib: most that QMDP's tables may take.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        policy = greedy_policy(problem, "ask_first", self.memory_gib)
        return AsksFirst(policy, policy.process)


@dataclass(frozen=True)
class AsksFirst:
    """Asks what tells the most while anything does, before the first step.

    Attributes:
        policy: decides on messages.
        process: the model.
    """

    policy: Policy
    process: Process

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """As :class:`xplain.solvers.base.Policy` says."""
        if not visible.step and not visible.given:
            questions, _ = telling_questions(self.process, visible, belief, 1)
            if questions:
                return AskQuestion(questions[0])
        return self.policy.decide(visible, belief)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """QMDP's, of messages alone: questions are not weighed."""
        return self.policy.values(visible, belief)
