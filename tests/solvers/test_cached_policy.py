"""A cached policy decides like the policy, in any order of decisions."""

from __future__ import annotations

import numpy as np
import pytest

from tests.decisions import messages_given, worths
from xplain.explanation.problem import Problem
from xplain.solvers.base import CachedPolicy
from xplain.solvers.pomcp import POMCP


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
