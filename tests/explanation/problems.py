"""Random problems for hypothesis, which reports the seed of a failure."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import composite

from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.testing.problems import random_problem as random_problem


@composite
def tiny_problems(
    draw: st.DrawFn, max_types: int = 3, max_steps: int = 3, max_messages: int = 2
) -> Problem:
    """Draws problems with at most these numbers of types, steps and messages."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    return random_problem(rng, max_types, max_steps, max_messages)


def misleading_problem() -> Problem:
    """Makes two user types who err at 0.05 or 0.4. The types' labels differ at once, but not their
    answers: the optimum is at least 0.1 below that of a model in which answers are labels."""
    p = np.array([[[1, 1, 1, 1], [0, 1, 0, 1]], [[0, 0, 0, 0], [0, 0, 1, 1]]], float)
    costs = np.array([0.4, 0.4])
    problem = Problem(LabelTable.dense(p), costs, inexplicability_cost=0.6, discount=1.0)
    rates = np.array([0.05, 0.4])
    return problem.with_habits(Habits(rates, np.ones(2), np.zeros(2), np.full(2, 0.5)))
