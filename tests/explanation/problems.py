"""Random problems; some by type, and the same problems with dense tables, entry by entry."""

from dataclasses import asdict, fields
from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import composite

from xplain import LabelTable, Problem
from xplain.explanation.habits import Habits
from xplain.testing.problems import random_problem


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


def random_pair(rng: np.random.Generator) -> Any:
    """Draws (by type, dense): types that test up to three messages each, with pads anywhere, and
    with costs of all kinds, so that in some problems messages pay only by delay."""
    types, steps, n = (int(rng.integers(1, most + 1)) for most in (3, 3, 5))
    width = int(rng.integers(0, min(n, 3) + 1))
    relevant = np.full((types, width), -1)
    for row in relevant:
        used = int(rng.integers(0, width + 1))
        row[rng.permutation(width)[:used]] = rng.permutation(n)[:used]
    kind = rng.integers(3)
    p = rng.random((types, steps, 1 << width))
    if kind == 1:
        p = np.round(p)
    elif kind == 2:
        confidence = 0.5 + 0.5 * rng.random((types, 1, 1))
        p = np.where(p < 0.5, 1 - confidence, confidence)
    dense = np.empty((types, steps, 1 << n))
    for t in range(types):
        used_bits = [i for i, j in enumerate(relevant[t]) if j >= 0]
        for given in range(1 << n):
            subset = sum(1 << i for i in used_bits if given >> relevant[t, i] & 1)
            dense[t, :, given] = p[t, :, subset]
    cost = np.where(rng.random(n) < 0.15, 0, rng.random(n) * 2)
    rest: dict[str, Any] = {
        "message_cost": cost if rng.random() < 0.5 else np.ones(n),
        "inexplicability_cost": float(rng.choice([0.5, 1.0, 2.0])),
        "trade_off": float(rng.choice([0.0, 0.1, 0.3, 1.0, 2.5])),
        "discount": float(rng.choice([1.0, 0.95, rng.uniform(0.3, 1.0)])),
        "prior": rng.dirichlet(np.ones(types)),
        "discount_per": "action" if rng.random() < 0.7 else "step",
    }
    both = Problem(LabelTable.by_type(relevant, p), **rest), Problem(dense, **rest)
    if rng.random() < 0.7:
        return both
    habits = Habits(np.array([0.05, 0.3]), np.ones(2), np.zeros(2), rng.dirichlet(np.ones(2)))
    return tuple(problem.with_habits(habits) for problem in both)


def plain(problem: Problem) -> dict[str, Any]:
    """Returns every field, with arrays as lists."""
    values = {field.name: getattr(problem, field.name) for field in fields(problem)}
    table, habits = problem.table, problem.habits
    values |= {"relevant": table.relevant, "table": table.p, "answers": table.answers}
    values |= {f"habits.{name}": rates for name, rates in asdict(habits).items()}
    values["habits"] = len(habits)
    asked = problem.questions
    values["questions"] = asked.limits, asked.shows.tolist(), asked.texts, asked.right.tolist()
    values["asked"] = [a.tolist() for a in (asked.table.relevant, asked.table.p)]
    values["asked_answers"] = asked.table.answers.tolist()
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}
