"""How much answers tell: mutual information under what is known of a person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import entr

from xplain.domains.users.hypotheses import Hypotheses
from xplain.questions.interactions import Nearest
from xplain.questions.matrix import EQUAL, WeighedQuestions

TIE = 1e-9
"""Clips tie when their mutual informations (bits) differ by less."""


@dataclass(frozen=True)
class Posterior:
    """What is known of a person, layer by layer: the values as assumed, V variants, and somebody
    whom no hypothesis fits.

    Attributes:
        hypotheses: C candidates.
        weight: [2 + V, C] posterior; sums to 1.
        error: [2 + V] probability that an answer is the opposite of what it would have been.
        misread: probability that a clip is misread.
        rates: [2, T] slip, P(0 | f = 1), and guess, P(1 | f = 0), of each transition, before that;
            None: nobody slips or guesses.
    """

    hypotheses: Hypotheses
    weight: NDArray[np.float64]
    error: NDArray[np.float64]
    misread: float
    rates: NDArray[np.float64] | None = None

    def labels(self, transitions: ArrayLike, told: int) -> NDArray[np.int64]:
        """[2 + V, C, Q] labels by layer and candidate; whom none fits goes by those assumed."""
        labels = self.hypotheses.label(transitions, told).astype(np.int64)
        return np.concatenate([labels, labels[:1]])

    def likelihood(
        self, transitions: Sequence[int], told: int, answers: Sequence[int]
    ) -> NDArray[np.float64]:
        """P(answers | layer, candidate) of one question, a label a transition: [2 + V, C]."""
        labels, given = self.labels(transitions, told), np.array(answers)
        one = self._answered_one(labels, np.asarray(transitions))
        each = np.where(given == 1, one, 1 - one).prod(axis=2)
        return np.asarray((1 - self.misread) * each + self.misread / 2 ** len(given))

    def _answered_one(
        self, labels: NDArray[np.int64], transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(answer 1) where the labels are these [2 + V, C, Q]."""
        one = labels.astype(np.float64)
        if self.rates is not None:
            slip, guess = self.rates[:, transitions]
            one = np.where(labels == 1, 1 - slip, guess)
        error = self.error[:, None, None]
        return np.asarray((1 - error) * one + error * (1 - one))

    def gains(self, transitions: NDArray[np.int64], told: int) -> NDArray[np.float64]:
        """Bits that the answer tells, of Q questions about one transition each: [Q]."""
        one = self._answered_one(self.labels(transitions, told), transitions)
        one = (1 - self.misread) * one + self.misread / 2
        weight = self.weight[:, :, None]
        mean, noise = (weight * one).sum(axis=(0, 1)), (weight * _binary(one)).sum(axis=(0, 1))
        return np.asarray(_binary(mean) - noise)

    def best_of(
        self, questions: Sequence[tuple[int, int]], rng: np.random.Generator
    ) -> tuple[int, int]:
        """The question about one transition, of these, that tells most; of equal ones any."""
        asked = np.array(questions, dtype=np.int64)
        value = np.empty(len(asked))
        for told in np.unique(asked[:, 1]).tolist():
            own = asked[:, 1] == told
            value[own] = self.gains(asked[own, 0], told)
        ties = np.flatnonzero(value > value.max() - TIE)
        transition, told = asked[rng.choice(ties)].tolist()
        return transition, told

    def information(self, transitions: NDArray[np.int64], told: int) -> float:
        """Bits that the answer to one question tells of (the layer, the candidate); of a clip the
        sum of what the answers tell one by one."""
        return float(self.gains(transitions, told).sum())

    def best_questions(
        self, questions: WeighedQuestions, count: int, seen: list[int], rng: np.random.Generator
    ) -> list[tuple[int, int]]:
        """The ``count`` best questions about one transition, the best first; of equal ones those
        about transitions not asked about before, else at random.

        All errors are those of a symmetric channel, so that a question tells more the nearer its
        P(label 1) is to ½.
        """
        found = self._nearest(questions, count)
        known = np.zeros(self.hypotheses.n_transitions, dtype=bool)
        known[seen] = True
        fresh = np.array([not known[own].all() for own in questions.transitions])
        level = np.round(found.off / EQUAL)  # equal but for rounding
        order = np.lexsort((rng.random(len(level)), ~fresh[found.function], level))[:count]
        chosen = []
        for at in order.tolist():
            own = questions.transitions[found.function[at]]
            unseen = own[~known[own]]
            transition = int(rng.choice(unseen if len(unseen) else own))
            chosen.append((transition, int(found.told[at])))
        return chosen

    def best_near_even(
        self, questions: WeighedQuestions, count: int, rng: np.random.Generator
    ) -> tuple[int, int]:
        """The best question about one transition among those of which the labels of the
        hypotheses, without slips and guesses, are nearest to even odds; ``count`` at least."""
        found = self._nearest(questions, count)
        pairs = zip(found.function.tolist(), found.told.tolist(), strict=True)
        every = {(int(t), told) for at, told in pairs for t in questions.transitions[at]}
        return self.best_of(sorted(every), rng)

    def _nearest(self, questions: WeighedQuestions, count: int) -> Nearest:
        weight = (1 - 2 * self.error)[:, None] * self.weight
        weight[0] += weight[-1]
        weight = weight[:-1]
        return questions.nearest(weight, weight.sum() / 2, count)

    def best_clip(
        self, starts: list[tuple[int, int]], length: int, rng: np.random.Generator
    ) -> tuple[list[int], int]:
        """The best clip of those grown transition by transition, each time by the one that tells
        most by itself."""
        best, most = ([starts[0][0]], starts[0][1]), -1.0
        every = np.arange(self.hypotheses.n_transitions)
        gains = {told: self.gains(every, told) for told in {told for _, told in starts}}
        for start, told in starts:
            clip = [start]
            while len(clip) < length and len(after := self._beside(clip)):
                own = gains[told][after]
                clip.append(int(rng.choice(after[own > own.max() - TIE])))
            if (value := float(gains[told][clip].sum())) > most + TIE:
                best, most = (clip, told), value
        return best

    def _beside(self, clip: list[int]) -> NDArray[np.int64]:
        """The transitions by which a clip can grow: those that follow its last one."""
        states = self.hypotheses.states
        others = np.setdiff1d(np.arange(self.hypotheses.n_transitions), clip)
        return others if states is None else others[states[others, 0] == states[clip[-1], 1]]


def _binary(one: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bits of an answer that is 1 with this probability."""
    return np.asarray((entr(one) + entr(1 - one)) / np.log(2))
