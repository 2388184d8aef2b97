"""Beliefs after labels: Bayes' rule, what counts as evidence, impossible labels, all ways to miss
and forget messages. Questions: which ones may be asked, and what they are worth."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import strategies as st

from xplain import LabelTable, Problem
from xplain.explanation.actions import AskQuestion
from xplain.explanation.asking import Limits, Questions, alike_first, nearest_first
from xplain.explanation.belief import (
    Persistent,
    round_belief,
    update,
)
from xplain.explanation.habits import Habits
from xplain.interaction.dialogue import (
    Dialogue,
    QuestionAnswered,
    StepLabelled,
)
from xplain.solvers.greedy import QMDP
from xplain.testing.literal_pomdp import literal_optimal_value
from xplain.testing.problems import random_problem, with_questions


def test_labels_that_types_cannot_give_rule_them_out_or_nobody() -> None:
    """Types a, b call the one transition explicable, c does not; d has probability 0. A label that
    no type can give leaves the belief unchanged: not uniform, not the prior, not NaN."""
    p = np.array([1.0, 1.0, 0.0, 0.5])[:, None, None]
    problem = Problem(p, np.empty(0), prior=np.array([0.2, 0.3, 0.5, 0.0]))
    no, yes = (update(problem, problem.prior, 0, np.array([label], np.uint8)) for label in (0, 1))
    assert yes == pytest.approx([0.4, 0.6, 0.0, 0.0])
    assert no.tolist() == [0.0, 0.0, 1.0, 0.0]
    before = np.array([0.4, 0.6, 0.0, 0.0])
    after = update(problem, before, 0, np.array([0], dtype=np.uint8))
    assert after.tolist() == [0.4, 0.6, 0.0, 0.0]
    after[0] = 9
    assert before[0] == 0.4


def test_a_thousand_labels_do_not_underflow() -> None:
    """Probabilities of about 1e-1000 each; the ratio is (0.1 / 0.1001) to the 1000th."""
    p = np.array([0.1, 0.1001])[:, None, None] * np.ones((1, 1000, 1))
    problem = Problem(p, np.empty(0))
    belief = update(problem, problem.prior, 0, np.ones(1000, dtype=np.uint8))
    assert belief[0] / belief[1] == pytest.approx((0.1 / 0.1001) ** 1000, rel=1e-9)


def test_rounding_makes_beliefs_equal_whatever_the_order_of_evidence() -> None:
    rng = np.random.default_rng(0)
    problem = Problem(rng.random((3, 6, 1)), np.empty(0))
    labels = rng.integers(0, 2, 6).astype(np.uint8)
    beliefs = []
    for order in (range(6), reversed(range(6))):
        belief = problem.prior
        for i in order:
            belief = update(problem, belief, 0, labels, slice(i, i + 1))
        beliefs.append(belief)
    assert np.array_equal(round_belief(beliefs[0]), round_belief(beliefs[1]))
    assert round_belief(beliefs[0]) == pytest.approx(beliefs[0], abs=1e-12)
    assert not np.array_equal(round_belief(np.array([0.5])), round_belief(np.array([0.5 + 1e-11])))


def test_who_cannot_tell_says_nothing() -> None:
    """After a label 2 the belief is the same as after the other labels alone, also later."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        problem = random_problem(rng)
        labels = rng.integers(3, size=problem.n_steps).astype(np.uint8)
        shown = int(rng.integers(1 << problem.n_messages))
        after = update(problem, problem.start, shown, labels)
        assert after == pytest.approx(update(problem, problem.start, shown, labels, labels < 2))
    p = np.array([[[0.9]] * 3, [[0.3]] * 3])
    three = Problem(p, np.empty(0), copies=np.zeros(3, np.int64))
    for second in ((1, 2), (2, 1), (1, 1)):  # copies; people who repeat themselves then say 1
        events = [*map(StepLabelled, ((2,), second, (1, 1, 1)))]
        talk = Dialogue(three, QMDP().plan(three), Persistent(), events)
        assert talk.state.belief == pytest.approx([0.75, 0.25])


seeds = st.integers(0, 2**32 - 1)


def habits(rng: np.random.Generator, count: int = 2) -> Habits:
    """Draws habits of users, at least one of whom misses or forgets messages."""
    accept = rng.choice([1.0, 0.8, 0.3], count)
    forget = rng.choice([0.0, 0.1, 0.6], count)
    forget[0] = forget[0] or 0.2
    return Habits(rng.choice([0.0, 0.2], count), accept, forget, rng.dirichlet(np.ones(count)))


def problem_of(seed: int, types: int = 2, steps: int = 2, messages: int = 2) -> Problem:
    """Draws a random problem in which messages may be missed or forgotten."""
    rng = np.random.default_rng(seed)
    while True:
        problem = random_problem(rng, types, steps, messages)
        if len(problem.habits) == 1:
            return problem.with_habits(habits(rng, int(rng.integers(1, 3))))


def test_a_message_that_changes_answers_alone_has_an_effect() -> None:
    table = LabelTable.dense(np.full((1, 2, 4), 0.5), np.full((1, 2, 4), 0.5))
    table.answers[:, 2:] = 0.7
    assert table.effective() == [(1,)]
    assert table.effective_of_any() == (1,)


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
    """Compares the selection with its definition. Answers differ from labels, and decide whether
    types answer alike."""
    rng = np.random.default_rng(1)
    for most in (1, 3, 5, 8, 20) * 8:
        p, answers = rng.choice([0.1, 0.4, 0.6, 0.9], (2, 2, 12, 2))
        told = [q for q in range(12) if (answers[0, q] != answers[1, q]).any()]

        def place(q: int, labels: np.ndarray = p > 0.5, told: list[int] = told) -> tuple[int, ...]:
            alike = (labels[:, told] == labels[:, [q]])[:, [x < q for x in told]]
            return int(alike.all(axis=(0, 2)).sum()), int(alike[..., 0].all(axis=0).any()), q

        kept = alike_first(LabelTable.dense(p, answers), most)
        assert kept.tolist() == sorted(sorted(told, key=place)[:most])
    # After message 0 types differ in the answer to the first question, and never in the second.
    asked = [[[0, 1, 0, 1], [0, 0, 1, 1]]] * 2
    assert alike_first(LabelTable.by_type([[0, 2], [1, 2]], asked), 5).tolist() == [0]


def test_the_nearest_differ_in_the_fewest_features() -> None:
    """A feature with one value alone does not matter."""
    trace = np.array([[0.0, 0.0, 2.0], [5.0, 1.0, 2.0]])
    clips = np.array([[4.0, 7.0, 2.0], [5.0, 1.0, 2.0], [10.0, 1.0, 2.0], [3.0, 1.0, 2.0]])
    assert nearest_first(clips, trace).tolist() == [1, 3, 2, 0]  # in 0, 1, 1 and 2 features


@pytest.mark.parametrize("seed", range(20))
def test_questions_that_do_not_say_what_they_show_show_nothing_of_the_trace(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = with_questions(rng, random_problem(rng))
    asking = problem.questions
    beliefs = []
    for shows in (np.zeros((len(asking), problem.n_steps), np.bool_), np.empty((0, 0), np.bool_)):
        own = replace(problem, questions=replace(asking, shows=shows))
        talk = Dialogue(own, QMDP().plan(own), Persistent())
        talk.hear(AskQuestion(0), QuestionAnswered(1))
        talk.hear(*(StepLabelled((1,) * k) for k in range(1, own.n_steps + 1)))
        beliefs.append(talk.state.belief)
    assert np.array_equal(*beliefs)
