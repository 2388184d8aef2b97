"""How good can a policy be, and how good is this one: what every run reports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from xplain.errors import TooLargeError
from xplain.explanation.label_table import MAX_RELEVANT
from xplain.explanation.problem import Problem
from xplain.solvers.hsvi.explore import Effort, explore
from xplain.solvers.hsvi.search import Start
from xplain.solvers.hsvi.solver import Certified, tables_within
from xplain.solvers.lookahead import Lookahead, best_plan_value
from xplain.solvers.memory import check_memory
from xplain.solvers.model import model_of, optimal_values, table_bytes, take
from xplain.solvers.restriction import restricted


@dataclass(frozen=True)
class Bounds:
    """All are expected discounted returns under the model, from the start of the trace.

    Attributes:
        lower, upper: the optimal value lies between them.
        known_type: Σ_t prior(t) V*_t, the value if the type were told at the start, with the same
            messages as actions; where messages may be missed or forgotten, if after each action
            the user's knowledge were told, too.
    """

    lower: float
    upper: float
    known_type: float

    @property
    def value_of_perfect_information(self) -> tuple[float, float]:
        """Expected value of perfect information: what being told the type at the start is worth,
        ``known_type`` minus the optimum. At least, at most."""
        return max(self.known_type - self.upper, 0.0), max(self.known_type - self.lower, 0.0)

    def suboptimality(self, value: float) -> tuple[float, float]:
        """The optimum minus a policy's value: at least, at most. The value itself is a lower
        bound on the optimum where it is exact."""
        return max(self.lower - value, 0.0), max(self.upper - value, 0.0)


DEARER = 5
"""A belief over what users know takes so many times as long: so many times fewer are opened."""
DEFAULT = Effort(gap=1e-3, nodes=2_000, memory_gib=2.0)
"""Some tenths of a second at most for a trace."""


def bounds(
    problem: Problem, effort: Effort = DEFAULT, told: Callable[[float], None] | None = None
) -> Bounds:
    """Certified bounds of the optimal value: by HSVI; where its tables would take more than the
    effort's memory by one step of lookahead; where messages are too many for that too, from
    above by known types and from below by plans that heed no answer.

    Args:
        problem: from the start of the trace.
        effort: when the search may stop.
        told: hears the gap now and then while HSVI searches.

    Raises:
        TooLargeError: not even the tables of known types fit.
    """
    if problem.tracks_knowledge:
        nodes = -(-effort.nodes // DEARER)
        seconds = effort.seconds if np.isfinite(effort.seconds) else None
        solver = Certified(effort.gap, nodes, seconds, memory_gib=effort.memory_gib)
        searched = solver.plan_knowing(problem)
        known = float(problem.start @ searched.bounded.policy.known(0, 0))
        return Bounds(float(searched.lower), float(searched.upper), known)
    small, kept = restricted(problem)
    if len(kept) > MAX_RELEVANT:
        return _simple_bounds(small, effort.memory_gib)
    try:
        small, tables = tables_within(small, effort.memory_gib)
    except TooLargeError:
        lookahead = Lookahead(memory_gib=effort.memory_gib).plan_messages(small)
        known = float(small.prior @ lookahead.policy.tables.optimal[0, 0])
        # What is asked may tell everything.
        upper = known if small.questions else lookahead.upper
        return Bounds(lookahead.lower, upper, known)
    found = explore(tables, Start(0, 0, small.prior), effort, told)
    known = float(small.prior @ tables.optimal[0, 0])
    return Bounds(found.lower, found.upper, known)


def _simple_bounds(small: Problem, memory_gib: float) -> Bounds:
    check_memory("knowing the type", table_bytes(small), memory_gib, "no other solver can")
    model = model_of(small)
    optimal = optimal_values(model)
    # A message for the sake of others puts off what a type costs, if it is cheap enough.
    idle = (1 << np.arange(small.n_messages)[:, None] & ~model.rows.relevant) != 0
    ahead = -optimal.min(axis=(0, 1))
    delays = (idle & (model.price[:, None] < (1 - model.message_discount) * ahead)).sum(axis=0)
    known = float(small.prior @ (model.message_discount**delays * take(model, optimal[0], 0)))
    return Bounds(min(best_plan_value(model, optimal, small.prior), known), known, known)


def known_type_value(problem: Problem, memory_gib: float = 8.0) -> float:
    """Σ_t prior(t) V*_t: what the policy earns that is told the type at the start, and gives only
    messages with an effect on it.

    Raises:
        TooLargeError: the tables take more than ``memory_gib``.
    """
    small, _ = restricted(problem)
    check_memory("knowing the type", table_bytes(small), memory_gib, "no other solver can")
    model = model_of(small)
    return float(np.dot(small.prior, take(model, optimal_values(model)[0], 0)))
