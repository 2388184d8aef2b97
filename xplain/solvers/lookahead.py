"""Lookahead: one step of expectimax over QMDP, for problems too large to be searched.

At a decision every set of messages is scored by QMDP; the best few are looked into: for each answer
that the user may give, the belief is updated and QMDP asked what is best *then*. So the policy asks
for the sake of the answer, which QMDP never does. Its scores bound the optimum from above.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, kernel
from xplain.solvers.base import Knowledge
from xplain.solvers.count_lattice import branch, make_room
from xplain.solvers.dynamic_programming import (
    Greedy,
    Restricted,
    best_set,
    check_memory,
    check_memory_gib,
    message_discount,
    message_price,
    messages_worth_giving,
    optimal_values,
    restrict,
    table_bytes,
)
from xplain.solvers.hsvi.initial_bounds import set_prices


@dataclass(frozen=True)
class Lookahead:
    """Args:
    candidates: sets of messages looked into at a decision.
    answers: most distinguishable answers followed for each; a set with more keeps its
        QMDP score.
    memory_gib: most that the tables [steps, 2^messages, types] may take.
    """

    candidates: int = 16
    answers: int = 4096
    memory_gib: float = 8.0
    knows: Knowledge = "types"

    def __post_init__(self) -> None:
        """Raises InputError."""
        for key in ("candidates", "answers"):
            if not getattr(self, key) >= 1:
                raise InputError(f"solver.{key}", getattr(self, key), "a number ≥ 1")
        check_memory_gib(self.memory_gib)

    def plan(self, problem: Problem, seed: int = 0) -> LookaheadPolicy:
        """See :class:`xplain.solvers.base.Solver`."""
        kept = messages_worth_giving(problem)
        small = restrict(problem, kept)
        check_memory("lookahead", table_bytes(small), self.memory_gib, "qhr plans without tables")
        looking = Looking(
            small, optimal_values(small), *set_prices(small), self.candidates, self.answers
        )
        return LookaheadPolicy(looking, kept)


@dataclass(frozen=True)
class Looking:
    """One step of expectimax, computed when asked."""

    problem: Problem
    table: NDArray[np.float64]
    price: NDArray[np.float64]
    factor: NDArray[np.float64]
    candidates: int
    answers: int

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """See :class:`xplain.solvers.base.Policy`."""
        return best_set(self.values(step, given, belief))

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Upper bounds of the sets looked into."""
        return self.scores(step, given, belief)[0]

    def scores(
        self, step: int, given: int, belief: NDArray[np.float64]
    ) -> tuple[dict[int, float], float]:
        """Upper bounds of the sets looked into, and one that holds for all others."""
        problem = self.problem
        sets, scores, rest = _look(
            problem.p_explicable,
            self.table,
            self.price,
            self.factor,
            message_price(problem),
            problem.inexplicability_cost,
            problem.discount,
            message_discount(problem),
            step,
            given,
            belief,
            self.candidates,
            np.empty((self.answers, problem.n_types)),
            np.empty((self.answers, problem.n_types), dtype=np.int64),
            make_room(problem.n_steps, problem.n_types),
        )
        return dict(zip(sets.tolist(), scores.tolist(), strict=True)), float(rest)


@dataclass(frozen=True)
class LookaheadPolicy(Restricted):
    """A lookahead over the kept messages, with bounds of the optimal value at the root."""

    policy: Looking

    @property
    def upper(self) -> float:
        """The best score."""
        scores, rest = self.policy.scores(0, 0, self.policy.problem.prior)
        return max(rest, *scores.values())

    @property
    def lower(self) -> float:
        """The exact value of the best plan that heeds no answer: a type's optimal one, or
        silence."""
        looking = self.policy
        problem = looking.problem
        greedy = Greedy(problem, looking.table)
        types = np.eye(problem.n_types)
        plans = [_plan(greedy, sure) for sure in types]
        plans.append([0] * problem.n_steps)
        return max(_plan_value(looking, plan) for plan in plans)


