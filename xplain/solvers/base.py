"""Solvers and their policies.

A *solver* plans for one :class:`~xplain.explanation.problem.Problem` and returns a *policy*. A
policy is a function of the visible state and the belief: equal arguments always give the same
action. So a decision can be replayed, evaluated exactly, and shown to a person with its reasons.
Policies with a random search draw from a stream that depends on the seed and these two arguments.
"""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from xplain.errors import TooLargeError
from xplain.explanation.actions import Action, AskQuestion, GiveMessages, VisibleState, give
from xplain.explanation.belief import round_belief
from xplain.explanation.problem import Problem

log = logging.getLogger(__name__)

GIB = 1 << 30
TIE = 1e-9
"""Values count as equal if their difference, relative to 1 + the absolute value, is smaller than
this."""

Knowledge = Literal["types", "everyone", "type", "labels"]
"""The knowledge that the planning agent may have of the user. The experiment makes the agent's
problem from this knowledge:

- ``types``: the learned user types and a prior over them (the paper's setting);
- ``everyone``: one labeler learned from everybody's labels (the paper's baseline);
- ``type``: the true type, and the labeler learned for it under perfect clustering (the oracle);
- ``labels``: the true type and its true labels (the clairvoyant).
"""


@runtime_checkable
class Policy(Protocol):
    """Decides what to do before the next *explain*."""

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses the action. After messages the next action is *explain*, without another call.
        After the answer to a question the policy decides again.

        Args:
            visible: the visible state.
            belief: [S] over hidden states, like ``Problem.start``.
        """

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the values behind the choice: the estimated discounted return for each next
        action. Larger is better. The result may be empty; some policies evaluate only single
        messages."""
        ...


@runtime_checkable
class Solver(Protocol):
    """Plans for a problem. All its options are set by its constructor and never change."""

    @property
    def knows(self) -> Knowledge:
        """The knowledge that the agent has of the user."""
        ...

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """Makes a policy for the problem.

        Raises:
            TooLargeError: the tables would not fit into memory; raised before they are allocated.
        """


@dataclass(frozen=True)
class PolicyValue:
    """The value of a policy at the start of the trace.

    Attributes:
        value: expected discounted return under the model (≤ 0).
        cost: expected undiscounted cost, λ · communication + inexplicability (≥ 0).
        value_is: "exact" or "simulated".
        value_se, cost_se: standard errors; 0 if exact.
        beliefs: number of beliefs at which the policy decided.
    """

    value: float
    cost: float
    value_is: Literal["exact", "simulated"]
    value_se: float
    cost_se: float
    beliefs: int


def best_of(sets: NDArray[np.int64], values: NDArray[np.float64]) -> int:
    """Chooses the set of messages with the largest value. If several sets have this value, the sets
    with fewest messages remain, and of these the set with the smallest bitmask is chosen."""
    first = values.argmax()
    best = values[first]
    equal = values >= best - TIE * (1 + abs(best))
    if np.count_nonzero(equal) == 1:
        return int(sets[first])
    tied = sets[equal]
    size = np.bitwise_count(tied)
    return int(tied[size == size.min()].min())


def messages_of(action: Action) -> int:
    """Returns the bitmask of the messages that an action gives: 0 for *explain* and for
    questions."""
    return action.messages if isinstance(action, GiveMessages) else 0


def best_action(values: Mapping[Action, float]) -> Action:
    """Returns the action with the largest value. A question is chosen only if its value is larger
    than the values of *explain* and of all sets of messages. Of several questions with the largest
    value, the first is chosen; of several sets of messages, the set of :func:`best_of`."""
    asked = {a.question: v for a, v in values.items() if isinstance(a, AskQuestion)}
    said = {messages_of(a): v for a, v in values.items() if not isinstance(a, AskQuestion)}
    most, best = max(said.values()), max(asked.values(), default=-np.inf)
    if best > most + TIE * (1 + abs(most)):
        return AskQuestion(
            min(q for q, value in asked.items() if value >= best - TIE * (1 + abs(best)))
        )
    return give(best_of(np.array(list(said)), np.array(list(said.values()))))


class CachedPolicy:
    """A policy with a cache of its decisions. Users with equal answers lead to the same decisions,
    and a search is slow. The time of each decision is cached too, so that cached decisions do not
    seem fast.

    Attributes:
        policy: the policy that decides.
        seconds: time that the policy took for the last decision.
        decisions: action and seconds, by visible state and rounded belief.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.seconds = 0.0
        self.decisions: dict[tuple[VisibleState, bytes], tuple[Action, float]] = {}

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Returns the cached action, or calls the policy. The policy receives the rounded belief,
        so beliefs that differ only by rounding give the same action."""
        belief = round_belief(belief)
        key = visible, belief.tobytes()
        if key not in self.decisions:
            before = time.perf_counter()
            action = self.policy.decide(visible, belief)
            self.decisions[key] = action, time.perf_counter() - before
        action, self.seconds = self.decisions[key]
        return action

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the values of the policy that decides."""
        return self.policy.values(visible, belief)


class LazyPolicy:
    """A policy that is planned at its first decision. So a trace that grows by ten transitions
    before the next decision is planned once.

    Args:
        plan: makes the policy.
    """

    def __init__(self, plan: Callable[[], Policy]) -> None:
        self._policy = cache(plan)

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """Chooses the planned policy's action."""
        return self._policy().decide(visible, belief)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Returns the planned policy's values."""
        return self._policy().values(visible, belief)


def check_memory(what: str, size: int, limit_gib: float, instead: str) -> None:
    """Refuses tables that are too large before they are allocated, and logs large ones.

    Args:
        what: name of the solver.
        size: bytes.
        limit_gib: the solver's ``memory_gib``.
        instead: advice for the user.

    Raises:
        TooLargeError: more than the limit.
    """
    if size > limit_gib * GIB:
        raise TooLargeError(
            f"{what} needs {size / GIB:.2f} GiB for its tables, more than "
            f"solver.memory_gib={limit_gib:g}: {instead}"
        )
    if size > GIB / 4:
        log.info("%s takes %.2f GiB for its tables", what, size / GIB)
