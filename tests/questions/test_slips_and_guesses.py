"""Questions with their own slips and guesses, and questions without messages."""

import itertools

import numpy as np
import pytest

from xplain import Questionnaire
from xplain.errors import InputError
from xplain.questions.questionnaire import NONE_ERROR

FACTS, ITEMS = 3, 9


def table(rng: np.random.Generator) -> np.ndarray:
    """Makes labels [2^3, T]: 0 if a fact that the item needs is believed incorrectly."""
    sets = np.arange(1 << FACTS)[:, None]
    needed = rng.integers(1, 1 << FACTS, ITEMS)
    needed[:FACTS] = 1 << np.arange(FACTS)  # so that all can be told apart
    return ((sets & needed) == 0).astype(np.uint8)


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    slip, guess = rng.uniform(0.02, 0.3, (2, ITEMS))
    return table(rng), slip, guess, rng.dirichlet(np.ones(1 << FACTS))


def channel(label: int, slip: float, guess: float, error: float) -> float:
    """Computes P(answer 1)."""
    one = 1 - slip if label else guess
    return (1 - error) * one + error * (1 - one)


def joint(labels, slip, guess, prior, error, none, asked):
    """Computes P(layer, candidate, all answers), by the definition: layers are "fits" and "none
    fits"."""
    result = np.zeros((2, len(labels)))
    for layer, (share, own) in enumerate(((1 - none, error), (none, NONE_ERROR))):
        for held in range(len(labels)):
            value = share * prior[held]
            for item, told, answer in asked:
                one = channel(labels[held & ~told, item], slip[item], guess[item], own)
                value *= one if answer else 1 - one
            result[layer, held] = value
    return result


@pytest.mark.parametrize("seed", range(5))
def test_the_posterior_and_the_information_are_those_of_enumeration(seed: int) -> None:
    labels, slip, guess, prior = drawn(seed)
    rng = np.random.default_rng(seed + 100)
    questions = Questionnaire(labels, 0.07, prior, none=0.04, slip=slip, guess=guess)
    answered = []
    for _ in range(6):
        item, told, answer = int(rng.integers(ITEMS)), int(rng.integers(8)), int(rng.integers(2))
        answered.append((item, told, answer))
        questions.answer(answer, (item, told))
        exact = joint(labels, slip, guess, prior, 0.07, 0.04, answered)
        assert questions.posterior == pytest.approx(exact[0] / exact.sum())
        assert questions.none == pytest.approx(exact[1].sum() / exact.sum())
    for item, told in ((0, 0), (3, 2), (8, 5)):
        both = np.stack(
            [
                joint(labels, slip, guess, prior, 0.07, 0.04, [*answered, (item, told, y)])
                for y in (0, 1)
            ]
        )
        both /= both.sum()
        apart = both.sum(axis=0, keepdims=True) * both.sum(axis=(1, 2), keepdims=True)
        bits = float((both * np.log2(both / apart)).sum())
        assert questions.information((item, told)) == pytest.approx(bits)
    both_steps = sum(questions.information((t, 2)) for t in (0, 5))
    assert questions.information(([0, 5], 2)) == pytest.approx(both_steps)


@pytest.mark.parametrize("told", [True, False])
def test_each_question_is_the_one_that_tells_most(told: bool) -> None:
    for seed in range(4):
        labels, slip, guess, prior = drawn(seed)
        questions = Questionnaire(labels, 0.03, prior, slip=slip, guess=guess, told=told)
        rng = np.random.default_rng(seed)
        left = set(range(ITEMS))
        for _ in range(6):
            item, messages = questions.next()
            sets = range(8) if told else [0]
            every = itertools.product(range(ITEMS) if told else left, sets)
            best = max(questions.information(one) for one in every)
            assert questions.information((item, messages)) == pytest.approx(best, abs=1e-9)
            assert told or messages == 0
            left.discard(item)
            questions.answer(int(rng.integers(2)))


def test_with_nothing_told_no_question_comes_more_often_than_allowed() -> None:
    labels = drawn(0)[0]
    for repeats in (1, 2):
        questions = Questionnaire(labels, 0.05, told=False, repeats=repeats)
        asked = []
        for _ in range(repeats * ITEMS):
            asked.append(questions.next())
            questions.answer(1)
        assert sorted(asked) == sorted([(t, 0) for t in range(ITEMS)] * repeats)
        with pytest.raises(InputError, match="every question was asked"):
            questions.next()


def test_examinees_are_known_after_ten_questions() -> None:
    """Five skills; of 300 items each needs one to three. A choice that knows each question's rates
    needs fewer questions than a choice that knows one error rate."""
    right, until = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        sets = np.arange(32)[:, None]
        skills = [rng.choice(5, rng.integers(1, 4), replace=False) for _ in range(300)]
        needed = np.array([(1 << own).sum() for own in skills])
        labels = ((sets & needed) == 0).astype(np.uint8)
        slip, guess = rng.uniform(0.05, 0.15, (2, 300))
        item_bank = Questionnaire(labels, 0.0, none=0.0, slip=slip, guess=guess, told=False)
        for person in range(40):
            held, questions = int(rng.integers(32)), item_bank.restart(None, person)
            number = 0
            while number < 10 or not questions.done:
                item, _ = questions.next()
                one = channel(labels[held, item], slip[item], guess[item], 0.0)
                questions.answer(int(rng.random() < one))
                number += 1
                if number == 10:
                    right.append(questions.best == held)
                if questions.done and len(until) < len(right) + (number < 10):
                    until.append(number)
    assert np.mean(right) >= 0.88  # four standard errors below 0.95
    assert np.mean(until) <= 11
