"""People who were not assumed are only further hidden types; all of these types are enumerated."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from xplain.explanation.actions import VisibleState
from xplain.explanation.anybody import Open
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import Facts, Independent, update, update_by_answer
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.solvers.bounds import bounds
from xplain.solvers.greedy import QMDP, Conformant
from xplain.solvers.hsvi import Effort
from xplain.testing.literal_pomdp import literal_optimal_value

N, STEPS = 3, 3


def world(rng: np.random.Generator, n: int = N, steps: int = STEPS, questions: int = 2) -> Any:
    """Draws random labels by the facts believed incorrectly, and two user types with one such fact
    each."""
    labels = rng.uniform(0.05, 0.95, (steps + questions, 1 << n))
    wrong = (1, 1 << (n - 1))
    every = (1 << n) - 1
    sets = np.arange(1 << n)
    of_types = np.stack([labels[:, one & ~sets] for one in wrong])
    table, asked = (LabelTable.dense(part) for part in (of_types[:, :steps], of_types[:, steps:]))
    problem = Problem(
        table, np.full(n, 1.0), prior=np.array([0.3, 0.7]), questions=Questions(asked, Limits(0.1))
    )
    everything = labels[:, every & ~sets][None]
    parts = (LabelTable.dense(everything[:, :steps]), LabelTable.dense(everything[:, steps:]))
    return labels, wrong, problem, Facts(parts[0], wrong, parts[1], 0.2)


def enumerated(labels: np.ndarray, wrong: tuple[int, ...], n: int) -> Iterator[Any]:
    """Lists (share, user type, facts after messages, slip, guess) of everybody, except people whose
    answers are random."""
    every = (1 << n) - 1
    candidates = {0, every, *(1 << j for j in range(n))}
    candidates |= {a | b for a, b in combinations(wrong, 2)}
    others = sorted(candidates - {*wrong})
    sizes = {one.bit_count() for one in others}
    shares = [(one, t, 0.8 * p) for t, (one, p) in enumerate(zip(wrong, (0.3, 0.7), strict=True))]
    for one in others:
        alike = sum(other.bit_count() == one.bit_count() for other in others)
        shares.append((one, 2, 0.2 / len(sizes) / alike))
    for facts, t, share in shares:

        def rest(told: int, facts: int = facts) -> int:
            return facts & ~told

        yield share * 0.8 * 0.99, t, rest, 0.0, 0.0, True
        yield share / 15, t, rest, 0.1, 0.1, True
        yield share / 15, t, rest, 0.0, 0.4, False
        for j in range(n):
            if facts >> j & 1:

                def stuck(told: int, facts: int = facts, j: int = j) -> int:
                    return facts & ~(told if told == every else told & ~(1 << j))

                yield share * 0.8 * 0.01 / facts.bit_count(), t, stuck, 0.0, 0.0, False


def test_the_belief_is_that_over_everybody(rng_of_the_day: np.random.Generator) -> None:
    rng = rng_of_the_day
    for _ in range(10):
        labels, wrong, problem, facts = world(rng)
        opened = Open().people(problem, None, facts)
        people = list(enumerated(labels, wrong, N))
        weights = np.array([share for share, *_ in people])
        coin = 1 / 15
        belief, told = opened.start, 0
        for step in range(STEPS):
            told |= int(rng.integers(1 << N))
            said = rng.integers(0, 2, step + 1)
            belief = update(opened, belief, told, said.astype(np.uint8))
            for p, (_, _, rest, slip, guess, _) in enumerate(people):
                for i, label in enumerate(said):
                    one = labels[i, rest(told)]
                    one = one * (1 - slip) + (1 - one) * guess
                    weights[p] *= one if label else 1 - one
            coin *= 0.5 ** (step + 1)
        belief = update_by_answer(opened, belief, told, 1, 1)
        for p, (_, _, rest, slip, guess, _) in enumerate(people):
            one = labels[STEPS + 1, rest(told)]
            weights[p] *= one * (1 - slip) + (1 - one) * guess
        coin *= 0.5
        total = weights.sum() + coin
        whose = [one[1] for one in people]
        by_type = np.bincount(whose, weights, 3).tolist()
        by_type[2] += coin
        np.testing.assert_allclose(opened.type_belief(belief), np.array(by_type) / total, atol=1e-9)
        fits = sum(w for w, one in zip(weights, people, strict=True) if one[5] and one[1] < 2)
        assert belief[opened.as_found].sum() == pytest.approx(fits / total)


@pytest.mark.parametrize("seed", range(6))
def test_certified_bounds_hold_by_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    *_, problem, facts = world(rng, n=2, steps=2, questions=seed % 2)
    for known in (facts, None):
        opened = Open().people(replace(problem, discount=0.9), None, known)
        optimum = literal_optimal_value(opened)
        proven = bounds(opened, Effort(gap=1e-6, nodes=500))
        assert proven.lower <= optimum + 1e-9
        assert optimum <= proven.upper + 1e-9


def test_conformant_plans_for_the_types_that_were_found() -> None:
    for seed in range(5):
        *_, problem, facts = world(np.random.default_rng(seed))
        opened = Open().people(problem, None, facts)
        closed, open_ = (Conformant().plan(one) for one in (problem, opened))
        state = VisibleState()
        assert closed.decide(state, problem.start) == open_.decide(state, opened.start)
        assert closed.values(state, problem.start) == pytest.approx(
            open_.values(state, opened.start)
        )


def test_without_facts_the_rest_are_people_whose_answers_tell_nothing() -> None:
    *_, problem, _ = world(np.random.default_rng(0))
    opened = Open().people(problem, None, None)
    assert opened.type_names[:2] == problem.type_names
    assert opened.type_belief(opened.prior)[2] == pytest.approx(1 / 15)
    nobody = opened.whose == 2
    assert (opened.table.answered[..., nobody] == 0.5).all()
    others = opened.prior[~nobody] / opened.prior[~nobody].sum()
    mean = opened.table.p[..., ~nobody] @ others
    np.testing.assert_allclose(opened.table.p[..., nobody][..., 0], mean)


def test_more_messages_than_twelve_are_planned_for_as_before() -> None:
    p = np.random.default_rng(0).random((2, 2, 8))
    table = LabelTable.by_type([[0, 3, 12], [1, 2, 11]], p)
    problem = Problem(table, np.ones(13))
    assert Open().people(problem, None, None) is problem


def test_missed_messages_are_habits_of_everybody() -> None:
    *_, problem, facts = world(np.random.default_rng(0))
    opened = Open(accept=0.6).people(problem, None, facts)
    assert not opened.messages_land
    assert (opened.accept == 0.6).all()
    assert opened.type_belief(opened.start).sum() == pytest.approx(1)
    QMDP().plan(opened).decide(VisibleState(), opened.start)


def test_somebody_whose_answers_tell_nothing_is_soon_taken_for_that() -> None:
    *_, problem, facts = world(np.random.default_rng(3), questions=0, steps=12)
    rng = np.random.default_rng(0)
    of_types = problem.table.p.round().clip(0.02, 0.98)
    everything = facts.everything.p.round().clip(0.02, 0.98)
    problem = replace(problem, table=replace(problem.table, p=of_types))
    facts = facts._replace(everything=replace(facts.everything, p=everything), asked=None)
    opened, plain = Open().people(problem, None, facts), Independent().people(problem, None, facts)
    assert plain is problem
    belief = opened.start
    for step in range(12):
        belief = update(opened, belief, 0, rng.integers(0, 2, step + 1).astype(np.uint8))
    assert belief[-1] > 0.99
