"""Exact and simulated values of policies, and values of policies that ignore answers."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.decisions import messages_given
from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.belief import Independent
from xplain.explanation.problem import Problem
from xplain.interaction.episode import explain
from xplain.interaction.explainees import SimulatedUser
from xplain.solvers.base import CachedPolicy, Solver
from xplain.solvers.evaluate import evaluate, simulate
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.simple import SayAll, Silent
from xplain.testing.problems import random_problem


def confident_problem() -> Problem:
    rng = np.random.default_rng(7)
    labels = rng.random((3, 6, 8)) < 0.6
    confidence = np.array([0.9, 0.95, 0.85])[:, None, None]
    p = np.where(labels, confidence, 1 - confidence)
    return Problem(p, np.array([0.3, 0.9, 0.5]), inexplicability_cost=1.5, discount=0.8)


def test_simulation_has_no_noise_where_the_type_is_known() -> None:
    """Only the labels are random then, and they change no decision."""
    problem = confident_problem()
    alone = problem.with_types(problem.p_explicable[1:2], ("alone",))
    # Two messages at once: the order of their prices matters.
    assert messages_given(QMDP().plan(alone), 1, 0, alone.prior) == 0b011
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


def test_beliefs_are_evaluated_once_each() -> None:
    """With four equal transitions and two types, the number of labels 1 so far decides the belief.
    Labels that all types give alike give no information."""
    policy, p = Counting(), np.array([0.9, 0.4])[:, None, None] * np.ones((1, 4, 1))
    worth = evaluate(Problem(p, np.empty(0), discount=1.0), policy)
    assert policy.asked == 1 + 2 + 4 + 7  # 0, 1, 3 and 6 labels seen
    assert worth.cost == pytest.approx((1 + 2 + 3 + 4) * (0.1 + 0.6) / 2)
    policy, p = Counting(), np.array([0.3, 0.8, 0.5])[None, :, None] * np.ones((4, 1, 1))
    evaluate(Problem(p, np.empty(0)), policy)
    assert policy.asked == 3


@pytest.mark.parametrize(("solver", "cost"), [(Silent(), 2 * 6), (SayAll(), 1.5 * 3.5 + 2 * 3)])
def test_silence_and_saying_everything_cost_what_they_cost_by_hand(
    solver: Solver, cost: float
) -> None:
    """The steps show 1, 2, 3 and 4 transitions. Without messages the second to fourth are
    inexplicable: 0 + 1 + 2 + 3 labels 0, with cost 2 each. With both messages the third and fourth
    are inexplicable: 0 + 0 + 1 + 2."""
    labels = np.array([[1, 1, 1, 1], [0, 1, 0, 1], [0, 0, 1, 0], [0, 0, 0, 0]], dtype=np.uint8)
    p = np.full((1, 4, 4), 0.5)
    problem = Problem(p, np.array([0.5, 3.0]), inexplicability_cost=2.0, trade_off=1.5)
    policy = CachedPolicy(solver.plan(problem))
    assert explain(problem, policy, SimulatedUser.of(labels), Independent()).cost == cost


def test_what_they_are_worth_is_a_sum_over_prefixes(rng_of_the_day: np.random.Generator) -> None:
    """The value is an expectation without a belief: transition i is labelled at the steps i … m −
    1."""
    for _ in range(30):
        problem = random_problem(rng_of_the_day)
        m, everything = problem.n_steps, (1 << problem.n_messages) - 1
        zeros = problem.prior @ (1 - problem.p_explicable).transpose(1, 0, 2)  # [m, 2^n]
        for solver, said in ((Silent(), 0), (SayAll(), everything)):
            weights = np.arange(m, 0, -1)
            expected = problem.inexplicability_cost * (weights @ zeros[:, said])
            if said:
                expected += problem.trade_off * problem.message_cost.sum()
            worth = evaluate(problem, solver.plan(problem), beliefs=100_000)
            assert worth.value_is == "exact"
            assert worth.cost == pytest.approx(expected)
