"""The error model of answers: the label f is what a person thinks, the answer y is what they say.

Question τ has a slip s and a guess g, person i an error rate e::

    a = f (1 − s_τ) + (1 − f) g_τ,      P(y = 1 | f, τ, i) = (1 − e_i) a + e_i (1 − a)

Slips and guesses are as in the DINA model (Junker & Sijtsma 2001, "Cognitive assessment models with
few assumptions"). There, f = 1 means that a person has all skills that an item needs. The error
rate is added. Empirical Bayes learns slips, guesses and error rates from the answers of all people.

If all people make errors equally often, the answers look as if all questions had slips. Such errors
are counted as slips: the most likely error rate in the population is 0. The majority answer of a
type is its label: slips and guesses are below ½ and never explain a majority. Slips and guesses of
questions are shrunk to one common mean. If slips seem more frequent than guesses over all
questions, then f probably differs from its prior.
"""

from dataclasses import dataclass, field
from math import prod

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, softmax

from xplain.explanation.habits import UNKNOWN, WAYS, Habits
from xplain.learning.data.dataset import Dataset

RATES, RATE_PRIOR = map(np.array, UNKNOWN["error"])
"""The possible error rates e, here and in explanations, and their prior without answers."""
PEOPLE = 2.0
"""The prior of the error rates counts as this number of people."""
MEAN = 0.02
"""Prior mean of slips and of guesses."""
WEIGHT = 50.0
"""The prior of :data:`MEAN` counts as this number of answers."""
SHRINKAGE = np.array([16.0, 32, 64, 128])
"""Possible weights of the mean over all questions, in answers to each question. The weight with the
highest likelihood is used."""
LOWEST, HIGHEST = 0.002, 0.45
"""Range of slips and guesses."""
MAJORITY = 3
"""A cell with at least this number of answers has a majority."""
DEVIATES = 0.05
"""While slips are learned, f of a cell with a majority differs from its prior with at least this
probability, because the majority answer of a type is its label."""
STEPS = 60
"""Maximum number of steps of expectation maximisation. The steps end earlier if no value changes by
more than STILL."""
STILL = 1e-4


@dataclass(frozen=True)
class AnswerModel:
    """The error model for T questions and O people.

    Attributes:
        slip, guess: [T + 1] P(a = 0 | f = 1) and P(a = 1 | f = 0) of each question; the last entry
            is for a question without answers. slip + guess < 1.
        person: [O + 1, E] posterior over :data:`RATES` of each person; the last row is for a person
            without answers.
        ways: [5] shares of people by their way of answering, as in WAYS.
        observers: [K, 3] facts and ways of K observers, as in
            :func:`xplain.learning.mixture.partition.learn_ways`; None if unknown.
    """

    slip: NDArray[np.float64]
    guess: NDArray[np.float64]
    person: NDArray[np.float64]
    ways: NDArray[np.float64] = field(default_factory=WAYS.copy)
    observers: NDArray[np.int64] | None = None

    @property
    def prior(self) -> NDArray[np.float64]:
        """[E] probabilities of the error rates of the next person."""
        return self.person[-1]

    @property
    def habits(self) -> Habits:
        """Habits of an unknown person at an unknown question. Slips and guesses become one
        symmetric rate. Answers give no information about messages that are not accepted, so all
        messages count as accepted."""
        mean, whole = (self.slip[-1] + self.guess[-1]) / 2, np.ones(len(RATES))
        return Habits(mean + RATES * (1 - 2 * mean), whole, 0 * whole, self.prior, self.ways)

    def log_given(self, answers: Dataset) -> NDArray[np.float64]:
        """Computes [P, 2] log P(y | f) of P answers for f = 0 and 1. Index −1 is an unknown
        question or person, who has the average rates."""
        each = _compute_likelihood(self.slip, self.guess, answers)
        return np.asarray(np.log((each * self.person[answers.observer][:, None, :]).sum(axis=2)))

    def predict(self, question: NDArray[np.int64]) -> NDArray[np.float64]:
        """Computes [P, 2, E] P(y = 1 | f, e) of P questions."""
        return predict_answers(self.slip[question], self.guess[question])

    def wrong(self, question: NDArray[np.int64], person: NDArray[np.int64]) -> float:
        """Computes the expected share of answers that differ from the label, if f = 0 and f = 1 are
        equally likely.

        Args:
            question, person: [P] indices of the question and the person of each answer.
        """
        slip = (self.slip[question] + self.guess[question]) / 2
        rate = self.person[person] @ RATES
        return float((slip + rate * (1 - 2 * slip)).mean())


