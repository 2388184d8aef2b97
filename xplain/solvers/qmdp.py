"""QMDP: act as if the type became known after the next action.

Q(b, a) = Σ_t b(t) Q*_t(k, H, a), Q*_t by exact dynamic programming (Littman, Cassandra &
Kaelbling 1995; the paper, "Myopic Approximation: QMDP"). Never asks for a label's sake. A known
type is given only messages with an effect on it: its values bound the optimum from above where
messages given for the sake of others put off no costs (``discount_per=step``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Positive, checks
from xplain.explanation.problem import Problem
from xplain.solvers.base import Knowledge, Policy
from xplain.solvers.memory import check_memory
from xplain.solvers.model import (
    Model,
    best_of,
    model_of,
    one_by_one,
    optimal_values,
    table_bytes,
)
from xplain.solvers.reminding import reminding_policy
from xplain.solvers.restriction import Restricted
from xplain.solvers.rows import rows_at
from xplain.solvers.value_of_information import asks_by_value


@checks("solver")
@dataclass(frozen=True)
class QMDP:
    """Args:
    memory_gib: most that the tables [steps, 2^messages, types] may take.
    """

    memory_gib: Positive = 8.0
    knows: Knowledge = "types"

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Plans the whole explanation, as :class:`xplain.solvers.base.Solver` says."""
        policy = greedy_policy(problem, "qmdp", self.memory_gib, "qhr plans without tables")
        return asks_by_value(policy, problem, seed, self.memory_gib)


@dataclass(frozen=True)
class Greedy:
    """Gives the message with the largest Σ_t b(t) Q*_t(k, H, a), again and again, until
    *explain* is the best action. A message that changes nothing for a type with belief is none.

    Attributes:
        model: of N types.
        optimal: [m + 1, rows, N] V*_t(k, H).
    """

    model: Model
    optimal: NDArray[np.float64]

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, as
        :class:`xplain.solvers.base.Policy` says."""
        return one_by_one(
            lambda shown: best_of(self._actions, self._values(step, shown, belief)), given
        )

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Σ_t b(t) Q*_t(k, H, a) of *explain* (0) and of each message (its bit)."""
        values = self._values(step, given, belief).tolist()
        actions = zip(self._actions.tolist(), values, strict=True)
        return {action: value for action, value in actions if value > -np.inf}

    @cached_property
    def _actions(self) -> NDArray[np.int64]:
        """[n + 1] *explain*, then the messages."""
        return np.array([0, *(1 << j for j in range(len(self.model.price)))])

    @cached_property
    def _types(self) -> NDArray[np.int64]:
        """[N] a type's column."""
        return np.arange(self.model.n_types)

    def _values(self, step: int, given: int, belief: NDArray[np.float64]) -> NDArray[np.float64]:
        """[n + 1] values of the actions; −inf of messages given, or without effect."""
        model = self.model
        cells = rows_at(model.rows, given | self._actions) * model.n_types + self._types
        later = self.optimal[step + 1].reshape(-1).take(cells[0])
        p = model.p.reshape(model.n_steps, -1)[: step + 1].take(cells[0], axis=1)
        zeros = step + 1 - np.add.reduce(p)
        values: NDArray[np.float64] = model.message_discount * (
            self.optimal[step].reshape(-1).take(cells) @ belief
        )
        values[1:] -= model.price
        values[0] = belief @ (model.discount * later - model.inexplicability * zeros)
        matters = np.bitwise_or.reduce(model.rows.relevant[belief > 0])
        values[(self._actions & given != 0) | (self._actions & ~matters != 0)] = -np.inf
        return values


def greedy_policy(problem: Problem, what: str, memory_gib: float, instead: str) -> Policy:
    """The greedy policy, planned with the messages that have an effect.

    Raises:
        TooLargeError: its tables would take more than ``memory_gib``.
    """
    if problem.tracks_knowledge:
        return reminding_policy(problem, what, memory_gib)
    kept = problem.messages_with_effect
    small = problem.with_messages(kept)
    if len(kept) <= small.table.relevant.shape[1]:
        small = small.dense()  # no larger than a type's own table
    check_memory(what, table_bytes(small), memory_gib, instead)
    model = model_of(small)
    return Restricted(Greedy(model, optimal_values(model)), kept)
