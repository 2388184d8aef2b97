"""One interaction: a policy explains a trace, step by step, to a user who answers.

docs/method.md, sections 5 and 7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.evaluation.explainees import Person
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.problem import Problem
from xplain.message_sets import indices
from xplain.sessions.interaction import Interaction
from xplain.solvers.base import Policy
from xplain.solvers.cached_policy import CachedPolicy


@dataclass(frozen=True)
class Episode:
    """What happened while one trace of m transitions was explained.

    Attributes:
        messages: [m] int64, the new messages (bitmask) before each *explain*.
        labels: [m, m] int8, row k the answers given at step k; −1 right of the diagonal.
        thoughts: [m, m] int8, row k the labels that the user truly holds; costs are by these.
        beliefs: [m + 1, M] over user types, before the first step and after each.
        seconds: [m], time the policy took to decide, when it was first asked that.
        communication: Σ C_e of all messages given (not multiplied by λ).
        inexplicability: Σ C_inexp over every transition found inexplicable at every step.
        cost: Definition 2, λ · communication + inexplicability, undiscounted.
    """

    messages: NDArray[np.int64]
    labels: NDArray[np.int8]
    thoughts: NDArray[np.int8]
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
        """Number of transitions found inexplicable, over all steps."""
        return int((self.thoughts == 0).sum())


def explain(problem: Problem, policy: Policy, user: Person, belief_update: BeliefUpdate) -> Episode:
    """Explains the whole trace of ``problem`` to ``user``.

    Args:
        problem: what the agent believes of users; its costs are those that count.
        policy: planned for that problem; a cached one shares its decisions between users.
        user: who reacts; new to the trace.
        belief_update: which labels change the belief.

    Raises:
        ValueError: the policy gives a message again, or one that does not exist.
    """
    m = problem.n_steps
    asked = policy if isinstance(policy, CachedPolicy) else CachedPolicy(policy)
    talk = Interaction(problem, asked, belief_update)
    messages = np.zeros(m, dtype=np.int64)
    labels, thoughts = np.full((2, m, m), -1, dtype=np.int8)
    beliefs = np.empty((m + 1, problem.n_user_types))
    beliefs[0] = problem.type_belief(talk.belief)
    seconds = np.empty(m)
    for k in range(m):
        messages[k] = talk.say()
        seconds[k] = asked.seconds
        thought, answer = user.react(talk.given, int(messages[k]), k + 1)
        thoughts[k, : k + 1], labels[k, : k + 1] = thought, answer
        talk.hear(answer)
        beliefs[k + 1] = problem.type_belief(talk.belief)
    communication = float(sum(problem.message_cost[j] for j in indices(talk.given)))
    inexplicability = problem.inexplicability_cost * int((thoughts == 0).sum())
    cost = problem.trade_off * communication + inexplicability
    return Episode(
        messages, labels, thoughts, beliefs, seconds, communication, inexplicability, cost
    )
