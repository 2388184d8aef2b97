"""Finds the types of observers, as fact sets, and the error rates of their answers.

The first step fits a mixture over all people by expectation maximisation. It estimates together:
the shares of (fact set, variant, deviation), the label f of each cell
(:mod:`xplain.learning.mixture.likelihood`), slips, guesses and error rates. Cognitive diagnosis
(DINA) is similar, but there the labels f are known. Each person has a probability of each fact set.
If each person had only the best fact set, this set would also explain the person's errors, and
people would seem to make none.

The second step assigns observers to types by a Chinese restaurant process, as in
:mod:`xplain.learning.mixture.sampler`, but without sampling. Hypotheses leave so few fact sets that
merging types finds the most likely partition (both methods are compared in benchmarks/README.md).
"""

from collections.abc import Sequence
from functools import reduce
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp, softmax

from xplain.explanation import anybody
from xplain.explanation.habits import WAYS
from xplain.explanation.label_table import DENSE
from xplain.explanation.message_sets import bits_of
from xplain.learning.answers import RATES, AnswerModel, learn_answers, sum_by_group
from xplain.learning.data.dataset import Dataset
from xplain.learning.mixture.likelihood import (
    ERROR,
    WRONG,
    Cells,
    KnownTransitions,
    by_level,
    cell_posterior,
    log_cell,
)
from xplain.randomness import stream

ROUNDS, AS_SAID = 30, 5
"""Rounds of expectation maximisation, and the first rounds in which f follows the hypotheses."""
STEPS = 3
"""Updates of slips, guesses and error rates in one round."""


def mixture(
    known: KnownTransitions,
    answers: Dataset,
    facts: NDArray[np.int64],
    log_new: NDArray[np.float64],
    level: float,
) -> tuple[NDArray[np.float64], AnswerModel, NDArray[np.float64] | None]:
    """Fits the mixture over all people.

    Args:
        known: the hypotheses.
        answers: P answers of O people about known transitions.
        facts: [R] the fact sets that people may have, as bitmasks.
        log_new: [R] log prior weight of each fact set.
        level: initial value of slips and guesses.

    Returns:
        [O, R] P(fact set) of each person.
        The error model of answers.
        [O, U] P(answer 1) of each person without messages, for each of the U rows of features in
        the hypotheses; None if some people received messages.
    """
    person, people, questions = answers.observer, len(answers.observers), len(known.features)
    cells = Cells.of(known, answers.transition, answers.message_set, facts)
    group = cells.where.T.ravel()
    one = before = cells.one.reshape(len(cells.one), -1)[cells.where.T]  # [P, R, (1 + V) D]
    prior = np.exp(log_new[:, None] + known.log_prior.ravel())
    share = prior = prior / prior.sum()
    each = np.arange(len(answers))
    given = np.log(np.where(answers.label[:, None] == np.arange(2), 1 - level, level))
    made: AnswerModel | float = level
    for turn in range(ROUNDS):
        log_each = log_cell(one, *given.T[:, :, None, None])
        joint = sum_by_group(log_each, person, people) + np.log(share)
        weight = softmax(joint, axis=(1, 2))  # [O, R, (1 + V) D]
        share = (weight.sum(axis=0) + prior) / (people + 1)
        others = softmax(joint[person] - log_each, axis=(1, 2))
        f = (others * one).sum(axis=(1, 2))  # f of each answer, from the person's other answers
        made = learn_answers(answers, each, f, made, STEPS)
        given = made.log_given(answers)
        said = weight[person] * np.diff(given)[:, :, None]  # log odds of f = 1, by fact set
        if turn >= AS_SAID:  # f also depends on all other answers in the cell
            total = sum_by_group(said.reshape(len(group), -1), group, len(cells.key))
            one = cell_posterior(before, total[group].reshape(said.shape) - said)
    assert isinstance(made, AnswerModel)
    if answers.message_set.any():
        return weight.sum(axis=2), made, None
    key = known.hypotheses.row(facts) * questions + np.arange(questions)[:, None]
    said = sum_by_group(said, answers.transition, questions)
    f = cell_posterior(known.truth(key).reshape(said.shape), said)
    zero, both = made.predict(np.arange(questions))[:, :, 0].T[:, :, None, None]  # for error rate 0
    one = ((1 - f) * zero + f * both).reshape(questions, -1)
    expected = weight.reshape(people, -1) @ one.T
    rate = (made.person[:-1] @ RATES)[:, None]
    return weight.sum(axis=2), made, (1 - rate) * expected + rate * (1 - expected)


CANDIDATE = 0.01
"""A fact set is a first candidate if the answers of one person alone give it at least this
posterior."""
SURER = 1e-6
"""Minimum gain in log probability of a move."""
TRIED = 5
"""Number of fact sets that are tried for two merged types."""


