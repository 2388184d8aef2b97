"""What a solver and its policy are.

A *solver* plans for one :class:`~xplain.explanation.problem.Problem` and returns a *policy*. A
policy is a function of (step, given, belief): the same three give the same messages, always, so
that a decision can be replayed, evaluated exactly, and shown to a person with its reasons.
Policies that search at random draw from a stream made of the seed and those three.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.asking import NO_QUESTION
from xplain.explanation.problem import Problem

TIE = 1e-9
"""Values closer than this, relative to 1 + their size, are equal."""

Knowledge = Literal["types", "everyone", "type", "labels"]
"""What the agent that plans may know of the user (the experiment builds its problem from it):

- ``types``: the learned user types and a prior over them (the paper's setting);
- ``everyone``: one labeler learned from everybody's labels (the paper's baseline);
- ``type``: the true type, and the labeler learned for it under perfect clustering (the oracle);
- ``labels``: the true type and its true labels (the clairvoyant).
"""


@runtime_checkable
class Policy(Protocol):
    """Which messages to give before the next *explain*."""

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The new messages to give before showing the prefix of ``step + 1`` transitions.

        Args:
            step: k, transitions shown so far, 0 … m − 1.
            given: bitmask of the messages given so far.
            belief: [N] over the problem's types.

        Returns:
            A bitmask disjoint from ``given``; 0 means *explain* at once.
        """
        ...

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """The values behind the choice: estimated discounted return by the message set
        given next (bitmask; 0 is *explain* at once). Larger is better. May be empty."""
        ...


@runtime_checkable
class Asks(Policy, Protocol):
    """A policy of a problem with questions.

    ``asked`` is a bitmask of the questions asked so far, or of which no news is to be had.
    """

    def messages(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """As :meth:`Policy.messages`, when nothing is asked any more before this step."""
        ...

    def values(
        self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0
    ) -> Mapping[int, float]:
        """As :meth:`Policy.values`, by ``~q`` for question q as well."""
        ...

    def question(self, step: int, given: int, belief: NDArray[np.float64], asked: int = 0) -> int:
        """What to ask before this step's messages: a question's number, or NO_QUESTION."""
        ...


def asking(policy: Policy) -> Asks:
    """The policy as one that asks.

    Raises:
        InputError: it does not.
    """
    if not isinstance(policy, Asks):
        wanted = "one that asks, as qmdp, pomcp and certified do; or ask=never"
        raise InputError("solver", type(policy).__name__, wanted)
    return policy


def best_question(values: Mapping[int, float]) -> int:
    """Of :meth:`Asks.values` the question worth the most, NO_QUESTION where messages are worth as
    much; of equals the first."""
    said = max(value for action, value in values.items() if action >= 0)
    asked = {~action: value for action, value in values.items() if action < 0}
    best = max(asked.values(), default=-np.inf)
    if best <= said + TIE * (1 + abs(said)):
        return NO_QUESTION
    return min(q for q, value in asked.items() if value >= best - TIE * (1 + abs(best)))


@runtime_checkable
class Solver(Protocol):
    """Plans for a problem. Configured by its constructor; holds no state of a run."""

    @property
    def knows(self) -> Knowledge:
        """What the agent may know of the user."""
        ...

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        """A policy for the problem.

        Raises:
            TooLargeError: the tables would not fit; raised before memory is taken.
        """
        ...


@dataclass(frozen=True)
class PolicyValue:
    """The worth of a policy from the start of the trace.

    Attributes:
        value: expected discounted return under the model (≤ 0).
        cost: expected undiscounted cost, λ · communication + inexplicability (≥ 0).
        value_is: "exact" or "simulated".
        value_se, cost_se: standard errors; 0 where exact.
        beliefs: how many beliefs the policy was asked about.
    """

    value: float
    cost: float
    value_is: Literal["exact", "simulated"]
    value_se: float
    cost_se: float
    beliefs: int
