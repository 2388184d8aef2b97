"""What people of one type find explicable, by what their answers say of the facts that they hold
wrong (:mod:`xplain.questions.likelihood`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from xplain.errors import TooLargeError
from xplain.message_sets import bits_of
from xplain.questions.known_transitions import Answers, KnownTransitions
from xplain.questions.likelihood import Cells, by_level, log_prior, truth

KEPT = 1e-4
"""Fact sets with a smaller share of the posterior are left out of predictions."""
RELEVANT = 0.01
MOST = 12
MAX_TABLE = 1 << 24
EDGE = 0.002
"""Probabilities stay so far from 0 and 1. A label is shown again with every later step, so that
larger doubts about what nothing speaks against would add up to messages that nobody needs."""


class FactSetClassifier:
    """The posterior over the fact sets of one type, with what labelers ask of a classifier.

    It predicts what people find explicable, f, not what they answer: errors in answers are left
    out. Rows of features that the hypotheses do not know are left to ``fallback``.

    Attributes:
        known: the hypotheses.
        fallback: a fitted classifier.
        facts: [R] fact sets that are likely.
        weight: [R, 1 + V, D] their posterior with variant and deviation.
        cells: the answers by cell, for each fact set.
        learned: [N] P(f = 1) of each cell, times the weight of its fact set.
    """

    classes_ = np.array([0, 1])
    is_sound = True

    def __init__(
        self,
        known: KnownTransitions,
        answers: Answers,
        fallback: Any,
        given: NDArray[np.float64] | None = None,
    ) -> None:
        """Works out the posterior over fact sets, variants and deviations.

        Args:
            known, fallback: see above.
            answers: P of people of the type.
            given: [P, 2, E] log P(answer | f) for f = 0 and 1, by levels of error that are as
                likely; None: of answers that all err as often.
        """
        self.known, self.fallback = known, fallback
        given = by_level(answers.label) if given is None else given
        facts = known.supported(answers)
        prior = np.log(known.prior_of(facts) + 1e-300)
        joint = Cells.of(known, answers, facts, given).log_likelihood(len(facts))
        joint += prior[:, None, None, None] + log_prior(known.hypotheses)[:, :, None]
        posterior = np.exp(joint - logsumexp(joint))
        kept = posterior.sum(axis=(1, 2, 3)) > KEPT
        posterior = posterior[kept] / posterior[kept].sum()
        self.facts, self.weight = facts[kept], posterior.sum(axis=3)
        self.cells = Cells.of(known, answers, self.facts, given)
        zero, one = self.cells.log_joint()
        of_cell = np.exp(one - np.logaddexp(zero, one)) * posterior[self.cells.which]
        self.learned = of_cell.sum(axis=(1, 2, 3))

    @property
    def looked_at(self) -> int:
        """The facts that people of the type may hold wrong. Where facts are many, those they do
        with a probability of RELEVANT, the likeliest MOST of them; other messages are
        taken to be never given."""
        if self.known.hypotheses.complete:
            return int(np.bitwise_or.reduce(self.facts, initial=0))
        bits = bits_of(self.facts, self.known.hypotheses.n_messages)
        share = self.weight.sum(axis=(1, 2)) @ bits
        likely = np.argsort(-share, kind="stable")[:MOST]
        return sum(1 << int(j) for j in likely if share[j] >= RELEVANT)

    @property
    def wrong(self) -> NDArray[np.float64]:
        """[n] P(a person of the type holds a fact wrong); as labels, never certain."""
        bits = bits_of(self.facts, self.known.hypotheses.n_messages)
        share: NDArray[np.float64] = self.weight.sum(axis=(1, 2)) @ bits
        return np.clip(share, EDGE, 1 - EDGE)

    def known_rows(
        self, transition: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(f = 1) of known transitions [P] under message sets [P]: [P]."""
        known, result = self.known, np.zeros(len(transition))
        for r, facts in enumerate(self.facts.tolist()):
            key = known.hypotheses.row(facts & ~told) * known.share.shape[2] + transition
            cells, place = np.unique(key, return_inverse=True)
            one = (truth(known.by_cell[cells], known.hypotheses.sizes) * self.weight[r]).sum(
                axis=(1, 2)
            )
            own = np.flatnonzero(self.cells.which == r)
            _, here, there = np.intersect1d(
                cells, self.cells.key[own], assume_unique=True, return_indices=True
            )
            one[here] = self.learned[own][there]
            result += one[place.ravel()]
        return np.clip(result, EDGE, 1 - EDGE)

    def exactly(
        self, transitions: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(f = 1) by the hypotheses alone, of their transitions [P]: [P]. Where transitions
        share their features, nobody knows which of them an answer was about."""
        result = np.zeros(len(transitions))
        for r, facts in enumerate(self.facts.tolist()):
            share = self.known.share_of(facts & ~told, transitions)
            result += (truth(share, self.known.hypotheses.sizes) * self.weight[r]).sum(axis=(1, 2))
        return np.clip(result, EDGE, 1 - EDGE)

    def predict_proba(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        """P(label = 0) and P(label = 1) of rows [P, F + n]: [P, 2]."""
        n = self.known.hypotheses.n_messages
        told = x[:, -n:].astype(np.int64) @ (1 << np.arange(n, dtype=np.int64))
        transition = self.known.find(x[:, :-n])
        rows, one = transition >= 0, np.empty(len(x))
        one[rows] = self.known_rows(transition[rows], told[rows])
        if not rows.all():
            shares = self.fallback.predict_proba(x[~rows])
            ones = self.fallback.classes_ == 1
            one[~rows] = np.clip(shares[:, ones].sum(axis=1), EDGE, 1 - EDGE)
        return np.stack([1 - one, one], axis=1)

    def tabulated(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """All it knows: rows of features [U, F], and P(label = 1) of each by message set
        [U, 2^n].

        Raises:
            TooLargeError: more than MAX_TABLE numbers.
        """
        count, n = len(self.known.features), self.known.hypotheses.n_messages
        if count << n > MAX_TABLE:
            raise TooLargeError(f"types: a table of {count} × 2^{n} labels is too large for a file")
        told = np.tile(np.arange(1 << n), count)
        table = self.known_rows(np.repeat(np.arange(count), 1 << n), told)
        return self.known.features, table.reshape(count, 1 << n)

    def predict(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        """The likelier label of rows [P, F + n]: [P]."""
        return (self.predict_proba(x)[:, 1] >= 0.5).astype(np.int64)