OBSERVERS = 15
"""The assumed shares of people by their way of answering count as this number of observers. At most
this number of observers is used, so at least half of the result is assumed."""


def partition(
    known: KnownTransitions, answers: Dataset, concentration: float
) -> tuple[NDArray[np.int64], AnswerModel, NDArray[np.float64] | None]:
    """Finds the most likely partition of observers into types.

    At first each observer has the fact set that explains their own answers best. Types are merged
    while this increases the probability, both before and after the error model is learned.

    Args:
        known: the hypotheses.
        answers: answers of O observers about known transitions, sorted by observer.
        concentration: α of the Chinese restaurant process.

    Returns:
        [O] facts that each observer's type believes incorrectly.
        The error model of the answers.
        [O, U] P(answer 1) of each observer without messages, as in :func:`mixture`. The mixture
        predicts it, because it gives the hypotheses more weight than the types do.
    """
    search = _Search(known, answers, concentration)
    alone = search.set_common_error()
    kept = np.union1d(alone.argmax(axis=1), np.flatnonzero(alone.max(axis=0) > CANDIDATE))
    candidates = search.facts[kept], search.log_new[kept]
    weight, model, expected = mixture(known, answers, *candidates, search.level)
    search.use_errors(model)
    state = np.asarray(kept[weight.argmax(axis=1)])
    search.merge(state)
    model = search.learn(state)
    search.merge(state)
    return search.facts[state], model, expected


def errors_of(known: KnownTransitions, answers: Dataset, types: NDArray[np.int64]) -> AnswerModel:
    """Learns the error model of answers, given the types [O] of the observers. ``known`` and
    ``answers`` are as in :func:`partition`."""
    search = _Search(known, answers, 1.0)
    search.set_common_error()
    search.learn(search.best_of(types))
    return search.learn(search.best_of(types))


