"""An answer is not a label: f is what a person thinks, y what they click.

Question τ has a slip s and a guess g, person i an error rate e::

    a = f (1 − s_τ) + (1 − f) g_τ,      P(y = 1 | f, τ, i) = (1 − e_i) a + e_i (1 − a)

Slips and guesses are those of the DINA model (Junker & Sijtsma 2001, "Cognitive assessment models
with few assumptions"), where f says whether a person has all skills that an item needs; the error
rate is added. All three are learned from everybody's answers by empirical Bayes. Errors that all
people share cannot be told from slips that all questions share: they are taken to be slips, as the
likeliest error rate of the population is 0. What most of a type answer is what they think: a slip
or a guess is less likely than ½, and never explains such a majority. Slips and guesses have one
mean, towards which those of a question are shrunk: if slips seem more frequent than guesses over
all questions, more likely f differs from what was expected.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, softmax

from xplain.explanation.habits import UNKNOWN, Habits

RATES, RATE_PRIOR = map(np.array, UNKNOWN["error"])
"""The error rates e that are told apart, here as in explanations, and their probabilities where no
answers were learned from."""
PEOPLE = 2.0
"""This prior counts as so many people."""
MEAN = 0.02
"""Mean of slips and of guesses before any answer."""
WEIGHT = 50.0
"""The prior of :data:`MEAN` weighs as much as so many answers."""
SHRINKAGE = np.array([16.0, 32, 64, 128])
"""Answers of which the mean of all questions has the weight for each of them: the one of these
that makes the answers likeliest."""
LOWEST, HIGHEST = 0.002, 0.45
"""Slips and guesses stay between."""
MAJORITY = 3
"""A cell with so many answers has a majority."""
DEVIATES = 0.05
"""In a cell with a majority, f differs from what is expected with at least this probability while
slips are learned: what most of a type answer is what they think."""
STEPS = 60
"""Steps of the expectation maximisation, at most; it ends when nothing moves by more than STILL."""
STILL = 1e-4


@dataclass(frozen=True)
class AnswerModel:
    """How labels become answers, of T questions and O people.

    Attributes:
        slip, guess: [T + 1] P(a = 0 | f = 1) and P(a = 1 | f = 0) of each question; the last are
            those of a question that nobody answered. slip + guess < 1.
        person: [O + 1, E] posterior over :data:`RATES` of each person; the last row is of a person
            who gave no answer.
    """

    slip: NDArray[np.float64]
    guess: NDArray[np.float64]
    person: NDArray[np.float64]

    @property
    def prior(self) -> NDArray[np.float64]:
        """[E] probabilities of the error rates of the next person."""
        return self.person[-1]

    @property
    def habits(self) -> Habits:
        """Habits of the next person at a question that nobody answered. Slips and guesses are one
        symmetric rate; the answers say nothing about messages that do not land."""
        mean, whole = (self.slip[-1] + self.guess[-1]) / 2, np.ones(len(RATES))
        return Habits(mean + RATES * (1 - 2 * mean), whole, 0 * whole, self.prior)

    def log_given(
        self, question: NDArray[np.int64], person: NDArray[np.int64], label: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """log P(y | f = 0 and 1) of P answers: [P, 2]. The index −1 stands for an unknown question
        or person, for which the mean of all is taken."""
        each = self.likelihood(question, label)
        return np.asarray(np.log((each * self.person[person][:, None, :]).sum(axis=2)))

    def likelihood(
        self, question: NDArray[np.int64], label: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(y | f, e) of P answers: [P, 2, E]."""
        one = self.given(question)
        return np.asarray(np.where(label[:, None, None] == 1, one, 1 - one))

    def given(self, question: NDArray[np.int64]) -> NDArray[np.float64]:
        """P(y = 1 | f, e) of P questions: [P, 2, E]."""
        return answered(self.slip[question], self.guess[question])

    def wrong(self, question: NDArray[np.int64], person: NDArray[np.int64]) -> float:
        """Share of these answers [P] that differ from what the person thinks, if f = 0 and f = 1
        are equally likely."""
        slip = (self.slip[question] + self.guess[question]) / 2
        rate = self.person[person] @ RATES
        return float((slip + rate * (1 - 2 * slip)).mean())


def answered(slip: NDArray[np.float64], guess: NDArray[np.float64]) -> NDArray[np.float64]:
    """P(y = 1) of P questions by f = 0, 1 and error rate: [P, 2, E]."""
    one = np.stack([guess, 1 - slip], axis=-1)[..., None]
    return np.asarray((1 - RATES) * one + RATES * (1 - one))


