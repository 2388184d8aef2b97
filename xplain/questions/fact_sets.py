"""Which fact sets observers have: types are shared by a Chinese restaurant process, as in
:mod:`xplain.learning.fact_model.model`, and what answers say of a fact set is in
:mod:`xplain.questions.likelihood`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from xplain.questions.known_transitions import Answers, KnownTransitions
from xplain.questions.likelihood import ERROR, Cells, log_prior

SWEEPS = 30
"""Of the sampler, after the deterministic start."""


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
        each = [known.supported(answers) for answers in observers]
        self.facts = reduce(np.union1d, each)
        prior = known.prior_of(self.facts)
        self.log_new = np.log(concentration) + np.log(prior)
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
