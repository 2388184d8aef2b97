"""Solvers that plan an MDP, one labeler standing for the user.

- *baseline* (the paper): one labeler learned from everybody's labels;
- *oracle* (the paper): the true type's labeler; the regret is measured against it;
- *clairvoyant*: the true labels themselves, the floor of every cost;
- *conformant* (the paper's user study): pays for the 0-labels of all types at once, so that the
  explanation suits everybody.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Positive, checks
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy
from xplain.solvers.qmdp import greedy_policy

INSTEAD = "qhr plans without tables"


@checks("solver")
@dataclass(frozen=True)
class Baseline:
    """One labeler for everybody. A problem of several types is taken as the mixture of their
    labelers, weighed by the prior.

    Args:
        memory_gib: most that the tables [steps, 2^messages] may take.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "everyone"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        one = problem.mixture(problem.prior)
        return Believing(greedy_policy(one, "baseline", self.memory_gib, INSTEAD), one_type)


@checks("solver")
@dataclass(frozen=True)
class Conformant:
    """Explain costs C_inexp Σ_t Σ_i (1 − P[t, i, H]): the sum over all user types, neither weighed
    by a belief nor divided by M (the paper's user study; docs/choices.md, slip 3).

    Args:
        memory_gib: most that the tables [steps, 2^messages] may take.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        # M types' costs are M times the cost of the mean labeler.
        summed = replace(
            problem.mixture(np.full(problem.n_types, 1 / problem.n_types)),
            inexplicability_cost=problem.inexplicability_cost * problem.n_user_types,
        )
        return Believing(greedy_policy(summed, "conformant", self.memory_gib, INSTEAD), one_type)


@checks("solver")
@dataclass(frozen=True)
class KnownType:
    """Knows the type: the oracle, or with true labels the clairvoyant.

    Args:
        knows: "type" or "labels"; the experiment hands over the problem that goes with it.
        memory_gib: most that the tables [steps, 2^messages, types] may take.
    """

    knows: Literal["type", "labels"] = "type"
    memory_gib: Positive = 8.0

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Its policy of a problem with several types asks for a belief that names one."""
        what = f"knowing the {self.knows}"
        return Believing(greedy_policy(problem, what, self.memory_gib, INSTEAD), named_type)


@dataclass(frozen=True)
class Believing:
    """A policy that is handed another belief than the one held.

    Attributes:
        policy: that decides.
        belief_of: what it is handed.
    """

    policy: Policy
    belief_of: Callable[[NDArray[np.float64]], NDArray[np.float64]]

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says."""
        return self.policy.messages(step, given, self.belief_of(belief))

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """What the sets or messages to choose from are worth, as
        :class:`xplain.solvers.base.Policy` says."""
        return self.policy.values(step, given, self.belief_of(belief))


def one_type(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """That of a one-type policy in a world of several: the belief is not looked at."""
    return np.ones(1)


def named_type(belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """That of a policy that must be told the type. With a belief of 1 on it QMDP's value is the
    type's own optimal value.

    Raises:
        InputError: the belief leaves the type open.
    """
    if belief.max() < 1 - 1e-9:  # a sum of probabilities may be 1 but for rounding
        raise InputError("belief", belief.tolist(), "this solver is told the type: 1 on one")
    return belief
