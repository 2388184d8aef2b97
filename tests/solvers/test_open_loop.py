"""Silence and saying everything: their costs by hand, independent of answers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from tests.explanation.problems import tiny_problems
from xplain.explanation.belief import Independent
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.solvers.base import CachedPolicy, Solver
from xplain.solvers.evaluate import evaluate
from xplain.solvers.simple import SayAll, Silent

LABELS = np.array(
    [[1, 1, 1, 1], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0]], dtype=np.uint8
)  # [4 transitions, 2^2 message sets]


def cost_of(solver: Solver, labels: np.ndarray) -> float:
    problem = Problem(
        np.full((1, 4, 4), 0.5), np.array([0.5, 3.0]), inexplicability_cost=2.0, trade_off=1.5
    )
    user = SimulatedUser.of(labels)
    return explain(problem, CachedPolicy(solver.plan(problem)), user, Independent()).cost


def test_the_costs_of_a_trace_by_hand() -> None:
    # Shown 1, 2, 3 and 4 transitions; without a message the second to fourth are puzzling:
    # 0 + 1 + 2 + 3 labels 0, two each. With both messages the third and the fourth: 0 + 0 + 1 + 2.
    assert cost_of(Silent(), LABELS) == 2 * 6
    assert cost_of(SayAll(), LABELS) == 1.5 * (0.5 + 3) + 2 * 3


@settings(deadline=None, max_examples=60)
@given(tiny_problems())
def test_what_they_are_worth_is_a_sum_over_prefixes(problem: Problem) -> None:
    """The expectation needs no belief: transition i is judged at the steps i … m − 1."""
    m, everything = problem.n_steps, (1 << problem.n_messages) - 1
    zeros = problem.prior @ (1 - problem.p_explicable).transpose(1, 0, 2)  # [m, 2^n]
    for solver, said in ((Silent(), 0), (SayAll(), everything)):
        expected = problem.inexplicability_cost * sum((m - i) * zeros[i, said] for i in range(m))
        if said:
            expected += problem.trade_off * problem.message_cost.sum()
        worth = evaluate(problem, solver.plan(problem), beliefs=100_000)
        assert worth.value_is == "exact"
        assert worth.cost == pytest.approx(expected)