def _plan(greedy: Greedy, belief: NDArray[np.float64]) -> list[int]:
    """The sets that the greedy policy gives if no answer changes the belief."""
    given, plan = 0, []
    for step in range(greedy.problem.n_steps):
        plan.append(greedy.messages(step, given, belief))
        given |= plan[-1]
    return plan


def _plan_value(looking: Looking, plan: list[int]) -> float:
    problem = looking.problem
    given, value, factor = 0, 0.0, 1.0
    for step, new in enumerate(plan):
        given |= new
        value -= factor * float(looking.price[new])
        factor *= float(looking.factor[new])
        zeros = (1 - problem.p_explicable[:, : step + 1, given]).sum(axis=1)
        value -= factor * problem.inexplicability_cost * float(problem.prior @ zeros)
        factor *= problem.discount
    return value


@kernel
def _look(  # type: ignore[no-untyped-def]
    p,
    table,
    price,
    factor,
    message_price,
    inexplicability,
    discount,
    message_discount,
    step,
    given,
    belief,
    candidates,
    out_weight,
    out_evidence,
    room,
):
    """The best sets by QMDP, their scores after a look at the answers, the best other score."""
    free = (len(price) - 1) & ~given
    scores = np.full(len(price), -np.inf)
    costs = np.empty(len(price))
    chosen = 0
    while True:
        shown = given | chosen
        zeros, later = 0.0, 0.0
        for t in range(len(belief)):
            if belief[t] > 0.0:
                later += belief[t] * table[step + 1, shown, t]
                for i in range(step + 1):
                    zeros += belief[t] * (1.0 - p[t, i, shown])
        costs[chosen] = price[chosen] + factor[chosen] * inexplicability * zeros
        scores[chosen] = factor[chosen] * discount * later - costs[chosen]
        chosen = (chosen - free) & free
        if chosen == 0:
            break
    count = 0
    sets = np.empty(candidates, dtype=np.int64)
    best = np.empty(candidates)
    evidence = np.zeros(len(belief), dtype=np.int64)
    tail = np.empty(len(belief))
    while count < candidates:
        chosen = int(np.argmax(scores))
        if scores[chosen] == -np.inf:
            break
        sets[count], best[count] = chosen, scores[chosen]
        scores[chosen] = -np.inf
        shown = given | chosen
        if step + 1 < p.shape[1]:
            answers = branch(
                p, step, shown, belief, evidence, 1e-9, out_weight, out_evidence, tail, room
            )
            if answers >= 0:
                later = 0.0
                for t in range(len(belief)):
                    later += tail[t] * table[step + 1, shown, t]
                for a in range(answers):
                    later += _qmdp(
                        p,
                        table,
                        message_price,
                        inexplicability,
                        discount,
                        message_discount,
                        step + 1,
                        shown,
                        out_weight[a],
                    )
                best[count] = min(best[count], factor[chosen] * discount * later - costs[chosen])
        count += 1
    return sets[:count], best[:count], scores.max()


@inlined
def _qmdp(  # type: ignore[no-untyped-def]
    p,
    table,
    message_price,
    inexplicability,
    discount,
    message_discount,
    step,
    given,
    weight,
):
    """max_a Σ_t w(t) Q*_t(k, H, a), for a belief times its probability."""
    total, best = 0.0, 0.0
    for t in range(len(weight)):
        total += weight[t]
        zeros = 0.0
        for i in range(step + 1):
            zeros += 1.0 - p[t, i, given]
        best += weight[t] * (discount * table[step + 1, given, t] - inexplicability * zeros)
    for j in range(len(message_price)):
        more = given | (1 << j)
        if more != given:
            value = 0.0
            for t in range(len(weight)):
                value += weight[t] * table[step, more, t]
            best = max(best, message_discount * value - message_price[j] * total)
    return best
