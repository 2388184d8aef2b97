"""Questions: which ones may be asked, the information of their answers, and the correctness of the
model."""

from dataclasses import replace

import numpy as np
import pytest

from xplain.explanation.actions import EXPLAIN, Action, AskQuestion, VisibleState
from xplain.explanation.asking import (
    Limits,
    Questions,
    alike_first,
    nearest_first,
)
from xplain.explanation.belief import Independent, Persistent, update_by_answer
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.interaction.dialogue import (
    Dialogue,
    MessagesGiven,
    QuestionAnswered,
    QuestionAsked,
    StepLabelled,
)
from xplain.testing.literal_pomdp import literal_optimal_value
from xplain.testing.problems import random_problem, with_questions


def test_what_a_question_is_worth_by_hand() -> None:
    """Type 0 needs the message (1.0 of λ C_e) or pays 3 over two steps, type 1 needs nothing, and
    labels come too late. The question separates them for κ = 0.2: 0.2 + ½ · 1 instead of 1."""
    p = np.array([[[0, 1], [0, 1]], [[1, 1], [1, 1]]], dtype=float)
    problem = Problem(p, np.array([1.0]), discount=1.0, inexplicability_cost=10.0)
    table = LabelTable.dense(np.array([[[0, 0]], [[1, 1]]], dtype=float))
    asking = replace(problem, questions=Questions(table, Limits(cost=0.2)))
    assert literal_optimal_value(problem) == pytest.approx(-1.0)
    assert literal_optimal_value(asking) == pytest.approx(-0.7)


def test_second_opinions_come_after_every_kind() -> None:
    rng = np.random.default_rng(1)
    kinds = np.array([[0, 1, 1], [1, 0, 1], [0, 0, 1]])
    which = rng.integers(3, size=40)
    p = np.where(kinds[which] == 1, 0.9, 0.1).T[:, :, None]
    kept = alike_first(LabelTable.dense(p), 5)
    firsts = [int(np.flatnonzero(which == kind)[0]) for kind in range(3)]
    assert set(firsts) <= set(kept.tolist())
    assert len(kept) == 5
    seconds = sorted(int(np.flatnonzero(which == kind)[1]) for kind in range(3))
    assert sorted(set(kept.tolist()) - set(firsts)) == seconds[:2]


def test_the_nearest_differ_in_the_fewest_features() -> None:
    trace = np.array([[0.0, 0.0], [5.0, 1.0]])
    clips = np.array([[4.0, 7.0], [5.0, 1.0], [10.0, 1.0], [3.0, 1.0]])
    assert nearest_first(clips, trace).tolist() == [1, 3, 2, 0]  # in 0, 1, 1 and 2 features


@pytest.mark.parametrize("accept", [1.0, 0.7])
def test_an_answer_is_weighed_by_bayes(accept: float) -> None:
    """This also holds if messages may be missed."""
    rng = np.random.default_rng(3)
    problem = Problem(rng.random((2, 2, 2)), np.ones(1))
    table = LabelTable.dense(rng.random((2, 3, 2)))
    problem = replace(problem, questions=Questions(table))
    habits = Habits(np.array([0.1]), np.array([accept]), np.zeros(1), np.ones(1))
    problem = problem.with_habits(habits)
    belief = rng.dirichlet(np.ones(problem.start.size))
    yes = table.p[2] * 0.8 + 0.1  # [2^n, N]
    p = yes.ravel() if accept < 1 else yes[1]
    for answer in (0, 1):
        expected = belief * (p if answer else 1 - p)
        found = update_by_answer(problem, belief, 1, 2, answer)
        np.testing.assert_allclose(found, expected / expected.sum(), rtol=1e-12)


class AsksAll:
    """A policy that asks every possible question, and gives no messages."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.heard: list[int] = []

    def decide(self, visible: VisibleState, belief: np.ndarray) -> Action:
        self.heard.append(visible.asked)
        count = len(self.problem.questions)
        left = [q for q in range(count) if not visible.asked >> q & 1]
        return AskQuestion(left[0]) if left else EXPLAIN

    def values(self, visible: VisibleState, belief: np.ndarray) -> dict[Action, float]:
        return {EXPLAIN: 0.0}


def clip_of_the_second_transition() -> Problem:
    rng = np.random.default_rng(4)
    problem = Problem(rng.uniform(0.2, 0.8, (2, 3, 2)), np.ones(1))
    table = problem.table.of_steps([1])
    shows = np.array([[False, True, False]])
    return replace(problem, questions=Questions(table, Limits(), shows))


@pytest.mark.parametrize("seed", range(20))
def test_questions_that_do_not_say_what_they_show_show_nothing_of_the_trace(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = with_questions(rng, random_problem(rng))
    asking = problem.questions
    beliefs = []
    for shows in (np.zeros((len(asking), problem.n_steps), np.bool_), np.empty((0, 0), np.bool_)):
        own = replace(problem, questions=replace(asking, shows=shows))
        talk = Dialogue(own, AsksAll(own), Persistent())
        talk.hear(QuestionAsked(0), QuestionAnswered(1))
        talk.hear(*(StepLabelled((1,) * k) for k in range(1, own.n_steps + 1)))
        beliefs.append(talk.state.belief)
    assert np.array_equal(*beliefs)


def test_a_clip_is_the_label_of_its_transition_where_people_repeat_themselves() -> None:
    """Persistent: the belief after clip and labels is the same as after the labels alone.
    Independent: the clip counts as an additional label."""
    problem = clip_of_the_second_transition()
    labels = [(1,), (1, 0), (1, 0, 1)]
    for update in (Persistent(), Independent()):
        ends = []
        for asks in (True, False):
            talk = Dialogue(problem, AsksAll(problem), update)
            if asks:
                assert talk.decide() == AskQuestion(0)
                talk.hear(QuestionAsked(0), QuestionAnswered(0))
            talk.hear(*map(StepLabelled, labels))
            ends.append(talk.state.belief)
        assert np.allclose(*ends) == isinstance(update, Persistent)


def test_what_was_answered_as_a_label_is_not_asked_again() -> None:
    problem = clip_of_the_second_transition()
    for update, again in ((Persistent(), EXPLAIN), (Independent(), AskQuestion(0))):
        talk = Dialogue(problem, AsksAll(problem), update)
        talk.hear(StepLabelled((1,)))
        assert talk.decide() == AskQuestion(0)  # the second transition was not shown yet
        talk.hear(StepLabelled((1, 0)))
        assert talk.decide() == again
        talk.hear(MessagesGiven(1))
        assert talk.decide() == AskQuestion(0)  # after a message it is another question
