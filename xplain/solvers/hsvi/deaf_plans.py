"""Plans that heed no answer, where messages may be missed or forgotten: lower bounds, linear in the
belief."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xplain.explanation import knowledge
from xplain.explanation.belief import told
from xplain.explanation.message_sets import indices
from xplain.solvers.knowing import Knowing
from xplain.solvers.reminding import Reminding


class DeafPlans:
    """For each type what QMDP would say to it if it knew the type alone; and silence."""

    def __init__(self, policy: Reminding, model: Knowing) -> None:
        self.policy, self.problem, self.model = policy, policy.problem, model
        self._together: dict[tuple[int, int], NDArray[np.float64]] = {}
        self._worths: dict[tuple[int, int, int], NDArray[np.float64]] = {}

    def worths(self, step: int, given: int) -> NDArray[np.float64]:
        """[U, S] what the plans are worth from a step on."""
        if (step, given) not in self._together:
            plans = range(len(self._schedules))
            self._together[step, given] = np.array([self._plan(u, step, given) for u in plans])
        return self._together[step, given]

    def _plan(self, u: int, step: int, given: int) -> NDArray[np.float64]:
        """[S] what is left of a plan is worth; it leaves out what may not be said any more."""
        model, problem, types = self.model, self.problem, self.problem.n_types
        if step == problem.n_steps:
            return np.zeros(problem.start.size)
        if (u, step, given) not in self._worths:
            said = self._schedules[u][step]
            after = 0
            later = knowledge.expected_after_forgetting(
                self._plan(u, step + 1, after).reshape(-1, types),
                problem.table.relevant,
                problem.forget,
            )
            value = model.discount * later - model.explain_cost[step].reshape(-1, types)
            prices = problem.prices
            for j in sorted(indices(said), key=lambda j: -prices[j]):
                landed = knowledge.with_message(value, problem.table.relevant, j)
                heard = problem.accept * landed + (1 - problem.accept) * value
                value = model.message_discount * heard - prices[j]
            self._worths[u, step, given] = value.ravel()
        return self._worths[u, step, given]

    @cached_property
    def _schedules(self) -> list[list[int]]:
        """What each plan says, step by step."""
        types = range(self.problem.n_types)
        return [*map(self._schedule, types), [0] * self.problem.n_steps]

    def _schedule(self, t: int) -> list[int]:
        """What QMDP says to a user of a type, step by step, if nothing is heard of them."""
        problem, schedule, given = self.problem, list[int](), 0
        belief = np.zeros((problem.table.p.shape[1], problem.n_types))
        belief[0, t] = 1
        for k in range(problem.n_steps):
            said = self.policy.messages(k, given, belief.ravel())
            given |= said
            belief = told(problem, belief.ravel(), said).reshape(belief.shape)
            belief = knowledge.forget(belief, problem.table.relevant, problem.forget)
            schedule.append(said)
        return schedule
