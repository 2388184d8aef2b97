"""Compares the answer model with its definition, a sum over all truths, and with people whose
errors are known."""

from itertools import product

import numpy as np
import pytest

from xplain.learning.answers import (
    RATES,
    AnswerModel,
    CellAnswers,
    learn_answers,
)


def simulated(seed, errors, slips, people=20, each=40, types=4, sure=0.9995):
    """Draws answers of people with these error rates, in turn, to questions with these slips; f is
    mostly as expected. The cells are (type, question)."""
    rng = np.random.default_rng(seed)
    questions = len(slips)
    f = rng.integers(0, 2, (types, questions))
    prior = np.where(f == 1, sure, 1 - sure)
    person = np.repeat(np.arange(people), each)
    question = rng.integers(0, questions, len(person))
    kind = person % types
    thought = f[kind, question]
    said = np.where(rng.random(len(person)) < np.array(slips)[question] * thought, 0, thought)
    error = np.resize(errors, people * types).reshape(types, -1).T.ravel()[:people]
    label = said ^ (rng.random(len(person)) < error[person])
    cell = kind * questions + question
    answers = CellAnswers(cell, question, person, label.astype(np.int64))
    return learn_answers(answers, prior.ravel(), questions, people), error


def mean_rate(model):
    return model.person[:-1] @ RATES


@pytest.mark.parametrize("seed", range(3))
def test_who_errs_and_who_does_not_is_told_apart(seed):
    model, error = simulated(seed, [0.0, 0.3], [0.0] * 60)
    assert mean_rate(model)[error == 0].max() < 0.05
    assert mean_rate(model)[error == 0.3].min() > 0.15
    assert model.prior[:2].sum() == pytest.approx(0.5, abs=0.15)
    assert model.prior[3:].sum() == pytest.approx(0.45, abs=0.15)
    assert model.slip.max() < 0.06


@pytest.mark.parametrize("error", [0.05, 0.15])
def test_errors_that_all_share_are_slips(error):
    model, _ = simulated(1, [error], [0.0] * 60, people=60)
    assert model.prior.argmax() == 0
    assert (model.slip[-1] + model.guess[-1]) / 2 == pytest.approx(error, abs=0.03)
    assert model.habits.error @ model.habits.prior == pytest.approx(error, abs=0.03)
    assert mean_rate(model).mean() < 0.02


def test_slips_of_single_questions_are_found():
    slips = [0.3] * 4 + [0.0] * 26
    model, _ = simulated(3, [0.0], slips, people=100)
    assert model.slip[:4] == pytest.approx(0.3, abs=0.1)
    assert model.slip[4:-1].max() < 0.1
    assert model.guess.max() < 0.1


def test_what_most_of_a_type_answer_is_what_they_think():
    """The prior is almost certainly 1, but all people of a type say 0 about ten questions: slips do
    not explain this, although slips are common at first. If only one in four says 0, it is a
    slip."""
    rng = np.random.default_rng(0)
    person = np.repeat(np.arange(8), 60)
    question = np.tile(np.arange(60), 8)
    kind = person // 4
    for contrary, allowed in ((np.arange(8) < 4, 0.05), (np.arange(8) % 4 == 0, 1.0)):
        label = np.where(contrary[person] & (question < 10), 0, 1)
        cell = rng.permutation(120)[kind * 60 + question]
        answers = CellAnswers(cell, question, person, label)
        model = learn_answers(answers, np.full(120, 1 - 1e-6), 60, 8, start=0.1)
        assert model.slip[:10].max() < allowed
        assert (mean_rate(model).max() < 0.01) == (allowed < 1)


def test_a_person_is_judged_as_by_the_sum_over_all_truths():
    """No two people share two cells, so that the posterior is exact."""
    cell, person = np.array([0, 1, 2, 2, 3, 4]), np.array([0, 0, 0, 1, 1, 1])
    label = np.array([1, 0, 1, 0, 0, 0])
    prior = np.array([0.9, 0.8, 0.3, 0.6, 0.05])
    answers = CellAnswers(cell, cell, person, label)
    model = learn_answers(answers, prior, 5, 2, steps=500)
    joint = np.zeros((5, 5))
    for f in product((0, 1), repeat=5):
        chance = np.prod(np.where(np.array(f) == 1, prior, 1 - prior))
        for i, j in product(range(5), repeat=2):
            rate = RATES[[i, j]][person]
            thought = np.array(f)[cell]
            one = np.where(thought == 1, 1 - model.slip[cell], model.guess[cell])
            one = one * (1 - rate) + (1 - one) * rate
            share = model.prior[i] * model.prior[j]
            joint[i, j] += share * chance * np.prod(np.where(label == 1, one, 1 - one))
    joint /= joint.sum()
    assert model.person[0] == pytest.approx(joint.sum(axis=1), abs=2e-3)
    assert model.person[1] == pytest.approx(joint.sum(axis=0), abs=2e-3)


def test_what_is_said_of_an_answer_is_a_mean_over_the_persons_rates():
    person = np.array([[1.0, 0, 0, 0, 0], [0, 0, 0, 0, 1], [0.75, 0, 0, 0.25, 0]])
    model = AnswerModel(np.array([0.1, 0.2]), np.array([0.05, 0.2]), person)
    question, who, label = np.array([0, 0, -1]), np.array([0, 1, -1]), np.array([1, 0, 1])
    expected = [
        [0.05, 0.9],
        [0.65 * 0.95 + 0.35 * 0.05, 0.65 * 0.1 + 0.35 * 0.9],
        [0.75 * 0.2 + 0.25 * (0.8 * 0.2 + 0.2 * 0.8), 0.75 * 0.8 + 0.25 * (0.8 * 0.8 + 0.2 * 0.2)],
    ]
    assert np.exp(model.log_given(question, who, label)) == pytest.approx(np.array(expected))
    assert model.wrong(question[:1], who[:1]) == pytest.approx((0.1 + 0.05) / 2)
