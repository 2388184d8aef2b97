"""Compares solvers whose actions include questions with brute force and with each other."""

from dataclasses import replace

import numpy as np
import pytest

from tests.decisions import question_asked, worth_by_enumeration, worths
from tests.solvers.test_optimum import asking
from xplain import LabelTable, Problem
from xplain.explanation.actions import EXPLAIN, Action, AskQuestion, VisibleState
from xplain.explanation.asking import Limits, Questions
from xplain.explanation.belief import update_by_answer
from xplain.explanation.message_sets import indices
from xplain.solvers.base import Solver, best_action
from xplain.solvers.bounds import bounds
from xplain.solvers.evaluate import evaluate
from xplain.solvers.greedy import QMDP
from xplain.solvers.hsvi import Certified, Effort
from xplain.solvers.pomcp import POMCP
from xplain.solvers.process import make_process
from xplain.solvers.voi import NO_NEWS, telling_questions
from xplain.testing.literal_pomdp import EXPLAIN as EXPLAIN_
from xplain.testing.literal_pomdp import LiteralPOMDP, LiteralState
from xplain.testing.problems import random_problem, with_questions

CLOSE = Effort(gap=1e-9, nodes=100_000, memory_gib=1.0)


@pytest.mark.parametrize("solver", [QMDP(), POMCP()])
def test_to_be_able_to_ask_costs_nothing(solver: QMDP | POMCP) -> None:
    """Exact costs on problems without discounts are lower on average, nowhere much higher, and near
    the certified optimum."""
    rng = np.random.default_rng(13)
    changes, gaps = [], []
    for _ in range(40):
        problem = asking(rng, undiscounted=True)
        without = replace(problem, questions=Questions())
        cost = evaluate(problem, solver.plan(problem, 0)).cost
        changes.append(cost - evaluate(without, solver.plan(without, 0)).cost)
        gaps.append(cost + bounds(problem, CLOSE).upper)
    assert min(changes) < -0.05
    assert np.mean(changes) <= 0.01
    assert np.mean(gaps) <= 0.03


def test_open_questions_are_those_of_the_rule_that_tell_something() -> None:
    """Among alike questions the first has the largest information of those that may still be
    asked."""
    rng = np.random.default_rng(14)
    for _ in range(60):
        problem = with_questions(rng, random_problem(rng, 4, 2, 2), 7)
        questions, process = problem.questions, make_process(problem)
        asked = int(rng.integers(1 << len(questions)) & rng.integers(1 << len(questions)))
        step, given = int(rng.integers(problem.n_steps)), int(rng.integers(1 << problem.n_messages))
        belief = rng.dirichlet(np.ones(problem.n_types))
        found, nats = telling_questions(process, VisibleState(step, given, asked), belief)
        news, labels = {}, questions.table.label_probabilities(len(questions), given).T >= 0.5
        shown, heard = frozenset(indices(given)), frozenset(indices(asked))
        state = LiteralState(step, (), shown, frozenset(), 0, asked=heard)
        open_ = [EXPLAIN_ - 1 - a for a in LiteralPOMDP(problem).actions(state) if a < EXPLAIN_]
        for q in open_:
            alike = (labels == labels[q]).all(axis=1)
            for other in np.flatnonzero(alike).tolist():
                p = questions.table.answer_probabilities(other + 1, given)[:, other]
                told = entropy(belief @ p) - belief @ [entropy(x) for x in p]
                if told > NO_NEWS and other >= q and not asked >> other & 1:
                    news[q] = max(news.get(q, 0.0), told)
        assert sorted(found) == sorted(news)
        np.testing.assert_allclose(nats, sorted(news.values(), reverse=True))
        few, _ = telling_questions(process, VisibleState(step, given, asked), belief, most=2)
        assert few == found[:2]


def entropy(p: float) -> float:
    return float(-sum(x * np.log(x) for x in (p, 1 - p) if x > 0))


