"""The literal POMDP, its reduction, and bounds of its optimum."""

import numpy as np
import pytest
from hypothesis import given, settings

from tests.explanation.problems import tiny_problems
from xplain.explanation.problem import Problem
from xplain.testing.literal_pomdp import (
    EXPLAIN,
    LiteralPOMDP,
    literal_optimal_value,
    reduced_optimal_value,
)


@settings(deadline=None, max_examples=60)
@given(tiny_problems())
def test_literal_and_reduced_agree(problem: Problem) -> None:
    literal = literal_optimal_value(problem)
    assert literal == pytest.approx(reduced_optimal_value(problem), abs=1e-9)


def test_a_worked_example() -> None:
    """There are two steps and one message with cost 1.2, without a discount. Type 0 needs the
    message, type 1 never does. The message at once costs 1.2. The labels of the first step show the
    type: type 0 pays 1 and then 1.2 for the second prefix (rather than 2), type 1 nothing: 0.5 ·
    2.2 = 1.1.
    """
    p = np.array([[[0, 1], [0, 1]], [[1, 1], [1, 1]]], dtype=float)
    problem = Problem(p, np.array([1.2]), discount=1.0)
    assert literal_optimal_value(problem) == pytest.approx(-1.1)


def test_messages_used_are_no_actions() -> None:
    p = np.tile([0.2, 0.4, 0.6, 0.8, 0.2, 0.4, 0.6, 0.8], (1, 2, 1))
    pomdp = LiteralPOMDP(Problem(p, np.zeros(3)))  # the last changes nothing
    (start,) = pomdp.initial()
    assert pomdp.actions(start) == [EXPLAIN, 0, 1]
    ((_, pending, seen, _),) = pomdp.outcomes(start, 1)
    assert (pomdp.actions(pending), seen) == ([EXPLAIN, 0], None)
    for _, after, labels, _ in pomdp.outcomes(pending, EXPLAIN):
        assert pomdp.actions(after) == [EXPLAIN, 0]
        assert labels == after.labels
