"""Compares the belief about users' knowledge with all ways to miss and forget messages."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.decisions import messages_given, worths
from xplain.explanation.belief import update, update_by_messages
from xplain.explanation.habits import Habits, habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers.greedy import QMDP
from xplain.solvers.process import PATIENCE
from xplain.testing.literal_pomdp import (
    EXPLAIN,
    LiteralPOMDP,
    LiteralState,
)
from xplain.testing.problems import random_problem

seeds = st.integers(0, 2**32 - 1)


def habits(rng: np.random.Generator, count: int = 2) -> Habits:
    """Draws habits of users, at least one of whom misses or forgets messages."""
    accept = rng.choice([1.0, 0.8, 0.3], count)
    forget = rng.choice([0.0, 0.1, 0.6], count)
    forget[0] = forget[0] or 0.2
    return Habits(rng.choice([0.0, 0.2], count), accept, forget, rng.dirichlet(np.ones(count)))


def problem_of(seed: int, types: int = 2, steps: int = 2, messages: int = 2) -> Problem:
    """Draws a random problem in which messages may be missed or forgotten."""
    rng = np.random.default_rng(seed)
    while True:
        problem = random_problem(rng, types, steps, messages)
        if len(problem.habits) == 1:
            return problem.with_habits(habits(rng, int(rng.integers(1, 3))))


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_the_belief_is_that_over_the_states_of_the_literal_pomdp(seed: int) -> None:
    """There are random messages, also repeated ones, and random answers."""
    problem = problem_of(seed, steps=3)
    pomdp, rng = LiteralPOMDP(problem), np.random.default_rng(seed)
    states, belief, mask = pomdp.initial(), problem.start, 0
    for k in range(problem.n_steps):
        for j in range(problem.n_messages):
            if rng.random() < 0.5:
                states = after(pomdp, states, j, None)
                belief, mask = update_by_messages(problem, belief, 1 << j), mask | 1 << j
        labels = rng.integers(0, 2, k + 1)
        heard = after(pomdp, states, EXPLAIN, tuple(labels.tolist()))
        if not heard:  # nobody can answer so
            return
        states = heard
        belief = update(problem, belief, mask, labels.astype(np.uint8))
        expected = np.zeros((problem.table.p.shape[1], problem.n_types))
        for state, weight in states.items():
            row = problem.table.subset(sum(1 << j for j in state.known))[state.user_type]
            expected[row, state.user_type] += weight
        assert belief == pytest.approx(expected.ravel(), abs=1e-9)


def after(
    pomdp: LiteralPOMDP,
    states: dict[LiteralState, float],
    action: int,
    seen: tuple[int, ...] | None,
) -> dict[LiteralState, float]:
    """Updates the belief over states by Bayes' rule, written out."""
    joint: dict[LiteralState, float] = {}
    for state, weight in states.items():
        for probability, new, observation, _ in pomdp.outcomes(state, action):
            if observation == seen:
                joint[new] = joint.get(new, 0.0) + weight * probability
    total = sum(joint.values())
    return {state: weight / total for state, weight in joint.items()} if total else {}


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_users_who_all_but_surely_listen_are_told_the_same(seed: int) -> None:
    """In the limit the values of all actions are those of the paper's users; a message must also
    gain its margin."""
    rng = np.random.default_rng(seed)
    n, types, steps = 3, 3, 4
    p = rng.uniform(0.02, 0.98, (types, steps, 1 << n))
    problem = Problem(LabelTable.dense(p), rng.random(n), discount=1.0)
    limit = problem.with_habits(habits_of(0.0, 1 - 1e-12, 0.0))
    known, knowing = QMDP().plan(problem), QMDP().plan(limit)
    belief = rng.dirichlet(np.ones(types))
    wide = np.zeros((limit.table.p.shape[1], types))
    wide[0] = belief
    margin = PATIENCE * (1 - belief.max()) * problem.prices
    for step in range(steps):
        said = 0
        while True:
            values = worths(known, step, said, belief)
            if not said:
                assert worths(knowing, step, 0, wide.ravel()) == pytest.approx(values, abs=1e-6)
            dearer = {a: v - (margin[indices(a)[0]] if a else 0) for a, v in values.items()}
            if not (new := max(dearer, key=dearer.__getitem__)):
                break
            said |= new
        assert messages_given(knowing, step, 0, wide.ravel()) == said


def test_a_message_that_changes_answers_alone_has_an_effect() -> None:
    table = LabelTable.dense(np.full((1, 2, 4), 0.5), np.full((1, 2, 4), 0.5))
    table.answers[:, 2:] = 0.7
    assert table.effective() == [(1,)]
    assert table.effective_of_any() == (1,)
