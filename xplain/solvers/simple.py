"""Solvers without a search.

- *QHR* takes the set of messages that is best if no message can be given after the next step:
  Q(b, a) = −(λ C_e(a) + Σ_{j > k}^{m} Σ_{i ≤ j} C_inexp (1 − P[t, i, H ∪ a])), the expectation over
  the belief (the paper, "Myopic Approximation: QHR", after Fern et al. 2014). The sum over j begins
  with the prefix that the next *explain* shows. As in the paper nothing is discounted.
- *Silent* gives no messages: it pays for all labels 0 under the empty message set.
- *Say all* gives every message before the first step: λ Σ_j C_e(j) plus the labels that are still
  0.
- *Ask first* asks the most informative questions (greedy mutual information) before the first step,
  independent of κ; then it is QMDP.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Positive, checks
from xplain.explanation.actions import Action, AskQuestion, VisibleState, give
from xplain.explanation.label_table import DENSE
from xplain.explanation.message_sets import bits_of, indices, subsets
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy, best_of, messages_of
from xplain.solvers.greedy import greedy_policy
from xplain.solvers.process import (
    Process,
    all_given,
    before_step,
    expected_after_forgetting,
    known_values,
    make_process,
    weighable,
)
from xplain.solvers.voi import telling_questions, with_questions


@dataclass(frozen=True)
class QHR:
    """Computes QHR's closed form at each decision; there are no options."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`.

        Raises:
            TooLargeError: messages may be missed, and too many have an effect.
        """
        process = make_process(problem)
        if process.jump is not None:
            weighable(problem, "qhr")
        shown = np.empty(process.p.shape)
        later = np.zeros(process.p.shape[1])
        for k in reversed(range(process.n_steps)):
            later = process.explain_cost[k] + expected_after_forgetting(process, later)
            shown[k] = later
        policy = QHRPolicy(process, _list_candidates(process), shown)
        if not problem.questions:
            return policy
        return with_questions(policy, process, known_values(process), seed)


def _list_candidates(process: Process) -> NDArray[np.int64]:
    """Lists the sets of messages to compare, ascending: all sets; or if more than DENSE messages
    have an effect, the sets of messages that are relevant to one state."""
    together = int(np.bitwise_or.reduce(process.relevant))
    own = [together] if together.bit_count() <= DENSE else np.unique(process.relevant).tolist()
    return np.unique(np.concatenate([subsets(indices(mask)) for mask in own]))


@dataclass(frozen=True)
class QHRPolicy:
    """Maximises QHR's closed form. Ties are decided as in :func:`xplain.solvers.base.best_of`.

    Attributes:
        process: the model.
        sets: the sets to compare, ascending. If these are not all sets, the best set is added to
            the chosen messages, again and again, until no addition is better.
        shown: [m, cells] the expected cost of all *explain* actions from step k to the end, if no
            further message is given.
    """

    process: Process
    sets: NDArray[np.int64]
    shown: NDArray[np.float64]

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses the set of messages with the largest value."""
        chosen, best = -1, 0
        while best != chosen:
            chosen = best
            best = best_of(*self._evaluate_sets(visible, belief, chosen))
        return give(chosen)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the values of *explain*, of each single message, and of the chosen set."""
        chosen = messages_of(self.decide(visible, belief))
        weighed: dict[int, float] = {}
        for first in (0, chosen):
            sets, values = self._evaluate_sets(visible, belief, first)
            weighed |= zip(sets.tolist(), values.tolist(), strict=True)
        return {give(s): v for s, v in weighed.items() if s.bit_count() <= 1 or s == chosen}

    def _evaluate_sets(
        self, visible: VisibleState, belief: NDArray[np.float64], chosen: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Lists the sets of messages that may be given and contain the chosen messages, ascending,
        with their values."""
        process = self.process
        said = before_step(process, visible.given)
        heard = belief[None]
        if process.jump is None:
            sets = np.unique(self.sets & ~said | chosen)
        else:
            sets = self.sets[self.sets & chosen == chosen]
            every = all_given(process, belief, indices(int(self.sets[-1])))
            heard = every[self.sets & chosen == chosen]
        costs = self.shown[visible.step, process.cells.of_sets(sets | said)]
        price = bits_of(sets, process.n_messages) @ process.price
        return sets, -(price + (costs * heard).sum(axis=1))


@dataclass(frozen=True)
class Silent:
    """Never gives a message."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Makes the policy that gives no message."""
        return OpenLoop(0)


@dataclass(frozen=True)
class SayAll:
    """Gives all messages at once, including those without effect."""

    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Makes the policy that gives all messages at the first step."""
        return OpenLoop((1 << problem.n_messages) - 1)


@dataclass(frozen=True)
class OpenLoop:
    """Gives a set of messages at the first step, independent of the user's answers.

    Attributes:
        chosen: the set, a bitmask.
    """

    chosen: int

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Gives the messages of the set that were not yet given."""
        return give(self.chosen & ~visible.given)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns no values, because this policy compares no actions."""
        return {}


@checks("solver")
@dataclass(frozen=True)
class AskFirst:
    """Plans with questions first, then with QMDP.

    Args:
        memory_gib: maximum memory of QMDP's tables.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`."""
        policy = greedy_policy(problem, "ask_first", self.memory_gib)
        return AsksFirst(policy, policy.process)


@dataclass(frozen=True)
class AsksFirst:
    """A policy that asks the most informative question before the first step, as long as some
    question is informative. Afterwards another policy decides on messages.

    Attributes:
        policy: decides on messages.
        process: the model.
    """

    policy: Policy
    process: Process

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses the most informative question before the first step, then QMDP's messages."""
        if not visible.step and not visible.given:
            questions, _ = telling_questions(self.process, visible, belief, 1)
            if questions:
                return AskQuestion(questions[0])
        return self.policy.decide(visible, belief)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns QMDP's values of messages; questions have no values."""
        return self.policy.values(visible, belief)
