"""The process represents the problem: its tables, beliefs and outcomes, also if messages may be
missed."""

from itertools import product

import numpy as np
import pytest

from xplain import LabelTable, Problem
from xplain.explanation.belief import update, update_by_messages
from xplain.explanation.habits import Habits
from xplain.solvers.process import (
    before_step,
    expected_after_forgetting,
    forget,
    give_all,
    make_process,
    matters,
    outcomes,
)
from xplain.testing.problems import random_problem, with_questions

SEEDS = range(40)


def some_problem(seed: int) -> Problem:
    """Draws a problem of any kind."""
    rng = np.random.default_rng(seed)
    problem = random_problem(rng, max_types=3, max_steps=4, max_messages=3)
    if seed % 3 == 2:
        habits = Habits(
            np.array([0.0, 0.2]), np.array([0.7, 1.0]), np.array([0.0, 0.3]), [0.4, 0.6]
        )
        problem = random_problem(rng, 1, 3, 3) if not problem.habits.never_err else problem
        problem = problem.with_habits(habits)
    return with_questions(rng, problem) if seed % 2 and seed % 3 != 2 else problem


def random_belief(rng: np.random.Generator, problem: Problem) -> np.ndarray:
    belief = rng.random(problem.start.size) * (rng.random(problem.start.size) < 0.7)
    belief[0] += 0.1
    return belief / belief.sum()


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("dense", [False, True])
def test_cells_read_the_problems_tables(seed: int, dense: bool) -> None:
    problem = some_problem(seed)
    process = make_process(problem, dense)
    m, types = problem.n_steps, problem.n_types
    for said in range(1 << problem.n_messages):
        cells = process.cells.at(said)
        if problem.messages_land:
            p = problem.table.label_probabilities(m, said).T
            answered = problem.table.answer_probabilities(m, said).T
            if problem.questions:
                asked = problem.questions.table
                q = asked.answer_probabilities(len(problem.questions), said).T
                own = process.questions.cells.at(said)
                assert np.array_equal(process.questions.answered[:, own], q)
        else:
            p = problem.table.p.reshape(m, -1)
            answered = problem.table.answered.reshape(m, -1)
        assert np.array_equal(process.p[:, cells], p)
        assert np.array_equal(process.answered[:, cells], answered)
        costs = problem.inexplicability_cost * np.cumsum(1 - p, axis=0)
        assert process.explain_cost[:, cells] == pytest.approx(costs)
    sets = np.arange(1 << problem.n_messages)
    assert np.array_equal(
        process.cells.of_sets(sets), [process.cells.at(int(said)) for said in sets]
    )
    assert process.start.sum() == pytest.approx(1)
    assert process.n_states == types * (1 if problem.messages_land else problem.table.p.shape[1])


@pytest.mark.parametrize("seed", SEEDS)
def test_messages_and_steps_change_the_belief_as_the_problem_says(seed: int) -> None:
    """Messages that matter are those that change a label of somebody who is believed in."""
    problem, rng = some_problem(seed), np.random.default_rng(seed)
    process, belief = make_process(problem), random_belief(rng, problem)
    effective = problem.table.effective()
    for j in range(problem.n_messages):
        changes = False
        for s in np.flatnonzero(belief).tolist():
            row, t = divmod(s, problem.n_types)
            known = not problem.messages_land and j in effective[t]
            has = known and row >> problem.table.rows[t].index(j) & 1
            changes |= j in effective[t] and not has
        assert (matters(process, belief) >> j & 1) == changes
    assert before_step(process, 1) == problem.messages_land
    for said in range(1 << problem.n_messages):
        heard = give_all(process, belief, said)
        assert heard == pytest.approx(update_by_messages(problem, belief, said))
        if not problem.messages_land:
            # Impossible labels give no information, and then facts are forgotten.
            labels, none = np.ones(1, np.uint8), slice(0, 0)
            assert forget(process, heard) == pytest.approx(
                update(problem, heard, said, labels, none)
            )
    values = rng.random(process.n_states)
    assert belief @ expected_after_forgetting(process, values) == pytest.approx(
        forget(process, belief) @ values
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_outcomes_are_those_of_all_label_vectors(seed: int) -> None:
    problem, rng = some_problem(seed), np.random.default_rng(seed)
    process = make_process(problem)
    belief, k = random_belief(rng, problem), int(rng.integers(problem.n_steps))
    said = int(rng.integers(1 << problem.n_messages))
    found = outcomes(process, k, said, belief)
    weights, tail = found
    assert not tail.any()
    # Functions of the belief that follows, homogeneous of degree 1: sums over answers that may be
    # merged but not confused.
    kinds = rng.random((5, process.n_states))
    merged = (kinds @ weights.T).max(axis=0).sum()
    cells, whole = process.cells.at(said), 0.0
    p = process.answered[: k + 1, cells]
    for labels in product((0, 1), repeat=k + 1):
        likelihood = np.where(np.array(labels)[:, None] == 1, p, 1 - p).prod(axis=0)
        whole += float((kinds @ forget(process, belief * likelihood)).max())
    assert merged == pytest.approx(whole)
    left = outcomes(process, k, said, belief, negligible=0.2)
    assert left[0].sum() + left[1].sum() == pytest.approx(belief.sum())
    assert (left[0].sum(axis=1) > 0.2).all()
    assert outcomes(process, k, said, belief, most=len(weights) - 1) is None or len(weights) == 1


def test_a_row_where_the_types_look_at_other_messages_is_no_set_of_all() -> None:
    table = LabelTable.by_type([[0], [1], [2]], np.random.default_rng(0).random((3, 2, 2)))
    problem = Problem(table, np.array([3.0, 2.0, 1.0]), message_names=("a", "b", "c"))
    assert make_process(problem).p.shape == (2, 2 * 3)
    assert make_process(problem, dense=True).p.shape == (2, 8 * 3)