def test_second_opinions_are_worth_asking_for_where_answers_err() -> None:
    """Two clips are alike, and each answer is wrong once in ten. Each type needs its message; the
    other message has no effect on it. Solvers ask both clips while they are cheap, and never the
    first a second time."""
    p = np.zeros((2, 1, 4))
    p[0, 0, 1::2] = 1  # type 0 needs message 0
    p[1, 0, 2:] = 1  # type 1 message 1
    problem = Problem(p, np.full(2, 4.0), inexplicability_cost=40.0, discount=1.0)
    clip = np.full((2, 2, 4), 0.9)
    clip[1] = 0.1
    problem = replace(problem, questions=Questions(LabelTable.dense(clip), Limits(cost=0.01)))
    for solver in (Certified(gap=1e-9), POMCP()):
        policy = solver.plan(problem, 0)
        first = question_asked(policy, 0, 0, problem.prior)
        after = update_by_answer(problem, problem.prior, 0, first, 1)
        second = question_asked(policy, 0, 0, after, 1 << first)
        assert (first, second) == (0, 1)
        last = update_by_answer(problem, after, 0, second, 1)
        assert question_asked(policy, 0, 0, last, 0b11) is None


@pytest.mark.parametrize("solver", [Certified(nodes=20), POMCP(100), QMDP()])
def test_of_more_questions_than_an_integer_has_bits_each_comes_once(solver: Solver) -> None:
    rng = np.random.default_rng(17)
    table = LabelTable.dense(rng.uniform(0.1, 0.9, (2, 70, 1)))
    problem = Problem(np.array([[[0.2]] * 2, [[0.9]] * 2]), np.empty(0))
    policy = solver.plan(replace(problem, questions=Questions(table, Limits(0.0, 70))), 0)
    for asked in (1, 61, 62, 63, 66):
        left = [~a for a in worths(policy, 0, 0, problem.prior, (1 << asked) - 1) if a < 0]
        assert min(left) >= asked


def test_of_equally_good_questions_the_nearest() -> None:
    far, near = AskQuestion(3), AskQuestion(1)
    assert best_action({EXPLAIN: -1.0, far: -0.5, near: -0.5}) == near
    assert best_action({EXPLAIN: -0.5, far: -0.5}) == EXPLAIN
    assert best_action({EXPLAIN: -0.5}) == EXPLAIN


def test_of_questions_that_tell_the_same_qmdp_asks_the_first() -> None:
    """Each second question is the opposite of the first: only rounding tells their values apart."""
    rng, asked = np.random.default_rng(16), []
    for _ in range(40):
        problem = asking(rng)
        table = problem.questions.table.p[:1]
        both = LabelTable.dense(np.concatenate([table, 1 - table]).transpose(2, 0, 1))
        problem = replace(problem, questions=Questions(both, problem.questions.limits))
        asked.append(question_asked(QMDP().plan(problem), 0, 0, problem.prior))
    assert {*asked} == {0, None}


class AsksWhereUnlikely:
    """A policy without messages that asks question 0 at the second step if type 1 is likely."""

    def decide(self, visible: VisibleState, belief: np.ndarray) -> Action:
        asks = visible.step == 1 and belief[1] > 0.5 and not visible.asked
        return AskQuestion(0) if asks else EXPLAIN

    def values(self, visible: VisibleState, belief: np.ndarray) -> dict[Action, float]:
        return {}


def test_a_question_is_part_of_what_an_unlikely_belief_may_cost() -> None:
    """One user in 2,000 is asked a question, at a high cost."""
    table = np.repeat(np.array([[1.0, 1.0], [0.0, 1.0]])[:, :, None], 2, axis=2)
    answers = np.array([0.0, 1.0])[:, None, None].repeat(2, axis=2)
    questions = Questions(LabelTable.dense(answers), Limits(1000.0, 1, "anytime"))
    prior = np.array([0.9995, 0.0005])
    problem = Problem(LabelTable.dense(table), np.ones(1), prior=prior, questions=questions)
    policy = AsksWhereUnlikely()
    found, true = (
        evaluate(problem, policy, precision=0.01),
        worth_by_enumeration(problem, policy)[0],
    )
    assert true < -0.4
    assert found.value_is == "exact"
    assert found.value == pytest.approx(true, abs=0.01 * (1 - true))
