"""The literal POMDP, its reduction, and what bounds its optimum."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.explanation.problems import tiny_problems
from xplain.explanation.belief import update
from xplain.explanation.literal_pomdp import (
    EXPLAIN,
    LiteralPOMDP,
    literal_optimal_value,
    reduced_optimal_value,
)
from xplain.explanation.problem import Problem
from xplain.solvers.model import model_of, optimal_values
from xplain.solvers.qmdp import QMDP


@settings(deadline=None, max_examples=150)
@given(tiny_problems())
def test_literal_and_reduced_agree(problem: Problem) -> None:
    literal = literal_optimal_value(problem)
    assert literal == pytest.approx(reduced_optimal_value(problem), abs=1e-9)


@settings(deadline=None, max_examples=100)
@given(tiny_problems())
def test_qmdp_bounds_the_optimum_from_above(problem: Problem) -> None:
    optimum = reduced_optimal_value(problem)
    values = QMDP().plan(problem).values(0, 0, problem.prior)
    assert max(values.values()) >= optimum - 1e-9
    assert problem.prior @ optimal_values(model_of(problem))[0, 0] >= max(values.values()) - 1e-9


def test_one_type_leaves_nothing_to_find_out() -> None:
    rng = np.random.default_rng(1)
    problem = Problem(rng.random((1, 3, 4)), np.array([0.3, 0.7]))
    assert literal_optimal_value(problem) == pytest.approx(
        float(optimal_values(model_of(problem))[0, 0, 0])
    )


def test_a_worked_example() -> None:
    """Two steps, one message at 1.2, undiscounted; type 0 needs it, type 1 never does.

    Giving it at once costs 1.2. Waiting one step tells the types apart: type 0 pays 1 and then
    1.2 for the second prefix (rather than 2), type 1 nothing: 0.5 · 2.2 = 1.1.
    """
    p = np.array([[[0, 1], [0, 1]], [[1, 1], [1, 1]]], dtype=float)
    problem = Problem(p, np.array([1.2]), discount=1.0)
    assert literal_optimal_value(problem) == pytest.approx(-1.1)


def test_messages_used_are_no_actions() -> None:
    problem = Problem(np.full((1, 2, 4), 0.5), np.ones(2))
    pomdp = LiteralPOMDP(problem)
    (start,) = pomdp.initial()
    assert pomdp.actions(start) == [EXPLAIN, 0, 1]
    ((_, pending, seen, _),) = pomdp.outcomes(start, 1)
    assert (pomdp.actions(pending), seen) == ([EXPLAIN, 0], None)
    for _, after, labels, _ in pomdp.outcomes(pending, EXPLAIN):
        assert pomdp.actions(after) == [EXPLAIN, 0]
        assert labels == after.labels


@settings(deadline=None, max_examples=100)
@given(tiny_problems(), st.data())
def test_belief_update_is_bayes_by_enumeration(problem: Problem, data: st.DataObject) -> None:
    """P(t | labels of the first k steps) from the joint probability of everything seen."""
    n_steps = data.draw(st.integers(1, problem.n_steps))
    sets: list[int] = []
    for _ in range(n_steps):
        new = data.draw(st.integers(0, (1 << problem.n_messages) - 1))
        sets.append(new | (sets[-1] if sets else 0))
    seen = [data.draw(st.sampled_from(list(product((0, 1), repeat=k + 1)))) for k in range(n_steps)]
    joint = problem.prior.copy()
    for labels, shown in zip(seen, sets, strict=True):
        for i, label in enumerate(labels):
            p = problem.p_explicable[:, i, shown]
            joint = joint * (p if label else 1 - p)
    belief = problem.prior
    for labels, shown in zip(seen, sets, strict=True):
        belief = update(problem, belief, shown, np.array(labels, dtype=np.uint8))
    if joint.sum() > 0:
        assert belief == pytest.approx(joint / joint.sum(), abs=1e-9)
    assert belief.sum() == pytest.approx(1)
