"""Which fact sets observers have, and how their answers err.

At first a mixture over all people: shares of (fact set, variant, deviation), f of their cells,
slips, guesses and error rates are found together by expectation maximisation, as in a diagnosis of
skills (DINA), where f is given. All of it is soft: if each person had the type that suits their
mistakes, nobody would seem to make any.

Then types are shared by a Chinese restaurant process, as in :mod:`xplain.learning.mixture.sampler`.
Nothing is sampled: hypotheses leave so few fact sets that the likeliest sharing is found by merging
(benchmarks/README.md compares).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, gammaln, logsumexp, softmax

from xplain.learning import answers as answer_model
from xplain.learning.answers import AnswerModel, summed
from xplain.learning.mixture.likelihood import (
    ERROR,
    Answers,
    Cells,
    KnownTransitions,
    by_level,
    log_prior,
    truth,
)

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


CANDIDATE = 0.01
"""A fact set starts as a candidate where somebody's own answers give it so much."""
MOST_CELLS = 1 << 22
"""Numbers that are worked out at a time."""
SURER = 1e-6
"""Gain (log) of a move that is made."""
TRIED = 5
"""Fact sets that are tried for a type that two would make."""


class Partition(NamedTuple):
    """Types of observers.

    Attributes:
        facts: [O] of each observer's type.
        answers: how answers err, questions being the rows of features that hypotheses know.
        expected: [O, U] P(answer 1) of each observer about every row of features that hypotheses
            know, with nothing told, by a mixture over all people: it trusts hypotheses more than
            types do. None where somebody was told something.
    """

    facts: NDArray[np.int64]
    answers: AnswerModel
    expected: NDArray[np.float64] | None


def partition(known: KnownTransitions, observers: list[Answers], concentration: float) -> Partition:
    """The likeliest sharing of types by observers: everybody's own best fact set at first, and
    merges while they pay, before and after it is learned how answers err.

    Args:
        known: the hypotheses.
        observers: the answers of each.
        concentration: α of the Chinese restaurant process.
    """
    search = _Sampling(known, observers, concentration)
    state = search.start()
    search.merge(state)
    search.learn(state)
    search.merge(state)
    return Partition(search.facts[state], search.answers, search.expected)


def errors_of(
    known: KnownTransitions, observers: list[Answers], types: NDArray[np.int64]
) -> AnswerModel:
    """How answers err, the types [O] of the observers being given."""
    search = _Sampling(known, observers, 1.0)
    search.alike()
    search.learn(search.best_of(types))
    return search.learn(search.best_of(types))


