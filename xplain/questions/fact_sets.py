"""Which fact sets observers have, and how their answers err: types are shared by a Chinese
restaurant process, as in :mod:`xplain.learning.fact_model.model`, and what answers say of a fact
set is in :mod:`xplain.questions.likelihood`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp, softmax

from xplain.learning import answer_model
from xplain.learning.answer_model import AnswerModel, summed
from xplain.questions.counted_answers import CountedAnswers
from xplain.questions.fact_mixture import mixture
from xplain.questions.known_transitions import Answers, KnownTransitions
from xplain.questions.likelihood import ERROR, Cells, by_level, log_prior, truth

SWEEPS = 30
"""Of the sampler, after the deterministic start."""
DRAWS, FEWEST_SWEEPS = 6000, 5
"""Of observers in all; with many observers sweeps are fewer, but not fewer than these."""
CANDIDATE = 0.01
"""A fact set starts as a candidate where somebody's own answers give it so much."""
MANY = 100
"""Observers from which the sampler starts with what the mixture found, nothing merged."""
MOST_CELLS = 1 << 22
"""Numbers that are worked out at a time."""
SURER = 1e-6
"""Gain (log) of a move that is made."""
TRIED = 5
"""Fact sets that are tried for a type that two would make."""


@dataclass(frozen=True)
class Partition:
    """Types of observers.

    Attributes:
        facts: [O] of each observer's type.
        answers: how answers err, questions being the rows of features that hypotheses know.
        score: log of the joint probability.
        error: share of the answers that are thought wrong.
        expected: [O, U] P(answer 1) of each observer about every row of features that hypotheses
            know, with nothing told: the mean of what the mixture and the sampler expect, as the
            former trusts hypotheses more and the latter people who are alike; None where somebody
            was told something.
    """

    facts: NDArray[np.int64]
    answers: AnswerModel
    score: float
    error: float
    expected: NDArray[np.float64] | None


def partition(
    known: KnownTransitions,
    observers: list[Answers],
    concentration: float,
    rng: np.random.Generator,
) -> Partition:
    """The likeliest sharing of types by observers: a start of each observer's own best fact set,
    merges while they pay, and Gibbs sampling of one observer after the other.

    Args:
        known: the hypotheses.
        observers: the answers of each.
        concentration: α of the Chinese restaurant process.
        rng: of the sampler.
    """
    return _Search(known, observers, concentration, rng).run()


def errors_of(
    known: KnownTransitions, observers: list[Answers], types: NDArray[np.int64]
) -> AnswerModel:
    """How answers err, the types [O] of the observers being given."""
    search = _Search(known, observers, 1.0, np.random.default_rng(0))
    search.alike()
    search.learn(search.best_of(types))
    return search.learn(search.best_of(types))


