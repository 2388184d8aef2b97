"""Compares POMCP with brute force, the literal POMDP and its own limits."""

import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.decisions import messages_given, plain_optimal_value, worths
from tests.explanation.problems import misleading_problem
from xplain import LabelTable, Problem, Solver, TooLargeError
from xplain.explanation.actions import EXPLAIN, Action, AskQuestion, GiveMessages, VisibleState
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.habits import Habits
from xplain.solvers import pomcp
from xplain.solvers.base import CachedPolicy, best_action
from xplain.solvers.evaluate import evaluate
from xplain.solvers.hsvi import Certified
from xplain.solvers.pomcp import POMCP
from xplain.testing.literal_pomdp import literal_optimal_value, reduced_optimal_value
from xplain.testing.problems import random_problem


def soft_problem(seed: int, types: int = 3, steps: int = 4, n: int = 3, **kwargs: Any) -> Problem:
    """Makes a problem in which every message has an effect, and no two values are equal."""
    rng = np.random.default_rng(seed)
    settings = {"trade_off": 0.7, "discount": 0.9, "prior": rng.dirichlet(np.ones(types))} | kwargs
    return Problem(rng.random((types, steps, 1 << n)), 0.2 + rng.random(n), **settings)


def first_values(solver: POMCP, problem: Problem, seed: int = 0) -> dict[Action, float]:
    return dict(solver.plan(problem, seed).values(VisibleState(), problem.start))


def drawn(seed: int, count: int) -> list[Problem]:
    rng = np.random.default_rng(seed)
    return [random_problem(rng) for _ in range(count)]


@pytest.mark.parametrize(
    ("solver", "problems", "share"),
    [
        (
            POMCP(simulations=20_000, depth=None, exploration=4.0),
            [misleading_problem(), *drawn(5, 10)],
            0.02,
        ),
        # The paper's POMCP is slower, because the mean includes all tries.
        (
            POMCP(simulations=200_000, depth=None, backup="mean", exploration=1.0),
            drawn(6, 3),
            0.05,
        ),
    ],
    ids=["best", "mean"],
)
def test_approaches_the_optimum(solver: POMCP, problems: list[Problem], share: float) -> None:
    """Full depth and many simulations: the value of the root, and the exact worth of the policy,
    come close to brute force on problems of every kind, also where people err."""
    for problem in problems:
        optimum = reduced_optimal_value(problem)
        policy = solver.plan(problem)
        allowed = share * (0.1 + abs(optimum))
        best = max(policy.values(VisibleState(), problem.start).values())
        assert best == pytest.approx(optimum, abs=allowed)
        if solver.backup != "mean":
            assert evaluate(problem, policy).value == pytest.approx(optimum, abs=allowed)


def test_steps_do_not_count_messages() -> None:
    """With depth 1 in steps, all messages can come before the leaf; in actions only one."""
    problem = soft_problem(9, steps=2, n=2)
    opened = {}
    for unit in ("actions", "steps"):
        search: Any = POMCP(simulations=2000, depth=1, depth_unit=unit).plan(problem)
        tree = search.search(VisibleState(), 0, problem.prior)
        nodes = tree.nodes[: tree.used[0]]
        opened[unit] = {int(node["given"]) for node in nodes if node["edges"]}
    assert opened == {"actions": {0}, "steps": {0, 1, 2, 3}}


def test_labels_are_drawn_with_their_probabilities() -> None:
    """The shares of answers equal their probabilities within 5 standard errors, and the beliefs
    after them are the posteriors. Four labels are informative; two give no information."""
    p = np.array([[0.5, 0.02, 0.7, 0.3, 0.9, 0.5], [0.98, 0.1, 0.7, 0.6, 0.4, 0.5]])
    problem = Problem(p[:, :, None], np.empty(0))
    draws, prior = 40_000, np.array([0.3, 0.7])
    search: Any = POMCP(simulations=draws, depth=1).plan(problem)
    tree = search.search(VisibleState(4), 0, prior)
    news = p[:, [0, 1, 3, 4]]
    expected = []
    for labels in product((0, 1), repeat=4):
        joint = prior * np.where(labels, news, 1 - news).prod(axis=1)
        expected.append((joint[0] / joint.sum(), joint.sum()))
    expected.sort()
    nodes = range(1, int(tree.used[0]))
    found = sorted((tree.beliefs[i, 0], tree.nodes["visits"][i] / draws) for i in nodes)
    possible = np.array(expected)
    for belief, share in found:
        at = np.abs(possible[:, 0] - belief).argmin()
        assert possible[at, 0] == pytest.approx(belief, rel=1e-9)
        error = np.sqrt(possible[at, 1] * (1 - possible[at, 1]) / draws)
        assert abs(share - possible[at, 1]) <= 5 * error
    assert sum(share for _, share in found) == 1.0


