"""QMDP: act as if the type became known after the next action.

Q(b, a) = Σ_t b(t) Q*_t(k, H, a), Q*_t by exact dynamic programming (Littman, Cassandra &
Kaelbling 1995; the paper, "Myopic Approximation: QMDP"). Never asks for a label's sake; its value
bounds the optimum from above.
"""

from __future__ import annotations

from dataclasses import dataclass

from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy
from xplain.solvers.dynamic_programming import check_memory_gib, greedy_policy


@dataclass(frozen=True)
class QMDP:
    """Args:
    memory_gib: most that the tables [steps, 2^messages, types] may take.
    """

    memory_gib: float = 8.0
    knows: Knowledge = "types"

    def __post_init__(self) -> None:
        """Raises InputError."""
        check_memory_gib(self.memory_gib)

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """See :class:`xplain.solvers.base.Solver`."""
        return greedy_policy(problem, "qmdp", self.memory_gib, "qhr plans without tables")