class _Search:
    """The state of :func:`partition`: an index into ``facts`` for each observer."""

    def __init__(
        self,
        known: KnownTransitions,
        observers: list[Answers],
        concentration: float,
        rng: np.random.Generator,
    ) -> None:
        self.known, self.rng = known, rng
        self.every = _pooled(observers)
        sizes = [len(one.label) for one in observers]
        self.person = np.repeat(np.arange(len(observers)), sizes)
        self.rows = np.split(np.arange(len(self.person)), np.cumsum(sizes)[:-1])
        # One candidate stands for all that behave alike.
        self.facts = reduce(np.union1d, [known.supported(answers) for answers in observers])
        self.log_new = np.log(concentration) + np.log(known.prior_of(self.facts))
        self.log_prior = log_prior(known.hypotheses)
        self.counted = CountedAnswers(known, self.every)

    def run(self) -> Partition:
        state = self.start()
        if len(state) < MANY:
            self._merge(state)
        best, best_score = state.copy(), -np.inf
        drawn, sweeps = [], max(min(SWEEPS, DRAWS // len(state)), FEWEST_SWEEPS)
        for sweep in range(sweeps):
            if sweep & (sweep - 1) == 0:  # 0, 1, 2, 4, 8, …
                self.learn(state)
                self.alone = self._all_alone_by_level()
                best_score = self._score(best)
            self._recount(state)
            self._sweep(state)
            if (score := self._score(state)) > best_score:
                best, best_score = state.copy(), score
            if self.softly is not None and 2 * sweep >= sweeps:
                drawn.append(self._expected())
        self._merge(best)
        error = self.answers.wrong(self.every.transition, self.person)
        return Partition(
            self.facts[best],
            self.answers,
            self._score(best),
            error,
            None if self.softly is None else (self.softly + np.mean(drawn, axis=0)) / 2,
        )

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
        self.answers, self.softly = found.answers, found.expected
        self._heed()
        return np.asarray(kept[found.weight.argmax(axis=1)])

    def learn(self, state: NDArray[np.int64]) -> AnswerModel:
        """How answers err, the types being as they are; from then on they are taken to."""
        self._recount(state)
        counted = self.counted
        prior = np.zeros(len(counted.owner))
        for slot in np.unique(self._slots(state)).tolist():
            own = counted.owner == slot
            joint = counted.evidence(slot) + self.log_prior
            weight = np.exp(joint - logsumexp(joint))
            prior[own] = (np.exp(counted.prior[own, 1]) * weight).sum(axis=(1, 2))
        cells, cell = np.unique(self._cells(state), return_inverse=True)
        label, question = self.every.label, self.every.transition
        about = answer_model.CellAnswers(cell.ravel(), question, self.person, label)
        sizes = self.known.share.shape[2], len(self.rows)
        made = answer_model.learned(about, prior[cells], *sizes, self.level)
        self.answers = made
        self._heed()
        return made

    def _heed(self) -> None:
        about = self.every.transition, self.person, self.every.label
        self.given = self.answers.log_given(*about)

    def best_of(self, types: NDArray[np.int64]) -> NDArray[np.int64]:
        """The likeliest fact set of each type, given who is of it: [O]."""
        state = np.zeros(len(types), dtype=np.int64)
        for one in np.unique(types):
            members = np.flatnonzero(types == one)
            state[members] = (self._together(members.tolist()) + self.log_new).argmax()
        return state

    def _all_alone_by_level(self) -> NDArray[np.float64]:
        """log P(answers of each observer, error rate | R): [O, R, E]."""
        self.levels = np.log(self.answers.likelihood(self.every.transition, self.every.label))
        self.log_level = np.log(self.answers.errors.prior)
        return self._of_each(self.levels) + self.log_level

    def _of_each(self, levels: NDArray[np.float64]) -> NDArray[np.float64]:
        """log P(answers of each observer | R, level): [O, R, E]; some observers at a time."""
        layers = self.log_prior.size * levels.shape[2] * len(self.facts)
        size = np.cumsum([len(rows) * layers for rows in self.rows]) // MOST_CELLS
        parts = []
        for part in np.split(np.arange(len(self.rows)), np.flatnonzero(np.diff(size)) + 1):
            rows = np.concatenate([self.rows[o] for o in part.tolist()])
            who = self.person[rows] - part[0]
            cells = Cells.of(self.known, self.every.take(rows), self.facts, levels[rows], who)
            value = cells.log_likelihood(len(part) * len(self.facts))
            value = _log_sum(value + self.log_prior[:, :, None])
            parts.append(value.reshape(len(part), len(self.facts), -1))
        return np.concatenate(parts)

    def _together(
        self, members: Sequence[int], facts: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """log P(answers of the members | they are of one type R): [R]."""
        rows = np.concatenate([self.rows[o] for o in members])
        among = self.facts if facts is None else facts
        given = self.given[rows][:, :, None]
        cells = Cells.of(self.known, self.every.take(rows), among, given)
        return _log_sum(cells.log_likelihood(len(among)) + self.log_prior[:, :, None])[:, 0]

    def _slots(self, state: NDArray[np.int64]) -> NDArray[np.int64]:
        """[O] of each observer's type."""
        used, which = np.unique(state, return_inverse=True)
        return np.array([self.counted.of(int(self.facts[r])) for r in used])[which.ravel()]

    def _cells(self, state: NDArray[np.int64]) -> NDArray[np.int64]:
        """[P] of each answer."""
        slots = self._slots(state)
        return self.counted.cell[slots[self.person], np.arange(len(self.person))]

    def _recount(self, state: NDArray[np.int64]) -> None:
        cells = self._cells(state)
        self.counted.said[:] = summed(self.given, cells, len(self.counted.owner))

    def _score(self, state: NDArray[np.int64]) -> float:
        self._recount(state)
        size, total = np.bincount(state), 0.0
        for r in np.flatnonzero(size).tolist():
            evidence = self.counted.evidence(self.counted.of(int(self.facts[r])))
            total += float(logsumexp(evidence + self.log_prior) + self.log_new[r])
            total += float(gammaln(size[r]))
        return total

    def _sweep(self, state: NDArray[np.int64]) -> None:
        """Draws the type of each observer given all others, in place; ``weight`` [O, R, E] is then
        what each was drawn from."""
        counted, facts = self.counted, self.facts
        size = np.bincount(state, minlength=len(facts))
        slot = np.full(len(facts), -1)
        slot[state] = self._slots(state)
        evidence = {s: counted.evidence(s) for s in np.unique(slot[state]).tolist()}
        self.weight = np.zeros_like(self.alone)
        for o in self.rng.permutation(len(state)).tolist():
            rows, old = self.rows[o], state[o]
            counted.count(slot[old], rows, -self.given[rows])
            size[old] -= 1
            evidence[slot[old]] = counted.evidence(slot[old])
            log_weight = self.log_new[:, None] + self.alone[o]
            used = np.flatnonzero(size)
            used = used[np.argsort(slot[used])]
            if len(used):
                before = np.stack([evidence[s] for s in slot[used].tolist()]) + self.log_prior
                gain = counted.gain(slot[used], rows, self.levels[rows]) + before[..., None]
                both = _log_sum(gain) - _log_sum(before[..., None])
                log_weight[used] = np.log(size[used])[:, None] + both + self.log_level
            weight = np.exp(log_weight - log_weight.max())
            self.weight[o] = weight / weight.sum()
            state[o] = new = self.rng.choice(len(weight), p=self.weight[o].sum(axis=1))
            if not size[new]:
                slot[new] = counted.of(int(facts[new]))
                counted.said[counted.owner == slot[new]] = 0
            counted.count(slot[new], rows, self.given[rows])
            size[new] += 1
            evidence[slot[new]] = counted.evidence(slot[new])

    def _expected(self) -> NDArray[np.float64]:
        """P(answer 1) of each observer about every row of features that hypotheses know, with
        nothing told, by what was drawn last: [O, U]."""
        known, count = self.known, self.known.share.shape[2]
        asked, own = np.unique(self.every.transition), np.zeros((len(self.facts), count))
        for r, facts in enumerate(self.facts.tolist()):
            cells = known.hypotheses.row(np.array(facts)) * count + np.arange(count)
            one = truth(known.by_cell[cells], known.hypotheses.sizes)
            joint = np.log(np.stack([1 - one, one], axis=1))
            if facts in self.counted.slot:
                slot = self.counted.slot[facts]
                joint[asked] += self.counted.said[self.counted.owner == slot][:, :, None, None]
            total = np.logaddexp(joint[:, 0], joint[:, 1])
            weight = total.sum(axis=0) + self.log_prior
            weight = np.exp(weight - logsumexp(weight))
            own[r] = (np.exp(joint[:, 1] - total) * weight).sum(axis=(1, 2))
        zero, one = self.answers.given(np.arange(count))[..., 0].T  # with the first error rate, 0
        said = (1 - own) * zero + own * one
        share = self.weight.sum(axis=2)
        wrong = self.weight @ self.answers.errors.rates
        return np.asarray((share - 2 * wrong) @ said + wrong.sum(axis=1)[:, None])

    def _merge(self, state: NDArray[np.int64]) -> None:
        """Gives the type that gains most by it other facts that nobody has, or merges two under the
        facts that then fit best, while one gains; in place."""
        alone: dict[tuple[int, ...], NDArray[np.float64]] = {}
        both: dict[tuple[int, ...], float] = {}
        while True:
            used = np.unique(state)
            members = [tuple(np.flatnonzero(state == r).tolist()) for r in used]
            for own in members:
                if own not in alone:
                    alone[own] = self._together(own) + self.log_new
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


def _log_sum(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """log Σ exp over variants and deviations: [K, 1 + V, D, E] → [K, E]."""
    top = values.max(axis=(1, 2))
    return np.asarray(np.log(np.exp(values - top[:, None, None]).sum(axis=(1, 2))) + top)


def _pooled(parts: Sequence[Answers]) -> Answers:
    return Answers(
        np.concatenate([part.transition for part in parts]),
        np.concatenate([part.message_set for part in parts]),
        np.concatenate([part.label for part in parts]),
        np.concatenate([part.weight for part in parts]),
    )
