"""QMDP where messages may be missed or forgotten: say it again when that is worth its price.

Act as if the type and what the user knows became known after the next action. With both known, the
optimum is that of an MDP on (k, K), K the facts that the user has right:

    Q_t(k, K, explain) = −C_t(k, K) + γ E[V_t(k + 1, K')],        K' what is not forgotten of K
    Q_t(k, K, say j)   = −λ C_e(j) + γ' (α V_t(k, K ∪ {j}) + (1 − α) V_t(k, K)),

and a message that was not taken in is said again at once, so that V solves its own equation. A
decision says a message at most once a step; between its messages the belief changes, as each is
likely to have been taken in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xplain.explanation import knowledge
from xplain.explanation.belief import told
from xplain.explanation.problem import Problem
from xplain.solvers.memory import check_memory
from xplain.solvers.model import best_of, table_bytes


def reminding_policy(problem: Problem, what: str, memory_gib: float) -> Reminding:
    """QMDP's policy of a problem that tracks what users know.

    Raises:
        TooLargeError: its tables would take more than ``memory_gib``.
    """
    check_memory(what, 3 * table_bytes(problem), memory_gib, "fewer messages or habits fit")
    return Reminding(problem)


@dataclass(frozen=True)
class Reminding:
    """Gives the message with the largest Σ b(t, K) Q_t(k, K, a), each at most once a step, until
    *explain* is the best action."""

    problem: Problem

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, some of them perhaps again."""
        said = 0
        while True:
            sets, values = self._values(step, said, belief)
            new = best_of(sets, values)
            if not new:
                return said
            said |= new
            belief = told(self.problem, belief, new)

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Of *explain* (0) and of each message (its bit)."""
        sets, values = self._values(step, 0, belief)
        return dict(zip(sets.tolist(), values.tolist(), strict=True))

    def _values(
        self, step: int, said: int, belief: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        problem, flat = self.problem, belief.ravel()
        optimal, explain = self.optimal, self.explain
        free = [j for j in self._effective if not said >> j & 1]
        values = [flat @ explain[step].ravel()]
        for j in free:
            landed = knowledge.with_message(optimal[step], problem.table.relevant, j)
            later = self._accept * landed + (1 - self._accept) * optimal[step]
            price = problem.trade_off * float(problem.message_cost[j])
            values.append(self._delay * (flat @ later.ravel()) - price)
        return np.array([0, *(1 << j for j in free)]), np.array(values)

    @cached_property
    def optimal(self) -> NDArray[np.float64]:
        """[m + 1, rows, N] V_t(k, K), or a little above it where messages discount."""
        return self._solved[0]

    @cached_property
    def explain(self) -> NDArray[np.float64]:
        """[m, rows, N] Q_t(k, K, explain)."""
        return self._solved[1]

    @cached_property
    def _effective(self) -> tuple[int, ...]:
        return self.problem.messages_with_effect()

    @cached_property
    def _accept(self) -> NDArray[np.float64]:
        return self.problem.accept

    @property
    def _delay(self) -> float:
        """γ'."""
        return self.problem.discount if self.problem.discount_per == "action" else 1.0

    @cached_property
    def _solved(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        problem, table = self.problem, self.problem.table
        steps, rows, types = table.p.shape
        costs = problem.inexplicability_cost * np.cumsum(1 - table.p, axis=0)
        price = problem.trade_off * problem.message_cost
        optimal, explain = np.zeros((steps + 1, rows, types)), np.empty((steps, rows, types))
        bits = list(knowledge.each_bit(table.relevant))
        again = 1 - self._delay * (1 - self._accept)
        for k in reversed(range(steps)):
            later = knowledge.expected_after_forgetting(
                optimal[k + 1], table.relevant, problem.forget
            )
            explain[k] = problem.discount * later - costs[k]
            optimal[k] = explain[k]
            # One round for each message of a set that is said, whatever their order.
            for _ in range(table.relevant.shape[1]):
                for bit, j, own in bits:
                    pairs = optimal[k].reshape(rows >> bit + 1, 2, 1 << bit, types)
                    said = (self._delay * self._accept * pairs[:, 1] - price[j]) / again
                    better = np.where(own, said, -np.inf)
                    np.maximum(pairs[:, 0], better, out=pairs[:, 0])
        return optimal, explain
