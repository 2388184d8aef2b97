"""Compares solvers and values with brute force if messages may be repeated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import combinations, product

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.decisions import messages_given, question_asked, worth_by_enumeration, worths
from tests.explanation.test_knowledge import problem_of
from xplain.errors import TooLargeError
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import update_by_messages
from xplain.explanation.habits import habits_of
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.solvers.base import CachedPolicy
from xplain.solvers.evaluate import evaluate, simulate
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.process import PATIENCE, known_values, make_process
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


def test_qmdp_asks_what_is_worth_it() -> None:
    """A question shows if a message was accepted. It costs a hundredth, or more than the
    information is worth."""
    problem = needy(0, questions=True)
    cheap = QMDP().plan(problem)
    belief = update_by_messages(problem, problem.start, 3)
    assert max(worths(cheap, 1, 0, belief).values()) > max(
        value for action, value in worths(cheap, 1, 0, belief).items() if action >= 0
    )
    dear = replace(problem, questions=replace(problem.questions, limits=Limits(50.0)))
    assert question_asked(QMDP().plan(dear), 0, 0, problem.start) is None


DISCOUNTS = [("step", 1.0), ("action", 0.8), ("action", 0.4)]


def discounted(problem: Problem, discounts: tuple[str, float]) -> Problem:
    return replace(problem, discount_per=discounts[0], discount=discounts[1])


def known_optimum(problem: Problem, t: int) -> dict[int, float]:
    """Returns for each row of the label table the optimal value if the row of a user of type t is
    visible after each action, by enumeration of all messages and *explain*."""
    n, table = problem.n_messages, problem.table
    accept, forget = float(problem.accept[t]), float(problem.forget[t])

    def row(known: frozenset[int]) -> int:
        return int(table.subset(sum(1 << j for j in known))[t])

    @cache
    def value(k: int, said: int, known: frozenset[int]) -> float:
        if k == problem.n_steps:
            return 0.0
        cost = float((1 - table.p[: k + 1, row(known), t]).sum()) * problem.inexplicability_cost
        later = 0.0
        for size in range(len(known) + 1):
            for kept in combinations(sorted(known), size):
                share = (1 - forget) ** size * forget ** (len(known) - size)
                later += share * value(k + 1, 0, frozenset(kept))
        best = problem.discount * later - cost
        for j in range(n):
            if not said >> j & 1:
                price = problem.trade_off * float(problem.message_cost[j])
                missed = value(k, said | 1 << j, known)
                landed = value(k, said | 1 << j, known | {j})
                best = max(best, accept * landed + (1 - accept) * missed - price)
        return best

    own = [j for j in table.relevant[t].tolist() if j >= 0]
    sets = [frozenset(s) for size in range(len(own) + 1) for s in combinations(own, size)]
    return {row(known): value(0, 0, known) for known in sets}


@pytest.mark.parametrize("discounts", DISCOUNTS)
def test_values_of_who_sees_type_and_knowledge_are_optimal(
    discounts: tuple[str, float],
) -> None:
    """Nothing left out."""
    for seed in range(3):
        problem = discounted(needy(seed), discounts)
        for one in (problem, discounted(problem_of(seed, messages=3), discounts)):
            found = known_values(make_process(one)).now(0, 0).reshape(-1, one.n_types)
            for t in range(one.n_types):
                for row, value in known_optimum(one, t).items():
                    assert found[row, t] == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize("discounts", DISCOUNTS)
def test_bounds_enclose_the_literal_optimum_and_close_on_it(
    discounts: tuple[str, float],
) -> None:
    for seed in range(2):
        for problem in (needy(seed), problem_of(40 + seed)):
            one = discounted(problem, discounts)
            policy, optimum = Certified(gap=1e-9).plan(one), literal_optimal_value(one)
            assert policy.lower - 1e-8 <= optimum <= policy.upper + 1e-8
            assert policy.upper - policy.lower <= 1e-6
            worth = evaluate(one, policy)
            assert worth.value_is == "exact"
            assert worth.value == pytest.approx(optimum, abs=1e-6)
            assert worth_by_enumeration(one, QMDP().plan(one))[0] <= optimum + 1e-9
            scores = worths(Lookahead().plan(one), 0, 0, one.start).values()
            sure = known_values(make_process(one)).now(0, 0) @ one.start
            assert optimum - 1e-9 <= max(scores) <= sure + 1e-9


@pytest.mark.parametrize("discounts", DISCOUNTS[:2])
def test_exact_values_are_those_by_enumeration_and_simulation_is_near(
    discounts: tuple[str, float],
) -> None:
    for seed in range(2):
        for problem in (needy(seed), problem_of(60 + seed, steps=3)):
            one = discounted(problem, discounts)
            for solver in (QMDP(), Lookahead(), POMCP(simulations=500)):
                policy = solver.plan(one)
                worth, (value, cost) = evaluate(one, policy), worth_by_enumeration(one, policy)
                assert worth.value_is == "exact"
                assert worth.value == pytest.approx(value, abs=1e-9)
                assert worth.cost == pytest.approx(cost, abs=1e-9)
            drawn = simulate(one, CachedPolicy(policy), 300, seed)
            assert drawn.value_is == "simulated"
            assert drawn.value == pytest.approx(value, abs=5 * drawn.value_se + 1e-9)
            assert drawn.cost == pytest.approx(cost, abs=5 * drawn.cost_se + 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_values_with_questions_are_exact_too(seed: int) -> None:
    """The certified policy earns the optimum by brute force, by walk and by simulation."""
    problem = needy(seed, questions=True)
    policy, optimum = Certified(gap=1e-9).plan(problem), literal_optimal_value(problem)
    worth = evaluate(problem, policy)
    assert (worth.value_is, worth.value) == ("exact", pytest.approx(optimum, abs=1e-7))
    drawn = simulate(problem, CachedPolicy(policy), 400, seed)
    assert drawn.value == pytest.approx(optimum, abs=5 * drawn.value_se + 1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_message_that_hardly_pays_waits_while_the_state_is_in_doubt(seed: int) -> None:
    """In a known state QMDP gives the best messages; otherwise only messages that gain the margin,
    and no other message gains more."""
    problem, rng = needy(seed), np.random.default_rng(seed)
    policy, states = QMDP().plan(problem), np.eye(problem.start.size)
    for step, belief in product((0, 1), [*states, *rng.dirichlet(np.ones(len(states)), 40)]):
        values = worths(policy, step, 0, belief)
        said = messages_given(policy, step, 0, belief)
        owed = PATIENCE * (1 - belief.max()) * problem.prices.max()
        best = max(values.values())
        assert max(v for a, v in values.items() if a & said or a == said) >= best - owed - 1e-9
        if belief.max() == 1 and not said:
            assert best == pytest.approx(values[0], abs=1e-9)
        gains = {a: v - values[0] for a, v in values.items() if a}
        if (
            max(gains.values(), default=-np.inf)
            < PATIENCE * (1 - belief.max()) * problem.prices.min() - 1e-9
        ):
            assert not said


def in_the_middle(problem: Problem, seed: int) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """What was said so far, as often as may be, and a belief."""
    rng, n = np.random.default_rng(seed), problem.n_messages
    belief = rng.dirichlet(np.ones(problem.start.size))
    for first in range(1 << n):
        yield first | int(rng.integers(1 << n)), belief


@pytest.mark.parametrize("seed", range(3))
def test_in_the_middle_a_search_finds_what_certified_does(seed: int) -> None:
    """Actions are messages, *explain* and questions."""
    problem = discounted(needy(seed, True, 3), DISCOUNTS[seed])
    policy = POMCP(simulations=100_000, depth=None, exploration=2.0).plan(problem)
    certified = Certified(gap=1e-9).plan(problem)
    for said, belief in in_the_middle(problem, seed):
        exact = worths(certified, 1, said, belief)
        found = worths(policy, 1, said, belief)
        assert max(found.values()) == pytest.approx(max(exact.values()), abs=0.02)


def test_who_cannot_plan_with_it_says_so_in_one_line() -> None:
    many = Problem(np.random.default_rng(0).random((1, 2, 1 << 11)), np.full(11, 0.1), discount=1.0)
    for solver in (Lookahead(), Certified()):
        with pytest.raises(TooLargeError, match="sets of messages together: 11 matter"):
            solver.plan(many.with_habits(habits_of(0.0, 0.9, 0.0)))
