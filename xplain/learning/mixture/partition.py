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
from scipy.special import gammaln, logsumexp, softmax

from xplain.learning import answers as answer_model
from xplain.learning.answers import AnswerModel, CellAnswers, summed
from xplain.learning.mixture.likelihood import (
    ERROR,
    Answers,
    Cells,
    KnownTransitions,
    by_level,
    cell_posterior,
    log_cell,
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
    cells, questions = Cells.of(known, answers, facts), known.share.shape[2]
    group = cells.where.T.ravel()
    one = before = cells.one.reshape(len(cells.one), -1)[cells.where.T]  # [P, R, (1 + V) D]
    prior = np.exp(log_new[:, None] + known.log_prior.ravel())
    share = prior = prior / prior.sum()
    about = answers.transition, person, answers.label
    each = CellAnswers(np.arange(len(person)), *about)
    given = np.log(np.where(answers.label[:, None] == np.arange(2), 1 - level, level))
    made: AnswerModel | float = level
    for turn in range(ROUNDS):
        log_each = log_cell(one, *given.T[:, :, None, None])
        joint = summed(log_each, person, people) + np.log(share)
        weight = softmax(joint, axis=(1, 2))  # [O, R, (1 + V) D]
        share = (weight.sum(axis=0) + prior) / (people + 1)
        others = softmax(joint[person] - log_each, axis=(1, 2))
        f = (others * one).sum(axis=(1, 2))  # of each answer, by all others of its person
        made = answer_model.learned(each, f, questions, people, made, STEPS)
        given = made.log_given(*about)
        said = weight[person] * np.diff(given)[:, :, None]  # for f = 1, by who may have given it
        if turn >= AS_SAID:  # … and by all other answers in its cell
            total = summed(said.reshape(len(group), -1), group, len(cells.key))
            one = cell_posterior(before, total[group].reshape(said.shape) - said)
    assert isinstance(made, AnswerModel)
    if answers.message_set.any():
        return weight.sum(axis=2), made, None
    key = known.hypotheses.row(facts) * questions + np.arange(questions)[:, None]
    said = summed(said, answers.transition, questions)
    f = cell_posterior(known.truth(key).reshape(said.shape), said)
    zero, both = made.given(np.arange(questions))[:, :, 0].T[:, :, None, None]  # of rate 0
    one = ((1 - f) * zero + f * both).reshape(questions, -1)
    expected = weight.reshape(people, -1) @ one.T
    rate = (made.person[:-1] @ answer_model.RATES)[:, None]
    return weight.sum(axis=2), made, (1 - rate) * expected + rate * (1 - expected)


CANDIDATE = 0.01
"""A fact set starts as a candidate where somebody's own answers give it so much."""
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
    search = _Search(known, observers, concentration)
    alone = search.alike()
    kept = np.union1d(alone.argmax(axis=1), np.flatnonzero(alone.max(axis=0) > CANDIDATE))
    about = known, search.every, search.person, len(observers)
    candidates = search.facts[kept], search.log_new[kept]
    weight, answers, expected = mixture(*about, *candidates, search.level)
    search.heed(answers)
    state = np.asarray(kept[weight.argmax(axis=1)])
    search.merge(state)
    answers = search.learn(state)
    search.merge(state)
    return Partition(search.facts[state], answers, expected)


def errors_of(
    known: KnownTransitions, observers: list[Answers], types: NDArray[np.int64]
) -> AnswerModel:
    """How answers err, the types [O] of the observers being given."""
    search = _Search(known, observers, 1.0)
    search.alike()
    search.learn(search.best_of(types))
    return search.learn(search.best_of(types))


class _Search:
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

    def alike(self) -> NDArray[np.float64]:
        """All answers err as often, with the probability that makes them likeliest, everybody being
        of a type of their own. Returns what each then believes incorrectly: [O, R]."""
        levels = by_level(self.every.label)
        alone = np.stack([self._log_sum(rows, self.facts, levels) for rows in self.rows])
        alone += self.log_new[:, None]
        likely = logsumexp(alone, axis=1).sum(axis=0).argmax()
        self.level, self.given = float(ERROR[likely]), levels[:, :, [likely]]
        return np.asarray(softmax(alone[:, :, likely], axis=1))

    def learn(self, state: NDArray[np.int64]) -> AnswerModel:
        """Learns how answers err, given the current types; the search uses this model from then
        on."""
        cell, priors, count = np.zeros(len(self.person), dtype=np.int64), [], 0
        for r in np.unique(state).tolist():
            rows = np.flatnonzero(state[self.person] == r)
            cells = Cells.of(self.known, self.every.take(rows), self.facts[[r]])
            weight = cells.log_likelihood(self.given[rows])[0, :, :, 0] + self.known.log_prior
            cell[rows] = count + cells.where[0]
            priors.append((cells.one * softmax(weight)).sum(axis=(1, 2)))
            count += len(cells.key)
        about = CellAnswers(cell, self.every.transition, self.person, self.every.label)
        sizes = self.known.share.shape[2], len(self.rows)
        made = answer_model.learned(about, np.concatenate(priors), *sizes, self.level)
        self.heed(made)
        return made

    def heed(self, answers: AnswerModel) -> None:
        """Uses this model of errors from now on."""
        about = self.every.transition, self.person, self.every.label
        self.given = answers.log_given(*about)[:, :, None]

    def best_of(self, types: NDArray[np.int64]) -> NDArray[np.int64]:
        """The likeliest fact set of each type, given who is of it: [O]."""
        state = np.zeros(len(types), dtype=np.int64)
        for one in np.unique(types):
            members = np.flatnonzero(types == one)
            state[members] = (self._together(members.tolist(), self.facts) + self.log_new).argmax()
        return state

    def _together(self, members: Sequence[int], facts: NDArray[np.int64]) -> NDArray[np.float64]:
        """log P(answers of the members | they are of one type R) of some fact sets: [R]."""
        rows = np.concatenate([self.rows[o] for o in members])
        return self._log_sum(rows, facts, self.given)[:, 0]

    def _log_sum(
        self, rows: NDArray[np.int64], facts: NDArray[np.int64], given: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """log P(some answers | they are of one type R, level), log P(each answer | f) being
        ``given`` [P, 2, E]: [R, E]."""
        value = Cells.of(self.known, self.every.take(rows), facts).log_likelihood(given[rows])
        return np.asarray(logsumexp(value + self.known.log_prior[:, :, None], axis=(1, 2)))

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