def test_a_decision_goes_on_in_the_middle_as_from_the_start() -> None:
    """After the first message the same search follows, because the policy depends only on the
    visible state and the belief."""
    for seed in range(6):
        problem = soft_problem(seed, trade_off=0.05)
        policy = POMCP(simulations=500).plan(problem, 3)
        whole = policy.decide(VisibleState(1), problem.prior)
        first = best_action(policy.values(VisibleState(1), problem.prior))
        if not isinstance(first, GiveMessages):
            assert whole == first
            continue
        assert isinstance(whole, GiveMessages)
        rest = policy.decide(VisibleState(1, first.messages), problem.prior)
        later = rest.messages if isinstance(rest, GiveMessages) else 0
        assert whole.messages == first.messages | later


@pytest.mark.parametrize("seed", range(2))
def test_of_a_certain_type_it_finds_the_optimum(seed: int) -> None:
    """This holds for right and for noisy labels, at every (k, H)."""
    soft = soft_problem(seed)
    for problem in (soft, replace(soft, table=np.round(soft.p_explicable))):
        policy = POMCP(simulations=3000).plan(problem)
        for t, k, given in product(range(3), range(4), range(8)):
            values = policy.values(VisibleState(k, given), np.eye(3)[t])
            # With noisy labels, few simulations do not decide reliably.
            best = plain_optimal_value(problem, t, k, given)
            assert max(values.values()) == pytest.approx(best, abs=0.05)


def test_the_unit_of_cost_does_not_matter() -> None:
    """If all costs are multiplied by 2^7, the values are exactly multiplied by 2^7."""
    problem = soft_problem(12)
    dear = replace(problem, message_cost=problem.message_cost * 128, inexplicability_cost=128.0)
    values, dear_values = (first_values(POMCP(), one) for one in (problem, dear))
    assert {action: 128 * value for action, value in values.items()} == dear_values


def test_many_simulations_are_one_search_however_often_ctrl_c_is_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """700 simulations in parts of 300 give the same result as 700 at once."""
    problem = soft_problem(16)
    whole = first_values(POMCP(simulations=700), problem)
    monkeypatch.setattr(pomcp, "CHUNK", 300)
    search: Any = POMCP(simulations=700).plan(problem)
    assert search.values(VisibleState(), problem.prior) == whole
    assert search.search(VisibleState(), 0, problem.prior).nodes["visits"][0] == 700


@pytest.mark.parametrize("solver", [POMCP(8_000_000, depth=None), Certified(gap=1e-9, seconds=60)])
def test_ctrl_c_ends_the_search_and_breaks_nothing(solver: Solver) -> None:
    """The search would go on for minutes; KeyboardInterrupt reaches the caller within a second or
    so. Another policy answers afterwards as before."""
    problem = soft_problem(14, types=6, steps=14, n=8)
    Certified(nodes=1).plan(problem)  # compiled before the clock starts
    short = POMCP(simulations=500).plan(problem)
    before = short.values(VisibleState(), problem.prior)
    timer, began = threading.Timer(0.3, os.kill, [os.getpid(), signal.SIGINT]), time.perf_counter()
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        solver.plan(problem).values(VisibleState(), problem.prior)
    assert time.perf_counter() - began < 30
    timer.join()
    assert short.values(VisibleState(), problem.prior) == before


def asking_problem(accept: float) -> Problem:
    """Makes a problem with three messages and two noisy questions; messages may be missed."""
    rng = np.random.default_rng(4)
    asked = Questions(LabelTable.dense(rng.uniform(0.1, 0.9, (3, 2, 8))), Limits(0.01, 2))
    problem = soft_problem(1, steps=3, questions=asked)
    habits = Habits(np.zeros(1), np.array([accept]), np.zeros(1), np.ones(1))
    return problem if accept == 1.0 else problem.with_habits(habits)


