"""One interaction: a policy explains a trace, step by step, to a user who answers.

docs/method.md, sections 5 and 7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.message_sets import indices
from xplain.sessions.interaction import Interaction
from xplain.solvers.base import Policy
from xplain.solvers.cached_policy import CachedPolicy


class User(Protocol):
    """Whoever the trace is explained to."""

    def labels(self, count: int, message_set: int) -> NDArray[np.uint8]:
        """Labels [count] of the first ``count`` transitions, all of ``message_set`` known."""
        ...


@dataclass(frozen=True)
class SimulatedUser:
    """Answers by the true labels of one user type.

    Attributes:
        table: of this type alone.
    """

    table: LabelTable

    @classmethod
    def of(cls, labels: ArrayLike) -> SimulatedUser:
        """Who labels as [m, 2^n] says."""
        return cls(LabelTable.dense(np.asarray(labels)[None]))

    def labels(self, count: int, message_set: int) -> NDArray[np.uint8]:
        """The type's true labels of the prefix."""
        labels: NDArray[np.uint8] = self.table.label_probabilities(count, message_set)[0].astype(
            np.uint8
        )
        return labels


@dataclass(frozen=True)
class Episode:
    """What happened while one trace of m transitions was explained.

    Attributes:
        messages: [m] int64, the new messages (bitmask) before each *explain*.
        labels: [m, m] int8, row k the labels given at step k; −1 right of the diagonal.
        beliefs: [m + 1, N], before the first step and after each.
        seconds: [m], time the policy took to decide, when it was first asked that.
        communication: Σ C_e of all messages given (not multiplied by λ).
        inexplicability: Σ C_inexp over every label 0 at every step.
        cost: Definition 2, λ · communication + inexplicability, undiscounted.
    """

    messages: NDArray[np.int64]
    labels: NDArray[np.int8]
    beliefs: NDArray[np.float64]
    seconds: NDArray[np.float64]
    communication: float
    inexplicability: float
    cost: float

    @property
    def n_messages(self) -> int:
        """Number of messages given over all steps."""
        return sum(int(mask).bit_count() for mask in self.messages)

    @property
    def n_inexplicable(self) -> int:
        """Number of labels 0 over all steps."""
        return int((self.labels == 0).sum())


def explain(problem: Problem, policy: Policy, user: User, belief_update: BeliefUpdate) -> Episode:
    """Explains the whole trace of ``problem`` to ``user``.

    Args:
        problem: what the agent believes of users; its costs are those that count.
        policy: planned for that problem; a cached one shares its decisions between users.
        user: who answers.
        belief_update: which labels change the belief.

    Raises:
        ValueError: the policy gives a message again, or one that does not exist.
    """
    m = problem.n_steps
    asked = policy if isinstance(policy, CachedPolicy) else CachedPolicy(policy)
    talk = Interaction(problem, asked, belief_update)
    messages = np.zeros(m, dtype=np.int64)
    labels = np.full((m, m), -1, dtype=np.int8)
    beliefs = np.empty((m + 1, problem.n_types))
    beliefs[0] = talk.belief
    seconds = np.empty(m)
    for k in range(m):
        messages[k] = talk.say()
        seconds[k] = asked.seconds
        answer = user.labels(k + 1, talk.given)
        labels[k, : k + 1] = answer
        talk.hear(answer)
        beliefs[k + 1] = talk.belief
    communication = float(sum(problem.message_cost[j] for j in indices(talk.given)))
    inexplicability = problem.inexplicability_cost * int((labels == 0).sum())
    cost = problem.trade_off * communication + inexplicability
    return Episode(messages, labels, beliefs, seconds, communication, inexplicability, cost)
