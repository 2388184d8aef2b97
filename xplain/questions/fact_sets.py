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
from scipy.special import expit, gammaln, logsumexp, softmax

from xplain.learning import answer_model
from xplain.learning.answer_model import AnswerModel, summed
from xplain.questions.known_transitions import Answers, KnownTransitions
from xplain.questions.likelihood import DEVIATION, ERROR, Cells, by_level, log_prior, truth

SWEEPS = 30
"""Of the sampler, after the deterministic start."""
DRAWS, FEWEST_SWEEPS = 6000, 5
"""Of observers in all; with many observers sweeps are fewer, but not fewer than these."""
CANDIDATE = 0.01
"""A fact set starts as a candidate where somebody's own answers give it so much."""
ROUNDS, AS_SAID = 30, 5
"""Of expectation maximisation; in the first f is as the hypotheses say."""
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
            know, with nothing told, by many draws; None where somebody was told something.
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
    search.start()
    search.learn(search.best_of(types))
    return search.learn(search.best_of(types))


class _Counted:
    """Answers by cell, for the fact sets that were in use by now: S of them, with N cells in all.

    Attributes:
        slot: of each fact set.
        cell: [S, P] of each answer, were it of people who hold the fact set wrong.
        owner: [N] the slot of each cell; ascending.
        prior: [N, 2, 1 + V, D] log P(f = 0 and 1) of each cell.
        said: [N, 2] log P(answers counted in the cell | f).
    """

    def __init__(self, known: KnownTransitions, answers: Answers) -> None:
        self.known, self.answers = known, answers
        self.slot: dict[int, int] = {}
        layers = len(known.share), len(DEVIATION)
        self.cell = np.zeros((0, len(answers.label)), dtype=np.int64)
        self.owner = np.zeros(0, dtype=np.int64)
        self.prior, self.said = np.zeros((0, 2, *layers)), np.zeros((0, 2))

    def of(self, facts: int) -> int:
        """The slot of a fact set (bitmask)."""
        if facts not in self.slot:
            known, answers = self.known, self.answers
            rows = known.hypotheses.row(facts & ~answers.message_set)
            key = rows * known.share.shape[2] + answers.transition
            cells, where = np.unique(key, return_inverse=True)
            one = truth(known.by_cell[cells], known.hypotheses.sizes)
            prior = np.log(np.stack([1 - one, one], axis=1))
            self.slot[facts] = new = len(self.cell)
            self.cell = np.vstack([self.cell, len(self.owner) + where[None]])
            self.owner = np.append(self.owner, np.full(len(cells), new))
            self.prior = np.concatenate([self.prior, prior])
            self.said = np.concatenate([self.said, np.zeros((len(cells), 2))])
        return self.slot[facts]

    def count(self, slot: int, rows: NDArray[np.int64], given: NDArray[np.float64]) -> None:
        """Adds answers, or takes them away: ``given`` [rows, 2], its sign."""
        np.add.at(self.said, self.cell[slot, rows], given)

    def evidence(self, slot: int) -> NDArray[np.float64]:
        """log P(answers counted | variant, δ): [1 + V, D]."""
        first, end = np.searchsorted(self.owner, [slot, slot + 1])
        joint = self.prior[first:end] + self.said[first:end, :, None, None]
        return np.asarray(np.logaddexp(joint[:, 0], joint[:, 1]).sum(axis=0))

    def gain(
        self, slots: NDArray[np.int64], rows: NDArray[np.int64], levels: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """log P(further answers | those counted, variant, δ, level) by slot, ascending, of answers
        with log P(answer | f, level) ``levels`` [rows, 2, E]: [slots, 1 + V, D, E]."""
        if not len(rows):
            return np.zeros((len(slots), *self.prior.shape[2:], levels.shape[2]))
        cells, where = np.unique(self.cell[slots][:, rows], return_inverse=True)
        more = summed(np.tile(levels, (len(slots), 1, 1)), where.ravel(), len(cells))
        before = self.prior[cells] + self.said[cells][:, :, None, None]
        after = before[..., None] + more[:, :, None, None, :]
        change = np.logaddexp(after[:, 0], after[:, 1])
        change -= np.logaddexp(before[:, 0], before[:, 1])[..., None]
        starts = np.searchsorted(self.owner[cells], slots)
        return np.asarray(np.add.reduceat(change, starts, axis=0))


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
        self.counted = _Counted(known, self.every)

    def run(self) -> Partition:
        state = self.mixture(self.start())
        if len(state) < MANY:
            self._merge(state)
        best, best_score = state.copy(), -np.inf
        drawn, sweeps = [], max(min(SWEEPS, DRAWS // len(state)), FEWEST_SWEEPS)
        told = self.every.message_set.any()
        for sweep in range(sweeps):
            if sweep & (sweep - 1) == 0:  # 0, 1, 2, 4, 8, …
                self.learn(state)
                self.alone = self._all_alone_by_level()
                best_score = self._score(best)
            self._recount(state)
            self._sweep(state)
            if (score := self._score(state)) > best_score:
                best, best_score = state.copy(), score
            if not told and 2 * sweep >= sweeps:
                drawn.append(self._expected())
        self._merge(best)
        error = self.answers.wrong(self.every.transition, self.person)
        return Partition(
            self.facts[best],
            self.answers,
            self._score(best),
            error,
            None if told else np.mean(drawn, axis=0),
        )

    def start(self) -> NDArray[np.float64]:
        """All answers err as often, with the probability that makes them likeliest, everybody being
        of a type of their own. Returns what each holds wrong under it: [O, R]."""
        levels = by_level(self.every.label)
        alone = self._of_each(levels) + self.log_new[:, None]
        likely = logsumexp(alone, axis=1).sum(axis=0).argmax()
        self.level, self.given = float(ERROR[likely]), levels[:, :, likely]
        return np.asarray(softmax(alone[:, :, likely], axis=1))

    def mixture(self, alone: NDArray[np.float64]) -> NDArray[np.int64]:
        """The likeliest fact set [O] of each observer by expectation maximisation, from
        :meth:`start`: shares of (fact set, variant, deviation), f of their cells, slips, guesses
        and error rates are everybody's."""
        kept = np.flatnonzero(alone.max(axis=0) > CANDIDATE)
        known, every = self.known, self.every
        held = known.hypotheses.row(self.facts[kept][:, None] & ~every.message_set)
        key = held * known.share.shape[2] + every.transition
        one = np.stack([truth(known.by_cell[row], known.hypotheses.sizes) for row in key])
        one = one.reshape(*key.shape, -1).transpose(0, 2, 1)  # [R, (1 + V) D, P]
        odds = np.log(one / (1 - one))
        cells = [np.unique(row, return_inverse=True)[1] for row in key]
        prior = np.exp(self.log_new[kept][:, None] + self.log_prior.ravel())
        prior, share = prior / prior.sum(), prior / prior.sum()
        label, question, people = every.label, every.transition, len(self.rows)
        about = answer_model.Answers(np.arange(len(label)), question, self.person, label)
        made: AnswerModel | float = self.level
        for turn in range(ROUNDS):
            zero, both = np.exp(self.given).T
            log_each = np.log((1 - one) * zero + one * both)  # [R, (1 + V) D, P]
            joint = summed(np.moveaxis(log_each, 2, 0), self.person, people) + np.log(share)
            weight = softmax(joint, axis=(1, 2))  # [O, R, (1 + V) D]
            share = (weight.sum(axis=0) + prior) / (people + 1)
            others = softmax(np.moveaxis(joint[self.person], 0, 2) - log_each, axis=(0, 1))
            f = (others * one).sum(axis=(0, 1))  # of each answer, by all others of its person
            made = answer_model.learned(about, f, known.share.shape[2], people, made, 3)
            self.given = made.log_given(question, self.person, label)
            if turn < AS_SAID:
                continue
            own = np.moveaxis(weight[self.person], 0, 2)
            said = own * (self.given[:, 1] - self.given[:, 0])
            for r, cell in enumerate(cells):  # … and by all other answers of the cell
                one[r] = expit(odds[r] + summed(said[r].T, cell, cell.max() + 1)[cell].T - said[r])
        return np.asarray(kept[weight.sum(axis=2).argmax(axis=1)])

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
        about = answer_model.Answers(cell.ravel(), question, self.person, label)
        sizes = self.known.share.shape[2], len(self.rows)
        made = answer_model.learned(about, prior[cells], *sizes, self.level)
        self.answers = made
        self.given = made.log_given(question, self.person, label)
        return made

    def best_of(self, types: NDArray[np.int64]) -> NDArray[np.int64]:
        """The likeliest fact set of each type, given who is of it: [O]."""
        state = np.zeros(len(types), dtype=np.int64)
        for one in np.unique(types):
            members = np.flatnonzero(types == one)
            state[members] = (self._together(members.tolist()) + self.log_new).argmax()
        return state

    def _all_alone_by_level(self) -> NDArray[np.float64]:
        """log P(answers of each observer, error rate | R): [O, R, E]."""
        one = self.answers.given(self.every.transition)
        self.levels = np.log(np.where(self.every.label[:, None, None] == 1, one, 1 - one))
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