@pytest.mark.parametrize("accept", [1.0, 0.7])
def test_each_action_is_tried_where_there_are_fewer_simulations(accept: float) -> None:
    """Every question, every message and *explain* have a value."""
    problem = asking_problem(accept)
    for seed in range(20):
        values = POMCP(simulations=1).plan(problem, seed).values(VisibleState(), problem.start)
        assert values.keys() == {
            *(EXPLAIN, GiveMessages(1), GiveMessages(2), GiveMessages(4)),
            *(AskQuestion(0), AskQuestion(1)),
        }


@pytest.mark.parametrize("n", [61, 62])
def test_with_the_most_messages_a_search_has_no_bit_for_questions(n: int) -> None:
    """It decides on messages, and has memory for the question that led to each node."""
    table = LabelTable.by_type([[n - 1]] * 2, [[[0.1, 0.9]] * 2, [[0.2, 0.8]] * 2])
    policy: Any = POMCP(100).plan(Problem(table, np.full(n, 0.1), questions=Questions(table)))
    assert messages_given(policy, 0, 0, np.array([0.4, 0.6])) == 1 << n - 1
    assert len(policy.search(VisibleState(), 0, np.array([0.4, 0.6])).tried) == 101


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_with_missed_messages_it_approaches_the_optimum(seed: int) -> None:
    """Values are compared with the literal POMDP, in which a user's knowledge is drawn fact by
    fact; the last problem has questions."""
    rng = np.random.default_rng(seed)
    asked = None
    if seed % 4 == 3:
        asked = Questions(LabelTable.dense(rng.uniform(0.1, 0.9, (2, 2, 4))), Limits(0.01, 1))
    habits = Habits(np.zeros(2), np.array([0.6, 0.9]), np.array([0.3, 0.0]), np.array([0.5, 0.5]))
    plain = soft_problem(seed, types=2, steps=2, n=2, discount_per="step", questions=asked)
    problem = plain.with_habits(habits)
    optimum = literal_optimal_value(problem)
    values = first_values(POMCP(simulations=30_000, depth=None, exploration=2.0), problem)
    assert max(values.values()) == pytest.approx(optimum, abs=0.02 * (0.1 + abs(optimum)))


def test_threads_that_share_a_plan_decide_as_one_alone() -> None:
    """A server uses such threads."""
    solver = POMCP(simulations=4000, depth=None)
    for seed in range(3):
        problem = soft_problem(17 + seed, types=4, steps=8, n=8, trade_off=0.1)
        beliefs = np.random.default_rng(3).dirichlet(np.ones(4), 12)
        alone = [solver.plan(problem).values(VisibleState(), belief) for belief in beliefs]
        decide = partial(solver.plan(problem).values, VisibleState())
        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(decide, beliefs)) == alone


def test_too_large_is_refused_with_the_size_before_memory_is_taken() -> None:
    """This holds for tables and for trees."""
    wide = Problem(np.random.default_rng(0).random((1, 1, 1 << 16)), np.zeros(16))
    with pytest.raises(TooLargeError, match=r"pomcp needs 0.\d+ GiB .* qhr"):
        POMCP(memory_gib=0.001).plan(wide)
    with pytest.raises(TooLargeError, match=r"pomcp needs \d+.\d+ GiB"):
        POMCP(simulations=10**9).plan(soft_problem(1))


def test_what_was_asked_before_makes_no_difference() -> None:
    """Each search has its own random stream, so decisions do not depend on earlier decisions, or on
    a cache. Another seed draws otherwise."""
    rng = np.random.default_rng(1)
    problem = Problem(rng.random((3, 5, 8)), np.ones(3), trade_off=0.3)
    questions = [(k, g, rng.dirichlet(np.ones(3))) for k in range(5) for g in (0, 3)]
    policy = POMCP(simulations=300).plan(problem, 7)
    forth, back = CachedPolicy(policy), CachedPolicy(policy)
    there = [messages_given(forth, *question) for question in questions]
    assert [messages_given(back, *question) for question in reversed(questions)] == there[::-1]
    assert [messages_given(policy, *question) for question in questions] == there
    step, given, belief = questions[0]
    values = worths(policy, step, given, belief)
    assert worths(policy, step, given, belief * (1 + 1e-15)) == pytest.approx(values, rel=1e-15)
    assert worths(POMCP(simulations=300).plan(problem, 8), step, given, belief) != values
