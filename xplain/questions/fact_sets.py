"""What answers say of the fact set behind them, where hypotheses may be wrong here and there.

Who holds the facts R wrong and was told H is in the *cell* (τ, R \\ H) when asked about τ. Its
label f is that of the hypotheses but with probability δ, and each answer is f but with
probability ε::

    P(answers in a cell) = Σ_f P(f | hypotheses, δ) Π P(answer | f, ε)

so that one contradiction is taken for an error and several at one cell are believed. δ is a type's,
ε everybody's; both are among a few levels and summed out, or learned. Types are shared by a
Chinese restaurant process, as in :mod:`xplain.learning.fact_model.model`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from xplain.questions.hypotheses import Hypotheses

DEVIATION = np.array([0.0005, 0.005, 0.05, 1 / 3])
"""δ is one of these; the last is that of people whom no hypothesis fits."""
DEVIATION_PRIOR = np.array([0.9, 0.06, 0.03, 0.01])
DISPUTED = 20.0
"""δ is so much larger, up to ⅓, where variants of the hypotheses disagree."""
ERROR = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""ε is one of these, as likely each."""
SWEEPS = 30
"""Of the sampler, after the deterministic start."""


@dataclass(frozen=True)
class KnownTransitions:
    """The hypotheses by rows of features: transitions that share one are one, of mean label.

    Attributes:
        hypotheses: with features.
        features: [U, F] float32, distinct.
        share: [1 + V, C, U] float64, of the transitions with these features those labelled 1.
    """

    hypotheses: Hypotheses
    features: NDArray[np.float32]
    share: NDArray[np.float64]

    @classmethod
    def of(cls, hypotheses: Hypotheses) -> KnownTransitions:
        """Of hypotheses that have features."""
        assert hypotheses.features is not None
        rows = np.asarray(hypotheses.features, dtype=np.float32)
        distinct, which = np.unique(rows, axis=0, return_inverse=True)
        member = which.ravel() == np.arange(len(distinct))[:, None]
        share = hypotheses.tables @ (member / member.sum(axis=1, keepdims=True)).T
        return cls(hypotheses, distinct, share)

    @cached_property
    def by_cell(self) -> NDArray[np.float64]:
        """[C · U, 1 + V] :attr:`share` by the key of a cell."""
        return np.ascontiguousarray(self.share.reshape(len(self.share), -1).T)

    @cached_property
    def ambiguous(self) -> NDArray[np.bool_]:
        """[U] whether transitions that share the features are labelled differently."""
        return np.asarray(((self.share > 0) & (self.share < 1)).any(axis=(0, 1)))

    @cached_property
    def _exact(self) -> dict[bytes, int]:
        states, rows = self.hypotheses.states, self.hypotheses.features
        if states is None or rows is None:
            return {}
        return {
            state.tobytes() + row.tobytes(): t
            for t, (state, row) in enumerate(
                zip(states.astype(np.int64), rows.astype(np.float32), strict=True)
            )
        }

    def find_exactly(
        self, features: NDArray[np.float64], states: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """[P] the hypotheses' transitions with these features [P, F] between these states [P, 2];
        −1 where there is none."""
        rows = features.astype(np.float32)
        keys = [s.tobytes() + row.tobytes() for s, row in zip(states, rows, strict=True)]
        return np.array([self._exact.get(key, -1) for key in keys], dtype=np.int64)

    @cached_property
    def _place(self) -> dict[bytes, int]:
        return {row.tobytes(): u for u, row in enumerate(self.features + np.float32(0))}

    def find(self, features: NDArray[np.floating]) -> NDArray[np.int64]:
        """[P] where rows of features [P, F] are; −1 where the hypotheses do not know them."""
        rows = np.ascontiguousarray(features, dtype=np.float32) + np.float32(0)  # −0 is 0
        return np.array([self._place.get(row.tobytes(), -1) for row in rows], dtype=np.int64)


@dataclass(frozen=True)
class Answers:
    """P answers: ``transition`` [P] (of :class:`KnownTransitions`), ``message_set`` [P],
    ``label`` [P] and ``weight`` [P], how often each counts."""

    transition: NDArray[np.int64]
    message_set: NDArray[np.int64]
    label: NDArray[np.int64]
    weight: NDArray[np.float64]

    def take(self, rows: NDArray[np.int64]) -> Answers:
        """Some of them."""
        return Answers(
            self.transition[rows], self.message_set[rows], self.label[rows], self.weight[rows]
        )


@dataclass(frozen=True)
class Cells:
    """Answers by cell, for some fact sets at once.

    Attributes:
        which: [N] which of the fact sets a cell belongs to.
        key: [N] row of what is held wrong · U + transition; ascending for each fact set.
        share: [N, 1 + V] the hypotheses' P(label 1), by variant.
        ones, zeros: [N] answers.
    """

    which: NDArray[np.int64]
    key: NDArray[np.int64]
    share: NDArray[np.float64]
    ones: NDArray[np.float64]
    zeros: NDArray[np.float64]

    @classmethod
    def of(cls, known: KnownTransitions, answers: Answers, facts: NDArray[np.int64]) -> Cells:
        """The cells of these answers, were they of people who hold ``facts`` [R] wrong."""
        transitions = known.share.shape[2]
        held = known.hypotheses.row(facts[:, None] & ~answers.message_set)
        size = known.share[0].size
        key = np.arange(len(facts))[:, None] * size + held * transitions + answers.transition
        cells, where = np.unique(key, return_inverse=True)
        one = np.broadcast_to(answers.weight * (answers.label == 1), key.shape)
        every = np.broadcast_to(answers.weight, key.shape)
        ones = np.asarray(np.bincount(where.ravel(), one.ravel(), len(cells)), np.float64)
        total = np.asarray(np.bincount(where.ravel(), every.ravel(), len(cells)), np.float64)
        inner = cells % size
        return cls(cells // size, inner, known.by_cell[inner], ones, total - ones)

    def log_joint(self, error: NDArray[np.float64]) -> NDArray[np.float64]:
        """log P(answers in the cell, f | variant, δ, ε) of f = 0 and 1: [2, N, 1 + V, D, E] for
        errors [E]."""
        prior = truth(self.share)[..., None]
        good, bad = np.log1p(-error), np.log(error)
        ones, zeros = self.ones[:, None, None, None], self.zeros[:, None, None, None]
        return np.stack(
            [
                np.log1p(-prior) + ones * bad + zeros * good,
                np.log(prior) + ones * good + zeros * bad,
            ]
        )

    def log_likelihood(self, error: NDArray[np.float64], sets: int) -> NDArray[np.float64]:
        """log P(answers | R, variant, δ, ε): [R, 1 + V, D, E]."""
        each = np.logaddexp(*self.log_joint(error))
        result = np.zeros((sets, *each.shape[1:]))
        np.add.at(result, self.which, each)
        return result


def truth(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """P(f = 1) of cells [N, 1 + V] by how often the hypotheses are wrong: [N, 1 + V, D]. Where
    variants disagree, more than the others may be true."""
    disputed = share.min(axis=1) != share.max(axis=1)
    more = np.minimum(DISPUTED * DEVIATION, DEVIATION[-1])
    deviation = np.where(disputed[:, None], more, DEVIATION)[:, None]
    return np.asarray(share[:, :, None] * (1 - deviation) + (1 - share[:, :, None]) * deviation)


def log_prior(hypotheses: Hypotheses) -> NDArray[np.float64]:
    """log P(variant, δ): [1 + V, D]."""
    return np.asarray(np.log(hypotheses.variant_prior)[:, None] + np.log(DEVIATION_PRIOR))


@dataclass(frozen=True)
class Partition:
    """Types of observers: ``facts`` [O] of each observer's type, the ``error`` learned, and
    ``score``, the log of the joint probability."""

    facts: NDArray[np.int64]
    error: float
    score: float


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


class _Search:
    """The state of :func:`partition`: an index into ``facts`` for each observer."""

    def __init__(
        self,
        known: KnownTransitions,
        observers: list[Answers],
        concentration: float,
        rng: np.random.Generator,
    ) -> None:
        hypotheses = known.hypotheses
        self.known, self.observers, self.rng = known, observers, rng
        # One candidate stands for all that behave alike.
        self.facts, first = np.unique(hypotheses.essential, return_inverse=True)
        self.log_new = np.log(concentration) + np.log(np.bincount(first.ravel(), hypotheses.prior))
        self.log_prior = log_prior(hypotheses)
        self.everybody = np.arange(len(self.facts))
        self.error = np.array([0.06])
        self.scores: dict[tuple[int, ...], float] = {}

    def run(self) -> Partition:
        alone = self._all_alone(ERROR)  # [O, R, E]
        best_error = logsumexp(alone + self.log_new[:, None], axis=1).sum(axis=0).argmax()
        self.error = ERROR[[best_error]]
        self.alone = alone[:, :, best_error]
        state = (self.alone + self.log_new).argmax(axis=1)
        self._merge(state)
        self._learn_error(state)
        best, best_score = state.copy(), self._score(state)
        for _ in range(SWEEPS):
            self._sweep(state)
            if (score := self._score(state)) > best_score:
                best, best_score = state.copy(), score
        self._merge(best)
        return Partition(self.facts[best], float(self.error[0]), self._score(best))

    def _all_alone(self, error: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([self._of_sets(answers, error) for answers in self.observers])

    def _of_sets(self, answers: Answers, error: NDArray[np.float64]) -> NDArray[np.float64]:
        """log P(answers | R, ε) of every fact set: [R, E]."""
        cells = Cells.of(self.known, answers, self.facts)
        likelihood = cells.log_likelihood(error, len(self.facts))
        return np.asarray(logsumexp(likelihood + self.log_prior[:, :, None], axis=(1, 2)))

    def _together(self, fact_set: int, members: tuple[int, ...]) -> float:
        """log P(answers of the members | they are of one type of these facts)."""
        if not members:
            return 0.0
        if len(members) == 1:
            return float(self.alone[members[0], fact_set])
        key = (fact_set, *members)
        if key not in self.scores:
            answers = self._pooled(members)
            cells = Cells.of(self.known, answers, self.facts[[fact_set]])
            likelihood = cells.log_likelihood(self.error, 1)[0, :, :, 0]
            self.scores[key] = float(logsumexp(likelihood + self.log_prior))
        return self.scores[key]

    def _pooled(self, members: tuple[int, ...]) -> Answers:
        parts = [self.observers[o] for o in members]
        return Answers(
            np.concatenate([part.transition for part in parts]),
            np.concatenate([part.message_set for part in parts]),
            np.concatenate([part.label for part in parts]),
            np.concatenate([part.weight for part in parts]),
        )

    def _score(self, state: NDArray[np.int64]) -> float:
        total = 0.0
        for fact_set in np.unique(state).tolist():
            members = tuple(np.flatnonzero(state == fact_set).tolist())
            total += self._together(fact_set, members)
            total += float(self.log_new[fact_set] + gammaln(len(members)))
        return total

    def _sweep(self, state: NDArray[np.int64]) -> None:
        """Draws the type of each observer given all others, in place."""
        for o in self.rng.permutation(len(state)).tolist():
            log_weight = self.log_new + self.alone[o]
            others = state.copy()
            others[o] = -1
            for fact_set in np.unique(others[others >= 0]).tolist():
                members = tuple(np.flatnonzero(others == fact_set).tolist())
                both = tuple(sorted((*members, o)))
                gain = self._together(fact_set, both) - self._together(fact_set, members)
                log_weight[fact_set] = np.log(len(members)) + gain
            weight = np.exp(log_weight - log_weight.max())
            state[o] = self.rng.choice(len(weight), p=weight / weight.sum())

    def _merge(self, state: NDArray[np.int64]) -> None:
        """Merges the two types whose merger gains most, under the facts that then fit best, while
        one gains; in place."""
        while True:
            types = np.unique(state).tolist()
            before = self._score(state)
            best, gain = state, 0.0
            for i, one in enumerate(types):
                for other in types[i + 1 :]:
                    merged = np.isin(state, (one, other))
                    pooled = self._pooled(tuple(np.flatnonzero(merged).tolist()))
                    value = self._of_sets(pooled, self.error)[:, 0] + self.log_new
                    taken = np.isin(self.everybody, [t for t in types if t not in (one, other)])
                    value[taken] = -np.inf
                    trial = state.copy()
                    trial[merged] = value.argmax()
                    if (more := self._score(trial) - before) > gain:
                        best, gain = trial, more
            if gain <= 0:
                return
            state[:] = best

    def _learn_error(self, state: NDArray[np.int64]) -> None:
        """The level of ε under which the answers are likeliest, the types as they are."""
        total = np.zeros(len(ERROR))
        for fact_set in np.unique(state).tolist():
            answers = self._pooled(tuple(np.flatnonzero(state == fact_set).tolist()))
            cells = Cells.of(self.known, answers, self.facts[[fact_set]])
            likelihood = cells.log_likelihood(ERROR, 1)[0]
            total += logsumexp(likelihood + self.log_prior[:, :, None], axis=(0, 1))
        chosen = int(total.argmax())
        self.error = ERROR[[chosen]]
        self.scores.clear()
        self.alone = self._all_alone(self.error)[:, :, 0]