def truth(
    one: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """P(f = 1) of cases whose answers are 1 with probability ``one``. Answers are 1 with
    probability ``low`` where f is 0, and ``high`` where f is 1. So an accuracy measured on answers
    becomes one about f."""
    return np.asarray(((one - low) / (high - low)).clip(0.0, 1.0))


class CellAnswers(NamedTuple):
    """P answers: ``cell`` [P], which share one f, ``question`` [P], ``person`` [P] and ``label``
    [P], of 0 and 1."""

    cell: NDArray[np.int64]
    question: NDArray[np.int64]
    person: NDArray[np.int64]
    label: NDArray[np.int64]


def learned(
    answers: CellAnswers,
    prior: NDArray[np.float64],
    questions: int,
    people: int,
    start: AnswerModel | float = MEAN,
    steps: int = STEPS,
) -> AnswerModel:
    """Slips, guesses and error rates by expectation maximisation.

    Belief propagation computes what each answer tells about its cell's f and its person's rate,
    given all other answers. It is exact where no two people share two cells.

    Args:
        answers: P of them.
        prior: [C] P(f = 1) of each cell before any answer.
        questions, people: T and O, with those who gave no answer.
        start: where to begin, or slips and guesses at first.
        steps: at most.
    """
    counted = np.bincount(answers.cell, minlength=len(prior))
    off = np.where(counted >= MAJORITY, DEVIATES, 1e-6)
    log_prior = np.log(np.stack([1 - prior, prior], axis=1).clip(off[:, None], 1 - off[:, None]))
    if isinstance(start, AnswerModel):
        slip, guess, share = start.slip, start.guess, start.prior
    else:
        slip, guess = np.full((2, questions + 1), max(start, LOWEST))
        share = RATE_PRIOR
    rate = np.tile(share, (len(answers.cell), 1))  # [P, E] of each answer's person, by the others'
    for _ in range(steps):
        before = np.concatenate([slip, guess, share])
        one = answered(slip[answers.question], guess[answers.question])
        given = np.where(answers.label[:, None, None] == 1, one, 1 - one)  # [P, 2, E]
        said = np.log((given * rate[:, None, :]).sum(axis=2))
        thought = softmax(log_prior[answers.cell] + _others(said, answers.cell, len(prior)), axis=1)
        heard = np.log((given * thought[:, :, None]).sum(axis=1))
        rate = softmax(np.log(share) + _others(heard, answers.person, people), axis=1)
        person = softmax(np.log(share) + summed(heard, answers.person, people), axis=1)
        share = _population(person)
        weight = thought[:, :, None] * rate[:, None, :] * given
        weight /= weight.sum(axis=(1, 2), keepdims=True)
        slip, guess = _slips(slip, guess, weight, answers)
        if np.abs(np.concatenate([slip, guess, share]) - before).max() < STILL:
            break
    return AnswerModel(slip, guess, np.vstack([person, share]))


def summed(
    values: NDArray[np.float64], group: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Sums of ``values`` [N, …] by group [N]: [count, …]."""
    columns = values.reshape(len(values), prod(values.shape[1:])).T
    total = np.stack([np.bincount(group, column, count) for column in columns], axis=1)
    return np.asarray(total.reshape(count, *values.shape[1:]))


def _others(
    values: NDArray[np.float64], group: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """For each row the sum of the other rows of its group: [P, K]."""
    return np.asarray(summed(values, group, count)[group] - values)


def _population(person: NDArray[np.float64]) -> NDArray[np.float64]:
    """[E] how many people have which error rate; 0 is the likeliest."""
    share = (person.sum(axis=0) + PEOPLE * RATE_PRIOR) / (len(person) + PEOPLE)
    share[0] = share.max()
    return np.asarray(share / share.sum())


def _slips(
    slip: NDArray[np.float64],
    guess: NDArray[np.float64],
    weight: NDArray[np.float64],
    answers: CellAnswers,
) -> NDArray[np.float64]:
    """Slips and guesses [2, T + 1] of answers whose f and error rate have the probabilities
    ``weight`` [P, 2, E]. A person's earlier answers tell how much of them is that person's own
    error."""
    question, counts = answers.question, np.zeros((2, 2, len(slip) - 1))
    for f, before in ((1, slip), (0, guess)):
        unlike = (answers.label != f)[:, None]
        chance = before[question][:, None]
        slipped = chance * np.where(unlike, 1 - RATES, RATES)
        kept = (1 - chance) * np.where(unlike, RATES, 1 - RATES)
        times = (weight[:, f] * slipped / (slipped + kept)).sum(axis=1)
        for i, own in enumerate((times, weight[:, f].sum(axis=1) - times)):
            counts[1 - f, i] = np.bincount(question, own, len(slip) - 1)
    times, others = counts[:, 0], counts[:, 1]  # [2, T] slips and guesses, and all else
    mean = (times.sum() + WEIGHT * MEAN) / (counts.sum() + WEIGHT)
    first, second = SHRINKAGE[:, None, None] * mean, SHRINKAGE[:, None, None] * (1 - mean)
    gain = betaln(first + times, second + others) - betaln(first, second)
    kappa = SHRINKAGE[gain.sum(axis=(1, 2)).argmax()]
    own = (times + kappa * mean) / (times + others + kappa)
    return np.pad(own, ((0, 0), (0, 1)), constant_values=mean).clip(LOWEST, HIGHEST)
