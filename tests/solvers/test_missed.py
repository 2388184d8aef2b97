"""Solvers where messages may be missed or forgotten: against brute force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.decisions import question_asked, worths
from tests.explanation.test_knowledge import problem_of
from xplain.explanation.actions import VisibleState
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import told
from xplain.explanation.habits import habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified, CertifiedPolicy
from xplain.solvers.pomcp import POMCP
from xplain.testing.literal_pomdp import literal_optimal_value


def needy(seed: int, questions: bool = False, steps: int = 2) -> Problem:
    """Two types that need other messages to find transitions explicable; one message in three is
    missed, one fact in five lost."""
    rng = np.random.default_rng(seed)
    needed = rng.integers(1, 4, size=(2, steps + 1, 1))
    p = np.where(needed & ~np.arange(4) == 0, 1.0, 0.1)
    asked = Questions(LabelTable.dense(p[:, steps:]), Limits(0.02)) if questions else Questions()
    cost = rng.uniform(0.3, 0.9, 2)
    problem = Problem(p[:, :steps], cost, discount=1.0, questions=asked)
    return problem.with_habits(habits_of(0.0, 0.7, 0.2))


@pytest.mark.parametrize("questions", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_long_search_finds_the_optimum(seed: int, questions: bool) -> None:
    """By brute force over states and observations, with and without questions."""
    problem = needy(seed, questions)
    solver = POMCP(simulations=40_000, depth=None, exploration=2.0)
    values = worths(solver.plan(problem, 0), 0, 0, problem.start)
    assert max(values.values()) == pytest.approx(literal_optimal_value(problem), abs=0.03)


def test_qmdp_asks_what_is_worth_it() -> None:
    """Whether a message landed can be asked for a hundredth, or not at all for more than all of
    it is worth."""
    problem = needy(0, questions=True)
    cheap = QMDP().plan(problem)
    belief = told(problem, problem.start, 3)
    assert max(worths(cheap, 1, 0, belief).values()) > max(
        value for action, value in worths(cheap, 1, 0, belief).items() if action >= 0
    )
    dear = replace(problem, questions=replace(problem.questions, limits=Limits(50.0)))
    assert question_asked(QMDP().plan(dear), 0, 0, problem.start) is None


@pytest.mark.parametrize("seed", range(12))
def test_certified_bounds_hold_and_close(seed: int) -> None:
    """On the optimum by trying every action at every belief."""
    problem = problem_of(40 + seed)
    policy = Certified(gap=1e-7).plan(problem)
    assert isinstance(policy, CertifiedPolicy)
    optimum = literal_optimal_value(problem)
    assert policy.lower - 1e-8 <= optimum <= policy.upper + 1e-8
    assert policy.upper - policy.lower <= 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_certified_knows_questions(seed: int) -> None:
    problem = needy(seed, questions=True)
    policy = Certified(gap=1e-7).plan(problem)
    assert isinstance(policy, CertifiedPolicy)
    optimum = literal_optimal_value(problem)
    assert policy.lower == pytest.approx(optimum, abs=1e-7)
    values = worths(policy, 0, 0, problem.start)
    assert max(values.values()) == pytest.approx(optimum, abs=1e-7)
    best = max(values, key=lambda action: values[action])
    asked = question_asked(policy, 0, 0, problem.start)
    assert asked == (~best if best < 0 else None)


def test_a_certified_decision_does_not_depend_on_what_was_asked_before() -> None:
    """Nor on how often: each search for a decision begins anew."""
    problem = needy(2, questions=True)
    hasty = Certified(gap=1e-9, nodes=1, decision_nodes=1)
    beliefs = np.random.default_rng(0).dirichlet(np.ones(problem.start.size), 6)
    often = hasty.plan(problem)
    for belief in [*beliefs, *beliefs[::-1], *beliefs]:
        often.decide(VisibleState(), belief)
    once = hasty.plan(problem)
    for belief in beliefs:
        assert worths(once, 0, 0, belief) == worths(often, 0, 0, belief)
