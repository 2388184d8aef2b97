"""Random explanation problems, small enough for brute force."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.asking import Limits, Questions
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem


def random_problem(
    rng: np.random.Generator, max_types: int = 3, max_steps: int = 3, max_messages: int = 2
) -> Problem:
    """Draws a problem with properties that have revealed errors in solvers: unequal costs (some 0),
    any discount in (0, 1] (often 1), certain and uncertain labels, prior entries of 0, repeated
    transitions, messages without effect. If several types are allowed, users in some problems slip
    and guess, and have one of two error rates."""
    types = int(rng.integers(1, max_types + 1))
    steps = int(rng.integers(1, max_steps + 1))
    n = int(rng.integers(0, max_messages + 1))
    kind = rng.integers(4)
    p = rng.random((types, steps, 1 << n))
    if kind == 1:  # certain labels
        p = np.round(p)
    elif kind == 2:  # one confidence per type, as labelers with a held-out accuracy have
        confidence = 0.5 + 0.5 * rng.random((types, 1, 1))
        p = np.where(p < 0.5, 1 - confidence, confidence)
    elif kind == 3:  # certain and uncertain labels together
        p = np.where(rng.random(p.shape) < 0.4, np.round(p), p)
    if rng.random() < 0.3:
        p[:, -1] = p[:, 0]
    if n and rng.random() < 0.2:
        p = p.reshape(types, steps, -1, 2)
        p[..., 1] = p[..., 0]
        p = p.reshape(types, steps, -1)
    prior = rng.dirichlet(np.ones(types))
    if types > 1 and rng.random() < 0.3:
        prior[rng.integers(types)] = 0
        prior /= prior.sum()
    problem = Problem(
        table=LabelTable.dense(p),
        message_cost=_draw_costs(rng, n),
        inexplicability_cost=float(_draw_costs(rng)),
        trade_off=float(_draw_costs(rng)),
        discount=1.0 if rng.random() < 0.3 else 1.0 - rng.random(),
        prior=prior,
        discount_per="action" if rng.random() < 0.7 else "step",
    )
    if max_types == 1 or types > 2 or rng.random() < 0.5:
        return problem
    slips, guesses = rng.random((2, steps, 1)) * rng.integers(2) / 2
    answers = p * (1 - slips) + (1 - p) * guesses
    rates = np.array([rng.integers(2) / 10, 0.3])
    erring = replace(problem, table=LabelTable.dense(p, answers))
    habits = Habits(rates, np.ones(2), np.zeros(2), rng.dirichlet(np.ones(2)))
    return erring.with_habits(habits)


def with_questions(rng: np.random.Generator, problem: Problem, most: int = 3) -> Problem:
    """Adds at most ``most`` questions to a problem: some are equal, some have certain answers. The
    user may be asked one or several of them."""
    count = int(rng.integers(1, most + 1))
    p = rng.random((problem.n_user_types, count, 1 << problem.n_messages))
    if rng.random() < 0.5:
        p = np.round(p)
    if rng.random() < 0.3:
        p[:, -1] = p[:, 0] ** 2
    limits = Limits(
        cost=float(_draw_costs(rng)) / 8,
        most=int(rng.integers(1, count + 1)),
        when="anytime" if rng.random() < 0.7 else "first",
    )
    table = LabelTable.dense(p).repeat_types(len(problem.habits))
    if not problem.habits.never_err:
        meant = LabelTable.dense(p).answered
        table = replace(table, answers=problem.habits.add_errors(meant))
    shows = np.zeros((count, problem.n_steps), np.bool_)
    return replace(problem, questions=Questions(table, limits, shows))


def _draw_costs(rng: np.random.Generator, number: int | None = None) -> NDArray[np.float64]:
    """Draws costs below 2; some are 0. None draws one cost."""
    return np.where(rng.random(number) < 0.15, 0.0, 2.0 * rng.random(number))
