"""Compares tables with direct recursion; tests properties of the simple solvers, and exact and
simulated values of policies."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.decisions import messages_given, plain_optimal_value, worths
from tests.explanation.problems import tiny_problems
from xplain import InputError, LabelTable, Problem
from xplain.explanation.actions import Action, VisibleState, give
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.habits import Assumed, habits_of
from xplain.solvers.base import CachedPolicy, Solver, best_action
from xplain.solvers.evaluate import evaluate, simulate
from xplain.solvers.greedy import QMDP, Baseline, Conformant, KnownType
from xplain.solvers.hsvi import Certified
from xplain.solvers.lookahead import Lookahead
from xplain.solvers.pomcp import POMCP
from xplain.solvers.process import known_values, make_process
from xplain.solvers.simple import QHR, SayAll, Silent
from xplain.testing.literal_pomdp import literal_optimal_value
from xplain.testing.problems import random_problem


@settings(deadline=None, max_examples=30)
@given(tiny_problems())
def test_tables_are_the_plain_recursion(problem: Problem) -> None:
    known = known_values(make_process(problem))
    for k in range(problem.n_steps + 1):
        for shown in range(1 << problem.n_messages):
            for t in range(problem.n_types):
                plain = plain_optimal_value(problem, t, k, shown)
                assert known.now(k, shown)[t] == pytest.approx(plain, abs=1e-9)


def idle_problem(**changes: object) -> Problem:
    """Makes a problem with three messages; the middle message changes nothing."""
    rng = np.random.default_rng(3)
    p = rng.random((2, 4, 2, 1, 2)) * np.ones((1, 1, 1, 2, 1))
    values: dict[str, object] = {"table": p.reshape(2, 4, 8), "message_cost": np.ones(3)}
    return Problem(**(values | changes))  # type: ignore[arg-type]


@pytest.mark.parametrize("trade_off", [0.0, 0.001, 1.0])
def test_a_message_without_effect_is_no_action(trade_off: float) -> None:
    """This holds even at cost 0, although it would delay later costs."""
    problem = idle_problem(trade_off=trade_off, discount=0.5)
    assert problem.messages_with_effect == (0, 2)
    for solver in (QMDP(), QHR(), Conformant(), Baseline(), Certified(), Lookahead(), POMCP()):
        policy = solver.plan(problem)
        for step in range(4):
            assert not messages_given(policy, step, 0, problem.prior) & 0b010


@pytest.mark.parametrize("solver", [QMDP(), KnownType(), Lookahead(), POMCP()])
def test_whoever_no_message_can_help_is_told_nothing(solver: Solver) -> None:
    """Each of two types needs another message, which is so cheap that even the delay would pay. A
    certain type does not get the message for the other type."""
    p = np.full((2, 12, 4), 0.5)
    p[0, :, 1::2], p[1, :, 2:] = 0.9, 0.9
    policy = solver.plan(Problem(p, np.full(2, 0.1)))
    for t in range(2):
        for step in range(12):
            assert messages_given(policy, step, 0, np.eye(2)[t]) == 1 << t
            assert not messages_given(policy, step, 1 << t, np.eye(2)[t])


def test_a_message_that_changes_an_answer_alone_is_an_action() -> None:
    """Only after this message the two types answer a question differently. By brute force the
    message saves more than a third of the cost."""
    p = np.ones((2, 2, 8))
    p[0, 1, [0, 2, 4, 6]], p[1, 1, [0, 1, 4, 5]] = 0, 0  # they need messages 0 and 1
    clip = np.full((2, 1, 8), 0.9)
    clip[1, :, 4:] = 0.1
    problem = Problem(p, np.array([5.0, 5.0, 0.1]), 10.0, discount=1.0)
    problem = replace(problem, questions=Questions(LabelTable.dense(clip), Limits(0.1)))
    assert problem.table.effective_of_any() == (0, 1)
    optimum = literal_optimal_value(problem)
    assert optimum == pytest.approx(-(0.1 + 0.1 + 5 + 0.1 * 10))
    policy = Certified(gap=1e-9).plan(problem)
    assert (policy.lower, policy.upper) == pytest.approx((optimum, optimum))
    assert evaluate(problem, policy).value == pytest.approx(optimum)
    assert 0b100 in worths(POMCP().plan(problem), 0, 0, problem.prior)


@settings(deadline=None, max_examples=30)
@given(tiny_problems(), st.integers(0, 2), st.integers(0, 3))
def test_qhr_is_the_best_set_of_its_closed_form(problem: Problem, step: int, shown: int) -> None:
    step, shown = step % problem.n_steps, shown % (1 << problem.n_messages)

    def closed_form(new: int) -> float:
        cost = problem.trade_off * sum(
            problem.message_cost[j] for j in range(problem.n_messages) if new >> j & 1
        )
        for t in range(problem.n_types):
            for j in range(step + 1, problem.n_steps + 1):
                for i in range(j):
                    zero = 1 - problem.p_explicable[t, i, shown | new]
                    cost += problem.prior[t] * problem.inexplicability_cost * zero
        return -float(cost)

    policy = QHR().plan(problem)
    chosen = messages_given(policy, step, shown, problem.prior)
    assert chosen & shown == 0
    every = [closed_form(new) for new in range(1 << problem.n_messages) if not new & shown]
    assert closed_form(chosen) == pytest.approx(max(every), abs=1e-8)
    for new, value in worths(policy, step, shown, problem.prior).items():
        assert value == pytest.approx(closed_form(new), abs=1e-8)


def test_known_type_asks_for_the_type() -> None:
    problem = idle_problem()
    with pytest.raises(InputError, match="this solver knows it"):
        messages_given(KnownType().plan(problem), 0, 0, problem.prior)


@pytest.mark.parametrize(
    ("p", "cost", "error", "said"),
    [
        # N equal types are worth N times the cost to it: more expensive than one type's zeros, but
        # cheaper than all of theirs.
        ([[0, 1]] * 3, [2.0], 0.0, 1),
        # Two rates of errors make no second person: one type's zeros do not pay for the message.
        ([[0, 1]], [1.5], "learned", 0),
        # The first message mends one type of three, the second two; each costs 1.5 zeros.
        ([[0, 1, 0, 1], [0, 0, 1, 1], [0, 0, 1, 1]], [1.5, 1.5], 0.0, 0b10),
    ],
)
def test_conformant_pays_for_every_type_undivided(
    p: list[list[float]], cost: list[float], error: Assumed, said: int
) -> None:
    """QMDP, which uses the belief, gives no message."""
    problem = Problem(np.array(p, float)[:, None], np.array(cost), discount=1.0)
    problem = problem.with_habits(habits_of(error, 1.0, 0.0))
    assert messages_given(Conformant().plan(problem), 0, 0, problem.prior) == said
    assert messages_given(QMDP().plan(problem), 0, 0, problem.prior) == 0


def test_baseline_takes_several_types_as_their_mixture() -> None:
    """A message with cost 0.5 avoids the only label 0 of the second type. The message pays if more
    than half of the users have this type, for any current belief."""
    p = np.ones((2, 1, 2))
    p[1, 0, 0] = 0
    for share, said in ((0.4, 0), (0.6, 1)):
        problem = Problem(p, np.array([0.5]), discount=1.0, prior=np.array([1 - share, share]))
        for belief in ([1.0, 0.0], [0.0, 1.0], [0.5, 0.5]):
            assert messages_given(Baseline().plan(problem), 0, 0, np.array(belief)) == said


def test_ties_prefer_explain_then_the_first_message() -> None:
    p = np.zeros((1, 1, 4))
    p[:, :, 1:] = 1
    even = Problem(p, np.array([1.0, 1.0]), discount=1.0)
    assert messages_given(QMDP().plan(even), 0, 0, even.prior) == 0
    assert messages_given(QHR().plan(even), 0, 0, even.prior) == 0
    cheap = replace(even, trade_off=0.5)
    assert messages_given(QMDP().plan(cheap), 0, 0, even.prior) == 0b01
    assert messages_given(QHR().plan(cheap), 0, 0, even.prior) == 0b01


@pytest.mark.parametrize("solver", [QHR(), Certified(), Lookahead()])
def test_of_equal_sets_the_smaller_is_given(solver: Solver) -> None:
    """{0, 1} and {2} make all transitions explicable at the same price; {3} does so, too, and is
    more expensive. The mask of {0, 1} is less than the mask of {2}."""
    p = np.zeros((1, 1, 16))
    for shown in range(16):
        p[:, :, shown] = shown & 0b0011 == 0b0011 or shown & 0b1100 != 0
    problem = Problem(p, np.array([1.0, 1.0, 2.0, 2.5]), inexplicability_cost=5.0, discount=1.0)
    assert messages_given(solver.plan(problem), 0, 0, problem.prior) == 0b0100


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(st.integers(0, 15), st.sampled_from([-2.0, -1.0, -1.0 - 1e-12, 3.0]),
                       min_size=1))  # fmt: skip
def test_the_best_set_is_the_smallest_of_the_best_then_the_first(values: dict[int, float]) -> None:
    """This holds in any order; values that differ by rounding are equal."""
    tied = [chosen for chosen, value in values.items() if value > max(values.values()) - 1e-10]
    fewest = min(bin(chosen).count("1") for chosen in tied)
    first = min(chosen for chosen in tied if bin(chosen).count("1") == fewest)
    assert best_action({give(one): value for one, value in values.items()}) == give(first)


def test_simulation_has_no_noise_where_the_type_is_known() -> None:
    """Only the labels are random then, and they change no decision."""
    labels = np.random.default_rng(7).random((3, 6, 8))[1:2] < 0.6
    cost = np.array([0.3, 0.9, 0.5])
    alone = Problem(np.where(labels, 0.95, 0.05), cost, inexplicability_cost=1.5, discount=0.8)
    # Two messages at once: the order of their prices matters.
    assert messages_given(QMDP().plan(alone), 1, 0, alone.prior) == 0b011
    for policy in (QMDP().plan(alone), Conformant().plan(alone), Counting()):
        worth, exact = simulate(alone, CachedPolicy(policy), 5, seed=2), evaluate(alone, policy)
        assert (worth.value, worth.cost) == (pytest.approx(exact.value), pytest.approx(exact.cost))
        assert max(worth.value_se, worth.cost_se) < 1e-12


@dataclass
class Counting:
    """A silent policy that counts its decisions."""

    asked: int = 0

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        self.asked += 1
        return give(0)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> dict[Action, float]:
        return {}


def test_beliefs_are_evaluated_once_each() -> None:
    """With four equal transitions and two types, the number of labels 1 so far decides the belief.
    Labels that all types give alike give no information."""
    policy, p = Counting(), np.array([0.9, 0.4])[:, None, None] * np.ones((1, 4, 1))
    worth = evaluate(Problem(p, np.empty(0), discount=1.0), policy)
    assert policy.asked == 1 + 2 + 4 + 7  # 0, 1, 3 and 6 labels seen
    assert worth.cost == pytest.approx((1 + 2 + 3 + 4) * (0.1 + 0.6) / 2)
    policy, p = Counting(), np.array([0.3, 0.8, 0.5])[None, :, None] * np.ones((4, 1, 1))
    evaluate(Problem(p, np.empty(0)), policy)
    assert policy.asked == 3


def test_what_they_are_worth_is_a_sum_over_prefixes(rng_of_the_day: np.random.Generator) -> None:
    """The value is an expectation without a belief: transition i is labelled at the steps i … m −
    1."""
    for _ in range(30):
        problem = random_problem(rng_of_the_day)
        m, everything = problem.n_steps, (1 << problem.n_messages) - 1
        zeros = problem.prior @ (1 - problem.p_explicable).transpose(1, 0, 2)  # [m, 2^n]
        for solver, said in ((Silent(), 0), (SayAll(), everything)):
            weights = np.arange(m, 0, -1)
            expected = problem.inexplicability_cost * (weights @ zeros[:, said])
            if said:
                expected += problem.trade_off * problem.message_cost.sum()
            worth = evaluate(problem, solver.plan(problem), beliefs=100_000)
            assert worth.value_is == "exact"
            assert worth.cost == pytest.approx(expected)