def predict_answers(slip: NDArray[np.float64], guess: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes [P, 2, E] P(y = 1) of P questions for f = 0, 1 and each error rate."""
    one = np.stack([guess, 1 - slip], axis=-1)[..., None]
    return np.asarray((1 - RATES) * one + RATES * (1 - one))


def _compute_likelihood(
    slip: NDArray[np.float64], guess: NDArray[np.float64], answers: Dataset
) -> NDArray[np.float64]:
    """Computes [P, 2, E] P(y | f, e) of P answers; their transitions are the questions."""
    one = predict_answers(slip[answers.transition], guess[answers.transition])
    return np.where(answers.label[:, None, None] == 1, one, 1 - one)


def truth(
    one: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Converts the share of answers 1 to the share of labels f = 1, such as an accuracy measured on
    answers to an accuracy about labels.

    Args:
        one: P(y = 1).
        low: P(y = 1 | f = 0).
        high: P(y = 1 | f = 1).

    Returns:
        P(f = 1).
    """
    return np.asarray(((one - low) / (high - low)).clip(0.0, 1.0))


def learn_answers(
    answers: Dataset,
    cell: NDArray[np.int64],
    prior: NDArray[np.float64],
    start: AnswerModel | float = MEAN,
    steps: int = STEPS,
) -> AnswerModel:
    """Learns slips, guesses and error rates by expectation maximisation.

    For each answer, belief propagation computes the evidence of all other answers about the f of
    its cell and the error rate of its person. This evidence is exact if no two people share two
    cells.

    Args:
        answers: P answers of O people to T questions, which are the dataset's transitions. Message
            sets are not used.
        cell: [P] the cell of each answer, of C. A cell is a group of answers with the same f.
        prior: [C] P(f = 1) of each cell before any answer.
        start: initial model, or initial slip and guess.
        steps: maximum number of steps.
    """
    counted, people = np.bincount(cell, minlength=len(prior)), len(answers.observers)
    off = np.where(counted >= MAJORITY, DEVIATES, 1e-6)
    log_prior = np.log(np.stack([1 - prior, prior], axis=1).clip(off[:, None], 1 - off[:, None]))
    if isinstance(start, AnswerModel):
        slip, guess, share = start.slip, start.guess, start.prior
    else:
        slip, guess = np.full((2, len(answers.features) + 1), max(start, LOWEST))
        share = RATE_PRIOR
    rate = np.tile(share, (len(answers), 1))  # [P, E] from the person's other answers
    for _ in range(steps):
        before = np.concatenate([slip, guess, share])
        given = _compute_likelihood(slip, guess, answers)
        said = np.log((given * rate[:, None, :]).sum(axis=2))
        thought = softmax(log_prior[cell] + _sum_others(said, cell, len(prior)), axis=1)
        heard = np.log((given * thought[:, :, None]).sum(axis=1))
        rate = softmax(np.log(share) + _sum_others(heard, answers.observer, people), axis=1)
        person = softmax(np.log(share) + sum_by_group(heard, answers.observer, people), axis=1)
        share = _estimate_population(person)
        weight = thought[:, :, None] * rate[:, None, :] * given
        weight /= weight.sum(axis=(1, 2), keepdims=True)
        slip, guess = _estimate_slips(slip, guess, weight, answers)
        if np.abs(np.concatenate([slip, guess, share]) - before).max() < STILL:
            break
    return AnswerModel(slip, guess, np.vstack([person, share]))


def sum_by_group(
    values: NDArray[np.float64], group: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Computes the sum of each group of rows.

    Args:
        values: [N, …].
        group: [N] index of the group of each row.
        count: number of groups.

    Returns:
        [count, …] the sums.
    """
    columns = values.reshape(len(values), prod(values.shape[1:])).T
    total = np.stack([np.bincount(group, column, count) for column in columns], axis=1)
    return np.asarray(total.reshape(count, *values.shape[1:]))


def _sum_others(
    values: NDArray[np.float64], group: NDArray[np.int64], count: int
) -> NDArray[np.float64]:
    """Computes for each row the sum of all other rows of the same group.

    Args:
        values: [P, K].
        group: [P] index of the group of each row.
        count: number of groups.

    Returns:
        [P, K] the sums.
    """
    return np.asarray(sum_by_group(values, group, count)[group] - values)


def _estimate_population(person: NDArray[np.float64]) -> NDArray[np.float64]:
    """Estimates the distribution of error rates over people. The share of the rate 0 is raised to
    the largest share.

    Args:
        person: [O, E] posterior of each person's error rate.

    Returns:
        [E] the probability of each rate.
    """
    share = (person.sum(axis=0) + PEOPLE * RATE_PRIOR) / (len(person) + PEOPLE)
    share[0] = share.max()
    return np.asarray(share / share.sum())


def _estimate_slips(
    slip: NDArray[np.float64],
    guess: NDArray[np.float64],
    weight: NDArray[np.float64],
    answers: Dataset,
) -> NDArray[np.float64]:
    """Estimates the slips and guesses of all questions. Errors that a person's error rate explains
    do not count as slips or guesses.

    Args:
        slip, guess: [T + 1] the previous estimates.
        weight: [P, 2, E] posterior of (f, error rate) for each answer.
        answers: P answers.

    Returns:
        [2, T + 1] slips, and guesses.
    """
    question, counts = answers.transition, np.zeros((2, 2, len(slip) - 1))
    for f, before in ((1, slip), (0, guess)):
        unlike = (answers.label != f)[:, None]
        chance = before[question][:, None]
        slipped = chance * np.where(unlike, 1 - RATES, RATES)
        kept = (1 - chance) * np.where(unlike, RATES, 1 - RATES)
        times = (weight[:, f] * slipped / (slipped + kept)).sum(axis=1)
        for i, own in enumerate((times, weight[:, f].sum(axis=1) - times)):
            counts[1 - f, i] = np.bincount(question, own, len(slip) - 1)
    times, others = counts[:, 0], counts[:, 1]  # [2, T] slips and guesses, and answers without them
    mean = (times.sum() + WEIGHT * MEAN) / (counts.sum() + WEIGHT)
    first, second = SHRINKAGE[:, None, None] * mean, SHRINKAGE[:, None, None] * (1 - mean)
    gain = betaln(first + times, second + others) - betaln(first, second)
    kappa = SHRINKAGE[gain.sum(axis=(1, 2)).argmax()]
    own = (times + kappa * mean) / (times + others + kappa)
    return np.pad(own, ((0, 0), (0, 1)), constant_values=mean).clip(LOWEST, HIGHEST)
