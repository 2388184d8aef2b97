"""Bounds, plans and values of policies against brute force, on random problems of every kind."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import combinations, product

import numpy as np
import pytest

from tests.decisions import (
    messages_given,
    plain_optimal_value,
    question_asked,
    worth_by_enumeration,
    worths,
)
from tests.explanation.test_belief import problem_of
from xplain import LabelTable, Problem
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import update_by_messages
from xplain.explanation.habits import habits_of
from xplain.solvers.base import CachedPolicy
from xplain.solvers.bounds import bounds, known_type_value
from xplain.solvers.evaluate import evaluate, simulate
from xplain.solvers.greedy import QMDP, Conformant, KnownType
from xplain.solvers.hsvi import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.process import known_values, make_process
from xplain.solvers.simple import QHR
from xplain.testing.literal_pomdp import literal_optimal_value, reduced_optimal_value
from xplain.testing.problems import random_problem, with_questions

DISCOUNTS = [("step", 1.0), ("action", 0.8), ("action", 0.4)]


def discounted(problem: Problem, discounts: tuple[str, float]) -> Problem:
    return replace(problem, discount_per=discounts[0], discount=discounts[1])


def asking(rng: np.random.Generator, undiscounted: bool = False) -> Problem:
    """Draws problems with questions. Half of them are random. In the other half each type finds
    transitions inexplicable until it has received the messages that it needs, and answers are
    (almost) certain."""
    if rng.random() < 0.5:
        problem = random_problem(rng, 3, 2, 2)
        if undiscounted:
            problem = replace(problem, discount=1.0)
        return with_questions(rng, problem)
    types, steps, n, count = 3, 2, 2, int(rng.integers(1, 4))
    needed = rng.integers(1 << n, size=(types, steps + count, 1))
    p = (needed & ~np.arange(1 << n) == 0) * 1.0
    p = np.where(p, 1.0, rng.choice([0.0, 0.1], size=(1, 1, 1)))
    sure = rng.choice([1.0, 0.95])
    p = sure * p + (1 - sure) * (1 - p)
    discount = 1.0 if undiscounted else float(rng.choice([1.0, 0.95]))
    limits = Limits(float(rng.choice([0.02, 0.1])), int(rng.integers(1, count + 1)))
    questions = Questions(LabelTable.dense(p[:, steps:]), limits)
    cost = rng.uniform(0.5, 1.5, n)
    return Problem(p[:, :steps], cost, discount=discount, questions=questions)


def asking_later(rng: np.random.Generator) -> Problem:
    """Draws problems of three steps with noisy labels and one or two questions. Beliefs at one (k,
    H) share bounds only if the same questions were asked."""
    needed = rng.integers(2, size=(2, 5, 1))
    p = np.where(needed & ~np.arange(2) == 0, 0.9, 0.3) + rng.uniform(-0.1, 0.1, (2, 5, 2))
    limits = Limits(float(rng.choice([0.0, 0.01, 0.05])), most=int(rng.integers(1, 3)))
    table = LabelTable.dense((p[:, 3:] * 1.3 - 0.2).clip(0.02, 0.98))
    questions = Questions(table, limits)
    return Problem(p[:, :3], rng.uniform(0.5, 2.5, 1), discount=1.0, questions=questions)


def needy(rng: np.random.Generator, questions: bool = False, steps: int = 2) -> Problem:
    """Draws two types that need different messages to find transitions explicable. Three messages
    in ten are missed, one fact in five is forgotten."""
    needed = rng.integers(1, 4, size=(2, steps + 1, 1))
    p = np.where(needed & ~np.arange(4) == 0, 1.0, 0.1)
    asked = Questions(LabelTable.dense(p[:, steps:]), Limits(0.02)) if questions else Questions()
    cost = rng.uniform(0.3, 0.9, 2)
    problem = Problem(p[:, :steps], cost, discount=1.0, questions=asked)
    return problem.with_habits(habits_of(0.0, 0.7, 0.2))


def missing(rng: np.random.Generator) -> Problem:
    """Draws problems in which messages may be missed or forgotten."""
    problem = needy(rng) if rng.random() < 0.5 else problem_of(int(rng.integers(1 << 31)))
    return discounted(problem, DISCOUNTS[rng.integers(3)])


KINDS: dict[str, tuple[Callable[[np.random.Generator], Problem], int]] = {
    "messages land": (random_problem, 40),
    "messages may be missed": (missing, 12),
    "messages may be missed, questions": (lambda rng: needy(rng, questions=True), 2),
    "questions": (asking, 24),
    "questions after noisy labels": (asking_later, 4),
}
"""How a problem is drawn, and how many are."""
CASES = [
    *KINDS.values(),
    *(pytest.param(one, 8 * draws, marks=pytest.mark.slow) for one, draws in KINDS.values()),
]
NAMES = [*KINDS, *(f"many, {kind}" for kind in KINDS)]


def optimum_of(problem: Problem) -> float:
    if problem.messages_land and not problem.questions:
        return reduced_optimal_value(problem)
    return literal_optimal_value(problem)


@pytest.mark.parametrize(("draw", "count"), CASES, ids=NAMES)
def test_a_policy_is_worth_what_all_answers_say_and_simulations_say_nearly(
    draw: Callable[[np.random.Generator], Problem],
    count: int,
    rng_of_the_day: np.random.Generator,
) -> None:
    """Values are compared with enumeration, in which nothing is merged, and each solver's once with
    simulations. No value is above the optimum."""
    solvers = QMDP(), QHR(), Conformant(), Lookahead(), POMCP(simulations=300), Certified(nodes=3)
    for number in range(count // 2):
        problem = draw(rng_of_the_day)
        optimum = optimum_of(problem)
        for place, solver in enumerate(solvers):
            policy = solver.plan(problem)
            worth, (value, cost) = evaluate(problem, policy), worth_by_enumeration(problem, policy)
            assert (worth.value_is, worth.value_se, worth.cost_se) == ("exact", 0, 0)
            assert worth.value == pytest.approx(value, abs=1e-9)
            assert worth.cost == pytest.approx(cost, abs=1e-9)
            assert worth.value <= optimum + 1e-8
            if place % 3 == number:
                drawn = simulate(problem, CachedPolicy(policy), 300, 1)
                assert drawn.value_is == "simulated"
                assert abs(drawn.value - value) <= 5 * drawn.value_se + 1e-9
                assert abs(drawn.cost - cost) <= 5 * drawn.cost_se + 1e-9


@pytest.mark.parametrize(("draw", "count"), CASES, ids=NAMES)
def test_bounds_enclose_the_optimum_and_the_certified_policy_earns_it(
    draw: Callable[[np.random.Generator], Problem],
    count: int,
    rng_of_the_day: np.random.Generator,
) -> None:
    """Bounds hold, coarse or fine; values of relaxations are above them."""
    for _ in range(count):
        problem = draw(rng_of_the_day)
        optimum = optimum_of(problem)
        for gap, nodes in ((1e-7, 100_000), (0.3, 100_000), (1e-6, 1)):
            policy = Certified(gap=gap, nodes=nodes).plan(problem)
            assert policy.lower - 1e-9 <= optimum <= policy.upper + 1e-9
            if nodes > 1:
                assert policy.upper - policy.lower <= gap
            if gap == 1e-7:
                worth = evaluate(problem, policy)
                assert worth.value_is == "exact"
                assert policy.lower - 1e-6 <= worth.value <= policy.upper + 1e-9
        found = bounds(problem)
        assert found.lower - 1e-9 <= optimum <= found.upper + 1e-9
        least, most = found.value_of_perfect_information
        assert least - 1e-9 <= found.known_type - optimum <= most + 1e-9
        value = evaluate(problem, QMDP().plan(problem)).value
        least, most = found.suboptimality(value)
        assert least - 1e-9 <= optimum - value <= most + 1e-9
        if problem.message_discount == 1 and not problem.questions:
            states = known_values(make_process(problem)).now(0, 0)
            for solver in (QMDP(), Lookahead()):
                best = max(worths(solver.plan(problem), 0, 0, problem.start).values())
                assert optimum - 1e-9 <= best <= states @ problem.start + 1e-9


def test_known_types_are_worth_what_the_plain_recursion_says() -> None:
    """The certified policy's bounds are for messages with an effect on anybody."""
    rng = np.random.default_rng(30)
    for _ in range(40):
        problem = random_problem(rng)
        types, every = range(problem.n_types), problem.messages_with_effect
        each = [plain_optimal_value(problem, t, messages=every) for t in types]
        assert bounds(problem).known_type == pytest.approx(float(problem.prior @ each), abs=1e-9)
        each = [plain_optimal_value(problem, t) for t in types]
        assert known_type_value(problem) == pytest.approx(float(problem.prior @ each), abs=1e-9)
        t = int(rng.integers(problem.n_types))
        one = replace(problem, prior=np.eye(problem.n_types)[t])
        for solver in (Lookahead(), KnownType()):
            worth = evaluate(one, solver.plan(one))
            assert worth.value == pytest.approx(each[t], abs=1e-9)


