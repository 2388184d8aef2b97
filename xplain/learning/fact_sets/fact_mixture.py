"""Who holds which facts wrong, and how answers err, as a mixture over all people.

Shares of (fact set, variant, deviation), f of their cells, slips, guesses and error rates are found
together by expectation maximisation, as in a diagnosis of skills (DINA), where f is given. All of
it is soft: whom a sampler puts into the type that suits their mistakes does not seem to make any.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, softmax

from xplain.learning import answer_model
from xplain.learning.answer_model import AnswerModel, summed
from xplain.learning.fact_sets.known_transitions import Answers, KnownTransitions
from xplain.learning.fact_sets.likelihood import log_prior, truth

ROUNDS, AS_SAID = 30, 5
"""Of expectation maximisation; in the first ones f is as the hypotheses say."""
STEPS = 3
"""Towards other slips, guesses and error rates, in a round."""


def mixture(
    known: KnownTransitions,
    answers: Answers,
    person: NDArray[np.int64],
    people: int,
    facts: NDArray[np.int64],
    log_new: NDArray[np.float64],
    level: float,
) -> tuple[NDArray[np.float64], AnswerModel, NDArray[np.float64] | None]:
    """P(fact set) of each person [O, R]; how answers err; and P(answer 1) of each person about all
    rows of features that hypotheses know, with nothing told [O, U]: None where somebody was told
    something.

    Args:
        known: the hypotheses.
        answers: P of them.
        person: [P] who gave it.
        people: O, with those who gave none.
        facts: [R] candidates.
        log_new: [R] log prior weight of each.
        level: slips and guesses at first.
    """
    count = known.share.shape[2]
    key = known.hypotheses.row(facts[:, None] & ~answers.message_set) * count + answers.transition
    one = np.stack([truth(known.by_cell[row], known.hypotheses.sizes) for row in key])
    one = one.reshape(*key.shape, -1).transpose(0, 2, 1)  # P(f = 1): [R, (1 + V) D, P]
    odds = np.log(one / (1 - one))
    cells = [np.unique(row, return_inverse=True)[1] for row in key]
    prior = np.exp(log_new[:, None] + log_prior(known.hypotheses).ravel())
    share = prior = prior / prior.sum()
    about = answers.transition, person, answers.label
    each = answer_model.CellAnswers(np.arange(len(person)), *about)
    given = np.log(np.where(answers.label[:, None] == np.arange(2), 1 - level, level))
    made: AnswerModel | float = level
    for turn in range(ROUNDS):
        log_each = np.log((1 - one) * np.exp(given[:, 0]) + one * np.exp(given[:, 1]))
        joint = summed(np.moveaxis(log_each, 2, 0), person, people) + np.log(share)
        weight = softmax(joint, axis=(1, 2))  # [O, R, (1 + V) D]
        share = (weight.sum(axis=0) + prior) / (people + 1)
        others = softmax(np.moveaxis(joint[person], 0, 2) - log_each, axis=(0, 1))
        f = (others * one).sum(axis=(0, 1))  # of each answer, by all others of its person
        made = answer_model.learned(each, f, count, people, made, STEPS)
        given = made.log_given(*about)
        if turn >= AS_SAID:  # … and by all other answers in its cell
            said = np.moveaxis(weight[person], 0, 2) * (given[:, 1] - given[:, 0])
            for r, cell in enumerate(cells):
                total = summed(said[r].T, cell, cell.max() + 1)[cell].T
                one[r] = expit(odds[r] + total - said[r])
    assert isinstance(made, AnswerModel)
    if answers.message_set.any():
        return weight.sum(axis=2), made, None
    said = np.moveaxis(weight[person], 0, 2) * (given[:, 1] - given[:, 0])
    return weight.sum(axis=2), made, _expected(known, facts, answers, weight, said, made)


def _expected(
    known: KnownTransitions,
    facts: NDArray[np.int64],
    answers: Answers,
    weight: NDArray[np.float64],
    said: NDArray[np.float64],
    made: AnswerModel,
) -> NDArray[np.float64]:
    """P(answer 1) of each person about all rows of features, with nothing told: [O, U].

    Args:
        known, facts, answers: as for :func:`mixture`.
        weight: [O, R, (1 + V) D] posterior of each person.
        said: [R, (1 + V) D, P] what each answer says for f = 1 (log), by who may have given it.
        made: how answers err.
    """
    count = known.share.shape[2]
    result = np.zeros((len(weight), count))
    for r, held in enumerate(known.hypotheses.row(facts).tolist()):
        cells = held * count + np.arange(count)
        f = truth(known.by_cell[cells], known.hypotheses.sizes).reshape(count, -1)
        f = expit(np.log(f / (1 - f)) + summed(said[r].T, answers.transition, count))
        zero, both = made.given(np.arange(count))[:, :, :1].transpose(1, 0, 2)  # of rate 0
        result += weight[:, r] @ ((1 - f) * zero + f * both).T
    rate = (made.person[:-1] @ made.errors.rates)[:, None]
    return np.asarray((1 - rate) * result + rate * (1 - result))