def learn_ways(
    known: KnownTransitions, answers: Dataset
) -> tuple[NDArray[np.float64], NDArray[np.int64] | None]:
    """Estimates the shares [5] of people by their way of answering, as in WAYS. Also draws [K, 3]
    for each of K observers, from the posterior of their facts and way: the bitmask of the facts
    believed incorrectly, the bitmask of a fact that is kept until all messages are given, and the
    index of the way (0 with such a fact).

    The facts of each observer are summed out. People without incorrect beliefs keep none. People of
    every way also err at the rate WRONG, so that a few wrong answers do not decide the way. The
    next person may be unlike the observers, so each way other than the first keeps at least its
    assumed share. With more than DENSE facts the result is WAYS and no observer, because
    explanations do not use it.

    Args:
        known: the hypotheses.
        answers: answers of observers about known transitions.
    """
    facts, n = known.hypotheses.facts, known.hypotheses.n_messages
    if n > DENSE:
        return WAYS, None
    who, kept = np.nonzero(bits_of(facts, n))  # each fact that people of a candidate may keep
    prior = known.hypotheses.prior
    prior = np.concatenate([prior, prior[who] / np.bitwise_count(facts)[who]])
    slip, guess = [0, anybody.ERROR, 0, 0.5], [0, anybody.ERROR, anybody.GUESS, 0.5]
    low, high = WRONG + (1 - 2 * WRONG) * np.array([guess, np.subtract(1, slip)])
    found, joint = [], []
    for rows in answers.rows[:: -(-len(answers.rows) // OBSERVERS)]:
        each = np.zeros((len(prior), 4))  # [sets, first four ways]
        for t, told, label in zip(
            answers.transition[rows],
            answers.message_set[rows],
            answers.label[rows],
            strict=True,
        ):
            f = known.share[0][:, t, None]
            one = f * high + (1 - f) * low
            log_p = np.log(one if label else 1 - one)
            stuck = 0 if told == (1 << n) - 1 else 1 << kept
            each[: len(facts)] += log_p[known.hypotheses.row(facts & ~told)]
            each[len(facts) :, 0] += log_p[known.hypotheses.row(facts[who] & ~told | stuck), 0]
        each += np.log(prior + 1e-300)[:, None]
        whole = np.logaddexp.reduce(each[: len(facts)])
        found.append([*whole, np.logaddexp.reduce([each[0, 0], *each[len(facts) :, 0]])])
        joint.append(each)
    shares = WAYS
    for _ in range(ROUNDS):
        likely = softmax(np.array(found) + np.log(shares), axis=1)
        shares = (likely.sum(axis=0) + OBSERVERS * WAYS) / (len(found) + OBSERVERS)
    others = np.maximum(shares, WAYS)[1:]
    weight = np.full(joint[0].shape, -np.inf)  # a kept fact has no other way
    weight[: len(facts)], weight[len(facts) :, 0] = np.log(shares[:4]), np.log(shares[4])
    rng = stream(0, "observers as people")
    drawn = [rng.choice(weight.size, p=softmax((one + weight).ravel())) for one in joint]
    row, way = np.divmod(drawn, 4)
    wrong, kept = np.append(facts, facts[who])[row], np.append(0 * facts, 1 << kept)[row]
    return np.array([1 - others.sum(), *others]), np.stack([wrong, kept, way], axis=1)


class _Search:
    """The data of the search in :func:`partition`.

    The methods' argument ``state`` [O] is the current partition: for each observer the index of the
    type's fact set in ``facts``.
    """

    def __init__(self, known: KnownTransitions, answers: Dataset, concentration: float) -> None:
        self.known, self.answers = known, answers
        # One candidate represents all candidates that behave alike.
        supported = (known.find_supported(answers.take(rows)) for rows in answers.rows)
        self.facts = reduce(np.union1d, supported)
        self.log_new = np.log(concentration) + np.log(known.prior_of(self.facts))

    def set_common_error(self) -> NDArray[np.float64]:
        """Sets one error rate for all answers: the rate with the highest likelihood if every
        observer is a separate type.

        Returns:
            [O, R] the posterior of each observer's fact set, at this error rate.
        """
        levels = by_level(self.answers.label)
        alone = np.stack([self._log_sum(rows, self.facts, levels) for rows in self.answers.rows])
        alone += self.log_new[:, None]
        likely = logsumexp(alone, axis=1).sum(axis=0).argmax()
        self.level, self.given = float(ERROR[likely]), levels[:, :, [likely]]
        return np.asarray(softmax(alone[:, :, likely], axis=1))

    def learn(self, state: NDArray[np.int64]) -> AnswerModel:
        """Learns the error model given the current types. The search then uses it."""
        cell, priors, count = np.zeros(len(self.answers), dtype=np.int64), [], 0
        for r in np.unique(state).tolist():
            rows = np.flatnonzero(state[self.answers.observer] == r)
            own = self.answers.take(rows)
            cells = Cells.of(self.known, own.transition, own.message_set, self.facts[[r]])
            weight = cells.log_likelihood(self.given[rows])[0, :, :, 0] + self.known.log_prior
            cell[rows] = count + cells.where[0]
            priors.append((cells.one * softmax(weight)).sum(axis=(1, 2)))
            count += len(cells.key)
        made = learn_answers(self.answers, cell, np.concatenate(priors), self.level)
        self.use_errors(made)
        return made

    def use_errors(self, answers: AnswerModel) -> None:
        """Makes the search use this error model."""
        self.given = answers.log_given(self.answers)[:, :, None]

    def best_of(self, types: NDArray[np.int64]) -> NDArray[np.int64]:
        """Returns [O] the most likely fact set of each observer's type, given the members of the
        type."""
        state = np.zeros(len(types), dtype=np.int64)
        for one in np.unique(types):
            members = np.flatnonzero(types == one)
            state[members] = (
                self._log_members(members.tolist(), self.facts) + self.log_new
            ).argmax()
        return state

    def _log_members(self, members: Sequence[int], facts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Computes [R] log P(answers of the members | all members have the fact set) for each of
        the fact sets ``facts`` [R]."""
        rows = np.concatenate([self.answers.rows[o] for o in members])
        return self._log_sum(rows, facts, self.given)[:, 0]

    def _log_sum(
        self, rows: NDArray[np.int64], facts: NDArray[np.int64], given: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Computes the log likelihood of some answers if all their observers have the same fact
        set.

        Args:
            rows: indices of the answers in ``answers``.
            facts: [R] fact sets.
            given: [P, 2, E] log P(answer | f) of all P answers, for f = 0 and 1 and E error levels.

        Returns:
            [R, E] log P(answers | fact set, error level).
        """
        own = self.answers.take(rows)
        cells = Cells.of(self.known, own.transition, own.message_set, facts)
        value = cells.log_likelihood(given[rows])
        return np.asarray(logsumexp(value + self.known.log_prior[:, :, None], axis=(1, 2)))

    def merge(self, state: NDArray[np.int64]) -> None:
        """Repeats the move with the highest gain while there is a gain; changes ``state`` in place.
        A move gives a type an unused fact set, or merges two types under the fact set that fits
        both best."""
        alone: dict[tuple[int, ...], NDArray[np.float64]] = {}
        both: dict[tuple[int, ...], float] = {}
        while True:
            used = np.unique(state)
            members = [tuple(np.flatnonzero(state == r).tolist()) for r in used]
            for own in members:
                if own not in alone:
                    alone[own] = self._log_members(own, self.facts) + self.log_new
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
                        value = self._log_members(pair, self.facts[[r]])[0]
                        both[r, *pair] = float(value + self.log_new[r] + gammaln(len(pair)))
                    if (more := both[r, *pair] - now[i] - now[j]) > gain and rough[r] > -np.inf:
                        best, gain = (pair, r), more
            if best is None:
                return
            state[list(best[0])] = best[1]
