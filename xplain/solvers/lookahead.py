"""Lookahead: one step of expectimax over QMDP, for problems too large to be searched.

At a decision every set of messages is scored by QMDP; the best few are looked into: for each answer
that the user may give, the belief is updated and QMDP asked what is best *then*. So the policy asks
for the sake of the answer, which QMDP never does. Its scores bound the optimum from above.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, checks
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, kernel
from xplain.solvers.base import Knowledge, Policy
from xplain.solvers.count_lattice import branch, make_answers
from xplain.solvers.lookahead_knowing import LookaheadKnowing
from xplain.solvers.memory import check_memory
from xplain.solvers.model import (
    Model,
    SetPrices,
    best_set,
    dense_table_bytes,
    expected,
    explain_cost,
    explain_cost_at,
    model_of,
    optimal_values,
    set_prices,
    with_all_messages,
)
from xplain.solvers.qmdp import Greedy
from xplain.solvers.reminding import reminding_policy
from xplain.solvers.restriction import Restricted, coupled
from xplain.solvers.value_of_information import asks_by_value


@checks("solver")
@dataclass(frozen=True)
class Lookahead:
    """Args:
    candidates: sets of messages looked into at a decision.
    answers: most distinguishable answers followed for each; a set with more keeps its
        QMDP score.
    memory_gib: most that the tables [steps, 2^messages, types] may take.
    """

    candidates: Count = 16
    answers: Count = 4096
    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        if problem.tracks_knowledge:
            known = reminding_policy(problem, "lookahead", self.memory_gib)
            policy: Policy = LookaheadKnowing(known, self.candidates, self.answers)
        else:
            policy = self.plan_messages(problem)
        return asks_by_value(policy, problem, seed, self.memory_gib)

    def plan_messages(self, problem: Problem) -> LookaheadPolicy:
        """The same without questions, with bounds of the optimum."""
        small, kept = coupled(problem, "lookahead")
        check_memory(
            "lookahead", dense_table_bytes(small), self.memory_gib, "qhr plans without tables"
        )
        model = with_all_messages(model_of(small.dense()))
        tables = LookaheadTables(model, optimal_values(model), set_prices(model))
        return LookaheadPolicy(
            Expectimax(tables, self.candidates, self.answers), kept, problem.prior
        )


class LookaheadTables(NamedTuple):
    """What a decision reads.

    Attributes:
        model: the problem's.
        optimal: [m + 1, 2^n, N] V*_t(k, H).
        sets: prices and discounts of sets of messages.
    """

    model: Model
    optimal: NDArray[np.float64]
    sets: SetPrices


@dataclass(frozen=True)
class Expectimax:
    """One step of it, computed when asked.

    Attributes:
        tables: of N types.
        candidates, answers: as :class:`Lookahead` has them.
    """

    tables: LookaheadTables
    candidates: int
    answers: int

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says."""
        return best_set(self.values(step, given, belief))

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Upper bounds of the sets looked into."""
        return self.scores(step, given, belief)[0]

    def scores(
        self, step: int, given: int, belief: NDArray[np.float64]
    ) -> tuple[dict[int, float], float]:
        """Upper bounds of the sets looked into, and one that holds for all others."""
        model = self.tables.model
        matters = int(np.bitwise_or.reduce(model.rows.relevant[belief > 0]))
        sets, scores, rest = _look(
            self.tables,
            step,
            given,
            matters & ~given,
            belief.copy(),
            self.candidates,
            make_answers(self.answers, model.n_steps, model.n_types),
        )
        return dict(zip(sets.tolist(), scores.tolist(), strict=True)), float(rest)


@dataclass(frozen=True)
class LookaheadPolicy(Restricted):
    """A lookahead over the kept messages, with bounds of the optimal value at the root.

    Attributes:
        prior: [N] the root's belief.
    """

    policy: Expectimax
    prior: NDArray[np.float64]

    @property
    def upper(self) -> float:
        """The best score: an upper bound on the root's optimal value."""
        scores, rest = self.policy.scores(0, 0, self.prior)
        return max(rest, *scores.values())

    @property
    def lower(self) -> float:
        """Lower bound on the root's optimal value: the exact value of the best plan that heeds
        no answer, a type's optimal one or silence."""
        return best_plan_value(self.policy.tables.model, self.policy.tables.optimal, self.prior)


