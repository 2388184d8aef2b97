"""Solvers that assume that the hidden state becomes known after the next action.

Q(b, a) = E[Q*(k, v, s, a)], with Q* from exact dynamic programming (:mod:`xplain.solvers.process`):

- *QMDP* (Littman, Cassandra & Kaelbling 1995; the paper, "Myopic Approximation: QMDP") uses the
  user types, and never acts to gain information from labels;
- *baseline* (the paper): one labeler learned from all labels;
- *conformant* (the paper's user study): pays for the labels 0 of all types, so that the explanation
  suits all of them;
- *oracle* (the paper): the true type's labeler; the regret is relative to the oracle's cost;
- *clairvoyant*: the true labels, the lower bound of every cost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Positive, checks
from xplain.explanation.actions import EXPLAIN, Action, GiveMessages, VisibleState, give
from xplain.explanation.label_table import DENSE
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy, best_of, check_memory
from xplain.solvers.process import (
    PATIENCE,
    KnownValues,
    Process,
    before_step,
    give_all,
    known_bytes,
    known_values,
    make_process,
    matters,
)
from xplain.solvers.voi import with_questions


@dataclass(frozen=True)
class Greedy:
    """A policy that adds the message with the largest expected value, and then the next, until
    *explain* is the best action. A message is given at most once in a step. Messages without effect
    on any type with positive belief are left out.

    Attributes:
        process: the model.
        known: the model's values for known states.
    """

    process: Process
    known: KnownValues

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses messages one after the other; returns them, or *explain* if there are none."""
        process, chosen = self.process, 0
        said, useful = before_step(process, visible.given), matters(process, belief)
        while True:
            margin = 0.0 if process.jump is None else PATIENCE * (1 - belief.max())
            messages = indices(useful & ~(said | chosen))
            values = self._compute_values(visible.step, said | chosen, belief, messages, margin)
            new = best_of(np.array([0, *(1 << j for j in messages)]), values)
            if not new:
                return give(chosen)
            chosen |= new
            belief = give_all(process, belief, new)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the values of *explain* and of each single message."""
        said = before_step(self.process, visible.given)
        messages = indices(matters(self.process, belief) & ~said)
        values = self._compute_values(visible.step, said, belief, messages)
        actions: list[Action] = [EXPLAIN, *(GiveMessages(1 << j) for j in messages)]
        return dict(zip(actions, values.tolist(), strict=True))

    def _compute_values(
        self,
        step: int,
        said: int,
        belief: NDArray[np.float64],
        messages: list[int],
        margin: float = 0.0,
    ) -> NDArray[np.float64]:
        """Computes the values of *explain* and of each of these messages."""
        process, known = self.process, self.known
        possible = np.flatnonzero(belief)
        belief = belief[possible]
        explained = known.explain[step].take(known.explain_cells.at(said)[possible])
        later = known.after_giving(process, step, said, messages, possible)
        gains = process.message_discount * (later @ belief)
        gains -= (1 + margin) * process.price[messages]
        return np.concatenate(([belief @ explained], gains))


def greedy_policy(problem: Problem, what: str, memory_gib: float) -> Greedy:
    """Makes the greedy policy of a problem.

    Raises:
        TooLargeError: the tables would exceed ``memory_gib``.
    """
    check_memory(what, known_bytes(problem), memory_gib, "qhr plans without tables")
    process = make_process(problem)
    return Greedy(process, known_values(process))


@checks("solver")
@dataclass(frozen=True)
class QMDP:
    """Plans with QMDP.

    Args:
        memory_gib: maximum memory of the tables of known types.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`."""
        policy = greedy_policy(problem, "qmdp", self.memory_gib)
        return with_questions(policy, policy.process, policy.known, seed)


@checks("solver")
@dataclass(frozen=True)
class Baseline:
    """Plans with one labeler for all users. For a problem with several types, this labeler is the
    mixture of the types' labelers, weighted by the prior.

    Args:
        memory_gib: maximum memory of its tables.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "everyone"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`."""
        return one_labeler(problem, problem.prior, "baseline", self.memory_gib)


@checks("solver")
@dataclass(frozen=True)
class Conformant:
    """Plans with the cost C_inexp Σ_t Σ_i (1 − P[t, i, H]) of *explain*. This is the sum over all
    user types, neither weighted by a belief nor divided by their number M (the paper's user study;
    docs/choices.md, slip 3).

    Args:
        memory_gib: maximum memory of its tables.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation; see :class:`xplain.solvers.base.Solver`."""
        # M types' costs are M times the cost of the mean labeler.
        count = len(np.unique(problem.whose[problem.as_found]))
        cost = problem.inexplicability_cost * count
        shares = problem.as_found / problem.as_found.sum()
        summed = replace(problem, inexplicability_cost=cost)
        return one_labeler(summed, shares, "conformant", self.memory_gib)


def one_labeler(
    problem: Problem, shares: NDArray[np.float64], what: str, memory_gib: float
) -> FixedBelief:
    """Makes QMDP's policy for one type that replaces all types. The probability of each label is
    the mean over the types, weighted by ``shares`` [N]. If more than DENSE messages matter, a table
    over all message sets is too large. QMDP then uses ``shares`` as its permanent belief, and plans
    later steps for each type alone."""
    if problem.messages_land and len(problem.messages_with_effect) > DENSE:
        return FixedBelief(greedy_policy(problem, what, memory_gib), lambda _: shares)
    one = problem.mixture(shares)
    return FixedBelief(greedy_policy(one, what, memory_gib), lambda _: np.ones(1))


@checks("solver")
@dataclass(frozen=True)
class KnownType:
    """Plans with the known type: the oracle, or with true labels the clairvoyant.

    Args:
        knows: "type" or "labels"; the experiment makes the problem for this knowledge.
        memory_gib: maximum memory of the tables [steps, 2^messages, types].
    """

    knows: Literal["type", "labels"] = "type"
    memory_gib: Positive = 8.0

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans as QMDP; see :class:`xplain.solvers.base.Solver`. With several types the policy
        needs a belief that is certain of one type."""
        what = f"knowing the {self.knows}"
        return FixedBelief(greedy_policy(problem, what, self.memory_gib), certain_type)


@dataclass(frozen=True)
class FixedBelief:
    """A policy that receives another belief than the explainer's.

    Attributes:
        policy: the policy that decides.
        belief_of: computes the belief that the policy receives.
    """

    policy: Policy
    belief_of: Callable[[NDArray[np.float64]], NDArray[np.float64]]

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses the policy's action at ``belief_of(belief)``."""
        return self.policy.decide(visible, self.belief_of(belief))

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the policy's values at ``belief_of(belief)``."""
        return self.policy.values(visible, self.belief_of(belief))


def certain_type(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the belief unchanged, if it is certain of one type. QMDP's value is then the optimal
    value of this type.

    Raises:
        InputError: the belief is not certain of one type.
    """
    if belief.max() < 1 - 1e-9:  # a sum of probabilities is 1 up to rounding
        raise InputError("belief", belief.tolist(), "1 for one type, because this solver knows it")
    return belief
