"""A cached policy is asked once a question, and says how long that took."""

from __future__ import annotations

import time

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.decisions import messages_given, worths
from xplain.explanation.actions import EXPLAIN, Action, GiveMessages, VisibleState
from xplain.explanation.problem import Problem
from xplain.solvers.base import CachedPolicy
from xplain.solvers.pomcp import POMCP


class Slow:
    """Takes 20 ms, and counts the questions."""

    asked = 0

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        self.asked += 1
        time.sleep(0.02)
        return GiveMessages(1 << self.asked)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> dict[Action, float]:
        return {EXPLAIN: -1.0}


def test_the_same_question_is_asked_once() -> None:
    """Rounding makes no new question; another step, set or belief does. Time is the first's."""
    slow, belief = Slow(), np.array([0.3, 0.7])
    policy = CachedPolicy(slow)
    first = messages_given(policy, 1, 2, belief)
    took = policy.seconds
    assert took >= 0.02
    assert messages_given(policy, 1, 0, belief) != first
    assert messages_given(policy, 1, 2, belief + 1e-15) == first
    assert policy.seconds == took
    assert messages_given(policy, 0, 2, belief) != first
    assert messages_given(policy, 1, 2, belief[::-1]) != first
    assert slow.asked == 4
    assert worths(policy, 1, 2, belief) == {0: -1.0}


def test_what_was_asked_before_makes_no_difference() -> None:
    """Searches draw from a stream of their question: any order gives the same decisions, and they
    are those of the policy itself."""
    rng = np.random.default_rng(1)
    problem = Problem(rng.random((3, 5, 8)), np.ones(3), trade_off=0.3)
    questions = [(k, g, rng.dirichlet(np.ones(3))) for k in range(5) for g in (0, 3)]
    policy = POMCP(simulations=300).plan(problem, 7)
    forth, back = CachedPolicy(policy), CachedPolicy(policy)
    there = [messages_given(forth, *question) for question in questions]
    assert [messages_given(back, *question) for question in reversed(questions)] == there[::-1]
    assert [messages_given(policy, *question) for question in questions] == there
    step, given, belief = questions[0]
    apart = worths(policy, step, given, belief * (1 + 1e-15))
    assert apart == pytest.approx(worths(policy, step, given, belief), rel=1e-15)