def best_plan_value(
    model: Model, optimal: NDArray[np.float64], prior: NDArray[np.float64]
) -> float:
    """Expected discounted return of the best plan that heeds no answer, a type's optimal one or
    silence."""
    greedy = Greedy(model, optimal)
    plans = [_plan(greedy, sure) for sure in np.eye(model.n_types)]
    plans.append([0] * model.n_steps)
    return max(_plan_value(model, prior, plan) for plan in plans)


def _plan(greedy: Greedy, belief: NDArray[np.float64]) -> list[int]:
    """The sets that the greedy policy gives if no answer changes the belief."""
    given, plan = 0, []
    for step in range(greedy.model.n_steps):
        plan.append(greedy.messages(step, given, belief))
        given |= plan[-1]
    return plan


def _plan_value(model: Model, prior: NDArray[np.float64], plan: list[int]) -> float:
    """Expected discounted return of giving these sets, the cheapest message first, whatever is
    answered."""
    given, value, discount = 0, 0.0, 1.0
    for step, new in enumerate(plan):
        given |= new
        for price in sorted(float(model.price[j]) for j in indices(new)):
            value -= discount * price
            discount *= model.message_discount
        value -= discount * float(prior @ explain_cost_at(model, step, given))
        discount *= model.discount
    return value


@kernel
def _look(tables, step, given, free, belief, candidates, answers):  # type: ignore[no-untyped-def]
    """The best sets of ``free`` messages by QMDP, their scores after a look at the answers, the
    best other score."""
    model, optimal = tables.model, tables.optimal
    scores = np.full(len(tables.sets.price), -np.inf)
    _score_by_qmdp(tables, step, given, free, belief, scores)
    count = 0
    sets = np.empty(candidates, dtype=np.int64)
    best = np.empty(candidates)
    evidence = np.zeros(len(belief), dtype=np.int64)
    while count < candidates:
        chosen = int(np.argmax(scores))
        if scores[chosen] == -np.inf:
            break
        sets[count], best[count] = chosen, scores[chosen]
        scores[chosen] = -np.inf
        shown = given | chosen
        if step + 2 < len(optimal):
            listed = branch(model, step, shown, belief, evidence, 1e-9, answers)
            if listed >= 0:
                later = expected(answers.tail, optimal[step + 1, shown])
                for a in range(listed):
                    later += _qmdp(tables, step + 1, shown, answers.weight[a])
                cost = 0.0
                for t in range(len(belief)):
                    if belief[t] > 0.0:
                        cost += belief[t] * explain_cost(model, step, shown, t)
                value = tables.sets.discount[chosen] * (model.discount * later - cost)
                best[count] = min(best[count], value - tables.sets.price[chosen])
        count += 1
    return sets[:count], best[:count], scores.max()


@inlined
def _score_by_qmdp(tables, step, given, free, belief, scores):  # type: ignore[no-untyped-def]
    """Fills in ``scores`` [2^n], Σ_t b(t) Q*_t of every set of ``free`` messages."""
    model = tables.model
    chosen = 0
    while True:
        shown = given | chosen
        value = 0.0
        for t in range(len(belief)):
            if belief[t] > 0.0:
                explain = model.discount * tables.optimal[step + 1, shown, t]
                value += belief[t] * (explain - explain_cost(model, step, shown, t))
        scores[chosen] = tables.sets.discount[chosen] * value - tables.sets.price[chosen]
        chosen = (chosen - free) & free
        if chosen == 0:
            return


@inlined
def _qmdp(tables, step, given, weight):  # type: ignore[no-untyped-def]
    """max_a Σ_t w(t) Q*_t(k, H, a), for a belief times its probability."""
    model = tables.model
    total, best = 0.0, 0.0
    for t in range(len(weight)):
        total += weight[t]
        explain = model.discount * tables.optimal[step + 1, given, t]
        best += weight[t] * (explain - explain_cost(model, step, given, t))
    for j in range(len(model.price)):
        more = given | (1 << j)
        if more != given:
            value = model.message_discount * expected(weight, tables.optimal[step, more])
            best = max(best, value - model.price[j] * total)
    return best
