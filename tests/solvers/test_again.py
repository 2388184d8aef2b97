"""Messages said again, at a price and to a limit: solvers and values against brute force."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from tests.explanation.test_knowledge import problem_of, seeds
from tests.solvers.test_knowing import needy
from xplain.errors import InputError, TooLargeError
from xplain.explanation.again import Again
from xplain.explanation.belief import told, update
from xplain.explanation.habits import habits_of
from xplain.explanation.literal_pomdp import literal_optimal_value
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers import knowing
from xplain.solvers.base import Policy
from xplain.solvers.bounds import bounds
from xplain.solvers.cached_policy import CachedPolicy
from xplain.solvers.hsvi.knowing import CertifiedKnowing
from xplain.solvers.hsvi.solver import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.open_loop import Silent
from xplain.solvers.policy_evaluation import evaluate
from xplain.solvers.policy_simulation import simulate_knowing
from xplain.solvers.pomcp.solver import POMCP
from xplain.solvers.qmdp import QMDP
from xplain.solvers.reminding import PATIENCE, Reminding

AGAIN = [Again(), Again(0.3), Again(3.0), Again(most=1), Again(0.7, 2)]
DISCOUNTS = [("step", 1.0), ("action", 0.8), ("action", 0.4)]


def of_limits(problem: Problem, again: Again, discounts: tuple[str, float]) -> Problem:
    return replace(problem, again=again, discount_per=discounts[0], discount=discounts[1])


@settings(max_examples=100, deadline=None)
@given(seeds)
def test_what_was_said_counts_each_message_up_to_where_it_matters(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, again = 4, AGAIN[seed % len(AGAIN)]
    said, times = 0, np.zeros(n, int)
    for _ in range(4):
        new = int(rng.integers(1 << n))
        said, times = again.after(said, new, n), times + [new >> j & 1 for j in range(n)]
        for j, level in product(range(n), range(max(again.levels, 1))):
            assert (said >> level * n + j & 1) == (times[j] > level)
        used = again.exhausted(said, n)
        assert [used >> j & 1 for j in range(n)] == [
            again.most is not None and count >= again.most for count in times
        ]


def known_optimum(problem: Problem, t: int) -> dict[int, float]:
    """By row of the label table, what an explanation is worth to who sees it of a user of type t
    after each action: every message and *explain* tried, nothing reduced."""
    n, table = problem.n_messages, problem.table
    accept, forget = float(problem.accept[t]), float(problem.forget[t])
    delay = problem.discount if problem.discount_per == "action" else 1.0
    most = problem.again.most or problem.n_steps

    def row(known: frozenset[int]) -> int:
        return int(table.subset(sum(1 << j for j in known))[t])

    @cache
    def value(k: int, times: tuple[int, ...], said: int, known: frozenset[int]) -> float:
        if k == problem.n_steps:
            return 0.0
        cost = float((1 - table.p[: k + 1, row(known), t]).sum()) * problem.inexplicability_cost
        after = tuple(count + (said >> j & 1) for j, count in enumerate(times))
        later = 0.0
        for size in range(len(known) + 1):
            for kept in combinations(sorted(known), size):
                share = (1 - forget) ** size * forget ** (len(known) - size)
                later += share * value(k + 1, after, 0, frozenset(kept))
        best = problem.discount * later - cost
        for j in range(n):
            if not said >> j & 1 and times[j] < most:
                price = problem.trade_off * float(problem.message_cost[j])
                price *= problem.again.price if times[j] else 1
                missed = value(k, times, said | 1 << j, known)
                landed = value(k, times, said | 1 << j, known | {j})
                best = max(best, delay * (accept * landed + (1 - accept) * missed) - price)
        return best

    own = [j for j in table.relevant[t].tolist() if j >= 0]
    sets = [frozenset(s) for size in range(len(own) + 1) for s in combinations(own, size)]
    return {row(known): value(0, (0,) * n, 0, known) for known in sets}


@pytest.mark.parametrize("discounts", DISCOUNTS)
@pytest.mark.parametrize("again", AGAIN)
def test_values_of_who_sees_type_and_knowledge_are_optimal(
    again: Again, discounts: tuple[str, float]
) -> None:
    """Nothing left out, a mere delay least of all. Where such a delay has a price or a limit of its
    own the value is a bound."""
    exact = discounts[0] == "step" or again == Again()
    for seed in range(3):
        problem = of_limits(needy(seed), again, discounts)
        for one in (problem, of_limits(problem_of(seed, messages=3), again, discounts)):
            found = Reminding(one).known(0, 0).reshape(-1, one.n_types)
            for t in range(one.n_types):
                for row, value in known_optimum(one, t).items():
                    assert found[row, t] >= value - 1e-9
                    if exact:
                        assert found[row, t] == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize("discounts", DISCOUNTS)
@pytest.mark.parametrize("again", AGAIN)
def test_bounds_enclose_the_literal_optimum_and_close_on_it(
    again: Again, discounts: tuple[str, float]
) -> None:
    for seed in range(2):
        for problem in (needy(seed), problem_of(40 + seed)):
            one = of_limits(problem, again, discounts)
            policy, optimum = Certified(gap=1e-9).plan(one), literal_optimal_value(one)
            assert isinstance(policy, CertifiedKnowing)
            assert policy.lower - 1e-8 <= optimum <= policy.upper + 1e-8
            assert policy.upper - policy.lower <= 1e-6
            worth = evaluate(one, policy)
            assert worth.value_is == "exact"
            assert worth.value == pytest.approx(optimum, abs=1e-6)
            assert worth_of(one, QMDP().plan(one))[0] <= optimum + 1e-9
            if discounts[0] == "step":
                scores = Lookahead().plan(one).values(0, 0, one.start).values()
                assert (
                    optimum - 1e-9 <= max(scores) <= Reminding(one).known(0, 0) @ one.start + 1e-9
                )


def test_a_delay_can_be_all_that_pays() -> None:
    """Saying what nobody needs puts off what is still to be paid; bounds know."""
    problem = Problem(np.full((1, 3, 4), 0.1), np.full(2, 0.1), discount=0.5)
    knowing_it = problem.with_habits(habits_of(0.0, 0.7, 0.2))
    optimum = literal_optimal_value(knowing_it)
    silent = evaluate(knowing_it, Silent().plan(knowing_it)).value
    assert optimum > silent + 0.5
    found = bounds(knowing_it)
    assert found.lower == pytest.approx(optimum, abs=1e-3)
    assert found.upper == pytest.approx(optimum, abs=1e-3)
    assert evaluate(knowing_it, QMDP().plan(knowing_it)).value > silent + 0.5


def worth_of(
    problem: Problem,
    policy: Policy,
    step: int = 0,
    said: tuple[int, ...] = (),
    belief: NDArray[np.float64] | None = None,
) -> tuple[float, float]:
    """Discounted return and undiscounted cost of a policy, over every answer."""
    belief = problem.start if belief is None else belief
    if step == problem.n_steps:
        return 0.0, 0.0
    given = 0
    for new in said:
        given = problem.again.after(given, new, problem.n_messages)
    per_message = problem.discount if problem.discount_per == "action" else 1.0
    new = policy.messages(step, given, belief)
    prices = []
    for j in indices(new):
        times = sum(before >> j & 1 for before in said)
        assert times < (problem.again.most or problem.n_steps)
        factor = problem.again.price if times else 1.0
        prices.append(problem.trade_off * float(problem.message_cost[j]) * factor)
    value = -sum(price * per_message**i for i, price in enumerate(sorted(prices)))
    belief, count = told(problem, belief, new), step + 1
    p, answers = (t[:count].reshape(count, -1).T for t in (problem.table.p, problem.table.answered))
    zeros = problem.inexplicability_cost * float(belief @ (1 - p).sum(axis=1))
    cost, later = sum(prices) + zeros, 0.0
    for labels in product((0, 1), repeat=count):
        answer = np.array(labels, dtype=np.uint8)
        chance = float(belief @ np.where(answer == 1, answers, 1 - answers).prod(axis=1))
        if chance > 0:
            after = update(problem, belief, given, answer)
            returned, paid = worth_of(problem, policy, count, (*said, new), after)
            later, cost = later + chance * returned, cost + chance * paid
    factor = per_message ** len(prices)
    return value + factor * (problem.discount * later - zeros), cost


@pytest.mark.parametrize("discounts", DISCOUNTS[:2])
@pytest.mark.parametrize("again", AGAIN)
def test_exact_values_are_those_by_enumeration_and_simulation_is_near(
    again: Again, discounts: tuple[str, float]
) -> None:
    for seed in range(2):
        for problem in (needy(seed), problem_of(60 + seed, steps=3)):
            one = of_limits(problem, again, discounts)
            for solver in (QMDP(), Lookahead(), POMCP(simulations=500)):
                policy = solver.plan(one)
                worth, (value, cost) = evaluate(one, policy), worth_of(one, policy)
                assert worth.value_is == "exact"
                assert worth.value == pytest.approx(value, abs=1e-9)
                assert worth.cost == pytest.approx(cost, abs=1e-9)
            drawn = simulate_knowing(one, CachedPolicy(policy), 300, seed)
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
    drawn = simulate_knowing(problem, CachedPolicy(policy), 400, seed)
    assert drawn.value == pytest.approx(optimum, abs=5 * drawn.value_se + 1e-9)


@pytest.mark.parametrize("again", AGAIN)
@pytest.mark.parametrize("seed", range(3))
def test_kernels_decide_as_qmdp_does(seed: int, again: Again) -> None:
    problem = of_limits(needy(seed), again, DISCOUNTS[seed])
    policy, rng = Reminding(problem), np.random.default_rng(seed)
    model = knowing.make_knowing(policy)
    for step in (0, 1):
        belief, given = rng.dirichlet(np.ones(problem.start.size)), 0
        for new in rng.integers(4, size=2).tolist():
            given = problem.again.after(given, new, 2)
            assert knowing.given_after(model, 0, given & 3) == problem.again.after(0, given & 3, 2)
        value, action, _ = knowing.best_now(model, step, given, 0, belief)
        said, first = policy.messages(step, given, belief), 1 << action if action < 2 else 0
        assert first & said == first
        assert bool(first) == bool(said)
        assert value == pytest.approx(policy.values(step, given, belief)[first], abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_message_that_hardly_pays_waits_while_the_state_is_in_doubt(seed: int) -> None:
    """Known for sure, QMDP gives what is best; in doubt, only what gains the margin, and what is
    left out gains no more."""
    problem, rng = needy(seed), np.random.default_rng(seed)
    policy, states = Reminding(problem), np.eye(problem.start.size)
    for step, belief in product((0, 1), [*states, *rng.dirichlet(np.ones(len(states)), 40)]):
        values = policy.values(step, 0, belief)
        said = policy.messages(step, 0, belief)
        owed = PATIENCE * (1 - belief.max()) * problem.prices(0).max()
        best = max(values.values())
        assert max(v for a, v in values.items() if a & said or a == said) >= best - owed - 1e-9
        if belief.max() == 1 and not said:
            assert best == pytest.approx(values[0], abs=1e-9)
        gains = {a: v - values[0] for a, v in values.items() if a}
        if max(gains.values()) < PATIENCE * (1 - belief.max()) * problem.prices(0).min() - 1e-9:
            assert not said


def test_a_high_price_and_a_limit_of_one_are_the_same_where_nobody_would_pay() -> None:
    for seed in range(3):
        once, dear = (
            of_limits(needy(seed), again, DISCOUNTS[0]) for again in (Again(most=1), Again(1e6))
        )
        assert literal_optimal_value(once) == pytest.approx(literal_optimal_value(dear))
        least, free = (bounds(replace(once, again=a)).lower for a in (Again(most=1), Again(0.0)))
        assert least <= free


@pytest.mark.parametrize("again", AGAIN)
@pytest.mark.parametrize(
    ("seed", "steps", "questions"), [(0, 3, False), (1, 2, True), (2, 2, True)]
)
def test_a_long_search_finds_the_optimum(
    seed: int, steps: int, questions: bool, again: Again
) -> None:
    """By brute force, and so does who acts on shorter ones."""
    problem = of_limits(needy(seed, questions, steps), again, DISCOUNTS[seed])
    optimum = literal_optimal_value(problem)
    policy = POMCP(simulations=100_000, depth=None, exploration=2.0).plan(problem)
    values = policy.values(0, 0, problem.start).values()
    assert max(values) == pytest.approx(optimum, abs=0.015)
    if not questions:
        hasty = POMCP(simulations=10_000, depth=None, exploration=2.0).plan(problem)
        assert optimum - 0.02 <= worth_of(problem, hasty)[0] <= optimum + 1e-9


def in_the_middle(problem: Problem, seed: int) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """What was said so far, as often as may be, and a belief."""
    rng, n = np.random.default_rng(seed), problem.n_messages
    belief = rng.dirichlet(np.ones(problem.start.size))
    for first in range(1 << n):
        said = problem.again.after(0, first, n)
        new = int(rng.integers(1 << n)) & problem.may_say(said)
        yield problem.again.after(said, new, n), belief


@pytest.mark.parametrize("again", AGAIN)
@pytest.mark.parametrize("seed", range(3))
def test_in_the_middle_a_search_finds_what_certified_does(seed: int, again: Again) -> None:
    """Of messages, *explain* and questions."""
    problem = of_limits(needy(seed, True, 3), again, DISCOUNTS[seed])
    policy = POMCP(simulations=100_000, depth=None, exploration=2.0).plan(problem)
    certified = Certified(gap=1e-9).plan(problem)
    for said, belief in in_the_middle(problem, seed):
        exact = certified.values(1, said, belief)
        found = policy.values(1, said, belief)
        assert max(found.values()) == pytest.approx(max(exact.values()), abs=0.02)


def worth_acting(
    policy: Reminding, step: int, given: int, said: int, belief: NDArray[np.float64]
) -> float:
    """Of what QMDP does."""
    margin = PATIENCE * (1 - belief.max())
    chosen = policy._values(step, given, said, belief, margin)[1].argmax()
    return float(policy._values(step, given, said, belief)[1][chosen])


@pytest.mark.parametrize("again", AGAIN)
@pytest.mark.parametrize("seed", range(3))
def test_where_a_search_ends_a_history_is_worth_qmdp(seed: int, again: Again) -> None:
    """With what was said by then; *explain* the mean of such histories, within five standard
    errors."""
    problem, count = of_limits(needy(seed, steps=3), again, DISCOUNTS[seed]), 20_000
    alike = POMCP(simulations=count, depth=1, exploration=1e4)  # tries all actions as often
    policy, qmdp = alike.plan(problem), Reminding(problem)
    answers = problem.table.answered[:2].reshape(2, -1)
    for said, belief in in_the_middle(problem, seed):
        found, may_say = policy.values(1, said, belief), indices(problem.may_say(said))
        assert found.keys() == {0, *(1 << j for j in may_say)}
        for j in may_say:
            after = worth_acting(qmdp, 1, said, 1 << j, told(problem, belief, 1 << j))
            worth = qmdp.delay * after - problem.prices(said)[j]
            assert found[1 << j] == pytest.approx(worth, abs=1e-9)
        shares, later = [], []
        for labels in product((0, 1), repeat=2):
            answer = np.array(labels, np.uint8)
            shares.append(belief @ np.where(answer[:, None], answers, 1 - answers).prod(axis=0))
            after = update(problem, belief, said, answer)
            later.append(worth_acting(qmdp, 2, said, 0, after))
        mean, square = np.dot(shares, later), np.dot(shares, np.square(later))
        error = 5 * np.sqrt(max(square - mean**2, 0) / (count / 4)) + 1e-9
        worth = problem.discount * mean - belief @ qmdp.explain_cost(1)
        assert found[0] == pytest.approx(worth, abs=error)


def test_what_was_said_has_a_search_of_its_own() -> None:
    """Where it makes no difference to what is found."""
    problem = replace(needy(0), again=Again(most=9))
    policy = POMCP(exploration=2.0).plan(problem)
    one, other = (policy.values(0, said, problem.start) for said in (1, 2))
    assert one != other
    assert max(one.values()) == pytest.approx(max(other.values()), abs=0.05)


def test_who_cannot_plan_with_it_says_so_in_one_line() -> None:
    problem = needy(0)
    with pytest.raises(InputError, match=r"again.most=40: at most 31 with 2 messages"):
        replace(problem, again=Again(most=40))
    many = Problem(np.random.default_rng(0).random((1, 2, 1 << 11)), np.full(11, 0.1), discount=1.0)
    for solver in (Lookahead(), Certified()):
        with pytest.raises(TooLargeError, match="sets of messages together: 11 matter"):
            solver.plan(many.with_habits(habits_of(0.0, 0.9, 0.0)))