class _Sampling:
    """What is known in :func:`partition`, whose state is an index into ``facts`` for each
    observer."""

    def __init__(
        self, known: KnownTransitions, observers: list[Answers], concentration: float
    ) -> None:
        self.known, self.every = known, Answers.joined(observers)
        sizes = [len(one.label) for one in observers]
        self.person = np.repeat(np.arange(len(observers)), sizes)
        self.rows = np.split(np.arange(len(self.person)), np.cumsum(sizes)[:-1])
        # One candidate stands for all that behave alike.
        self.facts = reduce(np.union1d, [known.supported(answers) for answers in observers])
        self.log_new = np.log(concentration) + np.log(known.prior_of(self.facts))
        self.log_prior = log_prior(known.hypotheses)

    def alike(self) -> NDArray[np.float64]:
        """All answers err as often, with the probability that makes them likeliest, everybody being
        of a type of their own. Returns what each then holds wrong: [O, R]."""
        levels = by_level(self.every.label)
        alone = self._of_each(levels) + self.log_new[:, None]
        likely = logsumexp(alone, axis=1).sum(axis=0).argmax()
        self.level, self.given = float(ERROR[likely]), levels[:, :, likely]
        return np.asarray(softmax(alone[:, :, likely], axis=1))

    def start(self) -> NDArray[np.int64]:
        """The likeliest fact set of each observer [O], by a mixture of those that somebody's own
        answers make likely."""
        alone = self.alike()
        kept = np.union1d(alone.argmax(axis=1), np.flatnonzero(alone.max(axis=0) > CANDIDATE))
        about = self.known, self.every, self.person, len(self.rows)
        found = mixture(*about, self.facts[kept], self.log_new[kept], self.level)
        weight, answers, self.expected = found
        self._heed(answers)
        return np.asarray(kept[weight.argmax(axis=1)])

    def learn(self, state: NDArray[np.int64]) -> AnswerModel:
        """How answers err, the types being as they are; from then on they are taken to."""
        cell, priors, count = np.zeros(len(self.person), dtype=np.int64), [], 0
        for r in np.unique(state).tolist():
            rows = np.flatnonzero(state[self.person] == r)
            cells = self._cells(rows, self.facts[[r]])
            weight = softmax(cells.log_likelihood(1)[0, :, :, 0] + self.log_prior)
            one = truth(cells.share, cells.sizes) * weight
            cell[rows] = count + cells.where[0]
            priors.append(one.sum(axis=(1, 2)))
            count += len(one)
        question, label = self.every.transition, self.every.label
        about = answer_model.CellAnswers(cell, question, self.person, label)
        sizes = self.known.share.shape[2], len(self.rows)
        made = answer_model.learned(about, np.concatenate(priors), *sizes, self.level)
        self._heed(made)
        return made

    def _heed(self, answers: AnswerModel) -> None:
        about = self.every.transition, self.person, self.every.label
        self.answers, self.given = answers, answers.log_given(*about)

    def best_of(self, types: NDArray[np.int64]) -> NDArray[np.int64]:
        """The likeliest fact set of each type, given who is of it: [O]."""
        state = np.zeros(len(types), dtype=np.int64)
        for one in np.unique(types):
            members = np.flatnonzero(types == one)
            state[members] = (self._together(members.tolist(), self.facts) + self.log_new).argmax()
        return state

    def _of_each(self, levels: NDArray[np.float64]) -> NDArray[np.float64]:
        """log P(answers of each observer | R, level): [O, R, E]; some observers at a time."""
        layers = self.log_prior.size * levels.shape[2] * len(self.facts)
        size = np.cumsum([len(rows) * layers for rows in self.rows]) // MOST_CELLS
        parts = []
        for part in np.split(np.arange(len(self.rows)), np.flatnonzero(np.diff(size)) + 1):
            rows = np.concatenate([self.rows[o] for o in part.tolist()])
            who = self.person[rows] - part[0]
            cells = Cells.of(self.known, self.every.take(rows), self.facts, levels[rows], who)
            value = self._log_sum(cells.log_likelihood(len(part) * len(self.facts)))
            parts.append(value.reshape(len(part), len(self.facts), -1))
        return np.concatenate(parts)

    def _together(self, members: Sequence[int], facts: NDArray[np.int64]) -> NDArray[np.float64]:
        """log P(answers of the members | they are of one type R) of some fact sets: [R]."""
        cells = self._cells(np.concatenate([self.rows[o] for o in members]), facts)
        return self._log_sum(cells.log_likelihood(len(facts)))[:, 0]

    def _cells(self, rows: NDArray[np.int64], facts: NDArray[np.int64]) -> Cells:
        """Of some answers, were they of one type."""
        return Cells.of(self.known, self.every.take(rows), facts, self.given[rows][:, :, None])

    def _log_sum(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """log Σ prior · exp over variants and deviations: [K, 1 + V, D, E] → [K, E]."""
        return np.asarray(logsumexp(values + self.log_prior[:, :, None], axis=(1, 2)))

    def merge(self, state: NDArray[np.int64]) -> None:
        """Gives the type that gains most by it other facts that nobody has, or merges two under the
        facts that then fit best, while one gains; in place."""
        alone: dict[tuple[int, ...], NDArray[np.float64]] = {}
        both: dict[tuple[int, ...], float] = {}
        while True:
            used = np.unique(state)
            members = [tuple(np.flatnonzero(state == r).tolist()) for r in used]
            for own in members:
                if own not in alone:
                    alone[own] = self._together(own, self.facts) + self.log_new
            now = [alone[m][r] + gammaln(len(m)) for m, r in zip(members, used, strict=True)]
            best, gain = None, SURER
            for m, value in zip(members, now, strict=True):
                free = alone[m] + gammaln(len(m)) - value
                free[used] = -np.inf
                if (more := free.max()) > gain:
                    best, gain = (m, int(free.argmax())), more
            for i, j in combinations(range(len(used)), 2):
                pair = members[i] + members[j]
                rough = alone[members[i]] + alone[members[j]] - self.log_new
                rough[np.setdiff1d(used, used[[i, j]])] = -np.inf
                for r in np.argsort(-rough, kind="stable")[:TRIED].tolist():
                    if (r, *pair) not in both:
                        value = self._together(pair, self.facts[[r]])[0]
                        both[r, *pair] = float(value + self.log_new[r] + gammaln(len(pair)))
                    if (more := both[r, *pair] - now[i] - now[j]) > gain and rough[r] > -np.inf:
                        best, gain = (pair, r), more
            if best is None:
                return
            state[list(best[0])] = best[1]