def test_lookahead_tightens_what_known_types_say() -> None:
    """This holds if messages do not discount, also with few sets or answers."""
    rng, tighter = np.random.default_rng(31), 0
    for _ in range(100):
        problem = replace(random_problem(rng), discount_per="step")
        known = known_type_value(problem)
        for solver in (Lookahead(), Lookahead(candidates=1), Lookahead(answers=1)):
            best = max(worths(solver.plan(problem), 0, 0, problem.prior).values())
            assert best <= known + 1e-9
            tighter += solver == Lookahead() and best < known - 1e-6
    assert tighter >= 10


def known_optimum(problem: Problem, t: int) -> dict[int, float]:
    """Computes, for each row of the label table, the optimal value for an agent who knows the type
    t and, after each action, the user's knowledge. Every message and *explain* is tried, without a
    reduction."""
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
def test_values_of_known_types_and_knowledge_are_optimal(discounts: tuple[str, float]) -> None:
    for seed in range(2):
        for problem in (needy(np.random.default_rng(seed)), problem_of(seed, messages=3)):
            one = discounted(problem, discounts)
            found = known_values(make_process(one)).now(0, 0).reshape(-1, one.n_types)
            for t in range(one.n_types):
                for row, value in known_optimum(one, t).items():
                    assert found[row, t] == pytest.approx(value, abs=1e-9)


