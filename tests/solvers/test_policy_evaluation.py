"""Compares exact values of policies with brute force over every label, and with simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from tests.decisions import messages_given, worth_by_enumeration
from tests.explanation.problems import tiny_problems
from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.problem import Problem
from xplain.solvers.base import CachedPolicy
from xplain.solvers.evaluate import evaluate, simulate
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.simple import QHR
from xplain.testing.literal_pomdp import reduced_optimal_value


@settings(deadline=None, max_examples=60)
@given(tiny_problems())
def test_exact_worth_is_the_enumerated_one(problem: Problem) -> None:
    for solver in (QMDP(), QHR(), Conformant()):
        policy = solver.plan(problem)
        worth = evaluate(problem, policy)
        value, cost = worth_by_enumeration(problem, policy)
        assert worth.value_is == "exact"
        assert worth.value == pytest.approx(value, abs=1e-8)
        assert worth.cost == pytest.approx(cost, abs=1e-8)
        assert worth.value <= reduced_optimal_value(problem) + 1e-8


def confident_problem() -> Problem:
    rng = np.random.default_rng(7)
    labels = rng.random((3, 6, 8)) < 0.6
    confidence = np.array([0.9, 0.95, 0.85])[:, None, None]
    p = np.where(labels, confidence, 1 - confidence)
    return Problem(p, np.array([0.3, 0.9, 0.5]), inexplicability_cost=1.5, discount=0.8)


def test_simulation_agrees_with_the_exact_worth() -> None:
    problem = confident_problem()
    policy = QMDP().plan(problem)
    # The order of prices matters.
    assert messages_given(policy, 0, 0, problem.prior).bit_count() > 1
    exact, simulated = (
        evaluate(problem, policy),
        simulate(problem, CachedPolicy(policy), 4000, seed=1),
    )
    assert (exact.value_is, simulated.value_is) == ("exact", "simulated")
    assert abs(exact.value - simulated.value) < 4 * simulated.value_se
    assert abs(exact.cost - simulated.cost) < 4 * simulated.cost_se


@settings(deadline=None, max_examples=30)
@given(tiny_problems())
def test_simulation_agrees_with_every_label_enumerated(problem: Problem) -> None:
    for solver in (QMDP(), Conformant()):
        policy = solver.plan(problem)
        worth = simulate(problem, CachedPolicy(policy), 300, seed=5)
        value, cost = worth_by_enumeration(problem, policy)
        assert abs(worth.value - value) <= 5 * worth.value_se + 1e-9
        assert abs(worth.cost - cost) <= 5 * worth.cost_se + 1e-9


def test_simulation_has_no_noise_where_the_type_is_known() -> None:
    """Only the labels are random then, and they change no decision."""
    problem = confident_problem()
    alone = problem.with_types(problem.p_explicable[:1], ("alone",))
    for policy in (QMDP().plan(alone), Conformant().plan(alone), Counting()):
        worth, exact = simulate(alone, CachedPolicy(policy), 5, seed=2), evaluate(alone, policy)
        assert (worth.value, worth.cost) == (pytest.approx(exact.value), pytest.approx(exact.cost))
        assert max(worth.value_se, worth.cost_se) < 1e-12


@dataclass
class Counting:
    """A silent policy that counts its decisions."""

    asked: int = 0

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        self.asked += 1
        return give(0)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> dict[Action, float]:
        return {}


def test_exchangeable_transitions_are_merged() -> None:
    """Four equal transitions and two types: a belief is how many of the labels so far were 1."""
    p = np.array([0.9, 0.4])[:, None, None] * np.ones((1, 4, 1))
    policy = Counting()
    worth = evaluate(Problem(p, np.empty(0), discount=1.0), policy)
    assert policy.asked == 1 + 2 + 4 + 7  # 0, 1, 3 and 6 labels seen
    assert worth.cost == pytest.approx((1 + 2 + 3 + 4) * (0.1 + 0.6) / 2)


def test_labels_that_all_types_give_alike_teach_nothing() -> None:
    p = np.array([0.3, 0.8, 0.5])[None, :, None] * np.ones((4, 1, 1))
    policy = Counting()
    evaluate(Problem(p, np.empty(0)), policy)
    assert policy.asked == 3
