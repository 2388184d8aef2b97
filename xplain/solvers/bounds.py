"""Bounds of the optimal value, for certificates and for the command ``plan``."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.actions import VisibleState
from xplain.explanation.problem import Problem
from xplain.solvers.base import check_memory, messages_of
from xplain.solvers.greedy import Greedy
from xplain.solvers.hsvi import Effort, search
from xplain.solvers.process import (
    KnownValues,
    Process,
    known_bytes,
    known_values,
    make_process,
    set_prices,
)


@dataclass(frozen=True)
class Bounds:
    """Expected discounted returns under the model, from the start of the trace.

    Attributes:
        lower, upper: bounds of the optimal value.
        known_type: Σ_t prior(t) V*_t, the value if the type were known at the start. Messages
            without effect on the known type may also be given. If messages may be missed or
            forgotten, the user's knowledge after each action would be known, too.
    """

    lower: float
    upper: float
    known_type: float

    @property
    def value_of_perfect_information(self) -> tuple[float, float]:
        """Expected value of perfect information about the type at the start: ``known_type`` minus
        the optimum, as (lower, upper) bounds."""
        return max(self.known_type - self.upper, 0.0), max(self.known_type - self.lower, 0.0)

    def suboptimality(self, value: float) -> tuple[float, float]:
        """Computes the optimum minus a policy's value, as (lower, upper) bounds. The exact value of
        a policy is also a lower bound of the optimum."""
        return max(self.lower - value, 0.0), max(self.upper - value, 0.0)


DEFAULT = Effort(gap=1e-3, nodes=2_000, memory_gib=2.0)
"""This effort takes at most some tenths of a second for a trace."""


def bounds(
    problem: Problem, effort: Effort = DEFAULT, told: Callable[[float], None] | None = None
) -> Bounds:
    """Computes certified bounds of the optimal value by HSVI. If its tables exceed the effort's
    memory, or there are too many messages, the upper bound is the value of known types. The lower
    bound is then the best value of a plan that ignores answers.

    Args:
        problem: any problem; the bounds are for the start of its trace.
        effort: when the search may stop.
        told: is called regularly with the gap while HSVI searches.

    Raises:
        TooLargeError: not even the tables of known types fit.
    """
    try:
        found = search(problem, effort, told)
    except TooLargeError:
        if not problem.messages_land:
            raise
        return _compute_simple_bounds(problem, effort.memory_gib)
    start = problem.start
    known = float(start @ found.tables.model.value[0, : start.size])
    return Bounds(found.lower, found.upper, known)


def _compute_simple_bounds(problem: Problem, memory_gib: float) -> Bounds:
    check_memory("knowing the type", known_bytes(problem), memory_gib, "no other solver can")
    process = make_process(problem)
    known = known_values(process)
    # Cheap messages for other types may delay the cost of a type.
    ineffective = (process.relevant >> np.arange(process.n_messages)[:, None] & 1) == 0
    saved = (1 - process.message_discount) * -known.value.min()
    delays = (ineffective & (process.price[:, None] < saved)).sum(axis=0)
    upper = float(process.start @ (process.message_discount**delays * known.now(0, 0)))
    return Bounds(min(best_plan_value(process, known), upper), upper, upper)


def best_plan_value(process: Process, known: KnownValues) -> float:
    """Computes the expected discounted return of the best plan that ignores all answers. The
    candidates are the optimal plan of each type, and the plan without messages."""
    greedy = Greedy(process, known)
    plans = [_plan_messages(greedy, sure) for sure in np.eye(process.n_states)[: process.n_types]]
    return max(_evaluate_plan(process, plan) for plan in [*plans, [0] * process.n_steps])


def _plan_messages(greedy: Greedy, belief: NDArray[np.float64]) -> list[int]:
    """Lists the message set of each step that the greedy policy gives if no answer changes the
    belief."""
    plan: list[int] = []
    for step in range(greedy.process.n_steps):
        plan.append(messages_of(greedy.decide(VisibleState(step, sum(plan)), belief)))
    return plan


def _evaluate_plan(process: Process, plan: list[int]) -> float:
    """Computes the expected discounted return of a plan: the message set to give at each step,
    whatever the answers are. The cheapest message of a set is given first."""
    given, value, discount = 0, 0.0, 1.0
    for step, new in enumerate(plan):
        given |= new
        prices, factors = set_prices(process, np.array([new]))
        cost = process.start @ process.explain_cost[step, process.cells.at(given)]
        value -= discount * float(prices[0] + factors[0] * cost)
        discount *= float(factors[0]) * process.discount
    return value


def known_type_value(problem: Problem, memory_gib: float = 8.0) -> float:
    """Computes Σ_t prior(t) V*_t: the value of a policy that knows the type at the start, and gives
    only messages with an effect on this type.

    Raises:
        TooLargeError: the tables exceed ``memory_gib``.
    """
    check_memory("knowing the type", known_bytes(problem), memory_gib, "no other solver can")
    process = make_process(problem)
    return float(process.start @ known_values(process).now(0, 0))