def test_qmdp_asks_what_is_worth_it() -> None:
    """A question shows if the user accepted a message. QMDP asks it at a small cost, and not at a
    cost above its value."""
    problem = needy(np.random.default_rng(0), questions=True)
    cheap = worths(QMDP().plan(problem), 1, 0, update_by_messages(problem, problem.start, 3))
    assert max(cheap.values()) > max(value for action, value in cheap.items() if action >= 0)
    dear = replace(problem, questions=replace(problem.questions, limits=Limits(50.0)))
    assert question_asked(QMDP().plan(dear), 0, 0, problem.start) is None


@pytest.mark.parametrize("seed", range(2))
def test_a_message_that_hardly_pays_waits_while_the_state_is_in_doubt(seed: int) -> None:
    """At a certain state QMDP gives the best message. At an uncertain belief it gives the message
    whose gain exceeds its margin most, if there is one."""
    rng = np.random.default_rng(seed)
    problem = needy(rng)
    policy, states = QMDP().plan(problem), np.eye(problem.start.size)
    for step, belief in product((0, 1), [*states, *rng.dirichlet(np.ones(len(states)), 40)]):
        margin = {1 << j: 0.1 * (1 - belief.max()) * p for j, p in enumerate(problem.prices)}
        values = worths(policy, step, 0, belief)
        best = max(values, key=lambda a: values[a] - margin.get(a, 0))
        said = messages_given(policy, step, 0, belief)
        assert said & best == best
        assert bool(said) == bool(best)


@pytest.mark.parametrize("seed", range(3))
def test_in_the_middle_a_search_finds_what_certified_does(seed: int) -> None:
    """The actions are messages, *explain* and questions."""
    rng = np.random.default_rng(seed)
    problem = discounted(needy(rng, True, 3), DISCOUNTS[seed])
    policy = POMCP(simulations=100_000, depth=None, exploration=2.0).plan(problem)
    certified = Certified(gap=1e-9).plan(problem)
    for first in range(1 << problem.n_messages):  # given messages may be repeated
        said = first | int(rng.integers(1 << problem.n_messages))
        belief = rng.dirichlet(np.ones(problem.start.size))
        exact, found = worths(certified, 1, said, belief), worths(policy, 1, said, belief)
        assert max(found.values()) == pytest.approx(max(exact.values()), abs=0.02)
