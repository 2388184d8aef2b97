"""What people of one type find explicable, by what their answers say of the facts that they hold
wrong (:mod:`xplain.learning.fact_sets.likelihood`)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from xplain.errors import TooLargeError
from xplain.explanation.message_sets import bits_of
from xplain.learning.evidence import DOUBTED
from xplain.learning.fact_sets.known_transitions import Answers, KnownTransitions
from xplain.learning.fact_sets.likelihood import DEVIATION, ERROR, Cells, by_level, log_prior, truth
from xplain.learning.labelers import Labeler, OfTruth

KEPT = 1e-4
"""Fact sets with a smaller share of the posterior are left out of predictions."""
OFTEN = 0.05
RELEVANT = 0.01
MOST = 12
MAX_TABLE = 1 << 24
EDGE = 0.002
"""Probabilities stay so far from 0 and 1. A label is shown again with every later step, so that
larger doubts about what nothing speaks against would add up to messages that nobody needs."""


class FactSetClassifier(OfTruth):
    """The posterior over the fact sets of one type, with what labelers ask of a classifier.

    It predicts what people find explicable, f, not what they answer: errors in answers are left
    out. Rows of features that the hypotheses do not know are left to ``alone``.

    Attributes:
        known: the hypotheses.
        trust: weight of the hypotheses, the rest being that of ``alone``; 1 where people think as
            they say (:attr:`doubt`).
        facts: [R] fact sets that are likely.
        weight: [R, 1 + V, D] their posterior with variant and deviation.
        cells: the answers by cell, for each fact set.
        learned: [N] P(f = 1) of each cell, times the weight of its fact set.
        level: [E] posterior of the levels of error.
    """

    def __init__(
        self,
        known: KnownTransitions,
        answers: Answers,
        fit_alone: Callable[[], Labeler],
        given: NDArray[np.float64] | None = None,
        trust: float = 1.0,
    ) -> None:
        """Works out the posterior over fact sets, variants and deviations.

        Args:
            known: see above.
            fit_alone: learns from the labels alone.
            answers: P of people of the type.
            given: [P, 2, E] log P(answer | f) for f = 0 and 1, by levels of error that are as
                likely; None: of answers that all err as often.
            trust: weight of the hypotheses, where they are doubted.
        """
        self.known, self._fit_alone = known, fit_alone
        given = by_level(answers.label) if given is None else given
        facts = known.supported(answers)
        prior = np.log(known.prior_of(facts) + 1e-300)
        joint = Cells.of(known, answers, facts, given).log_likelihood(len(facts))
        joint += prior[:, None, None, None] + log_prior(known.hypotheses)[:, :, None]
        posterior = np.exp(joint - logsumexp(joint))
        kept = posterior.sum(axis=(1, 2, 3)) > KEPT
        posterior = posterior[kept] / posterior[kept].sum()
        self.level = posterior.sum(axis=(0, 1, 2))
        self.facts, self.weight = facts[kept], posterior.sum(axis=3)
        self.trust = trust if self.doubt > DOUBTED else 1.0
        self.cells = Cells.of(known, answers, self.facts, given)
        zero, one = self.cells.log_joint()
        of_cell = np.exp(one - np.logaddexp(zero, one)) * posterior[self.cells.which]
        self.learned = of_cell.sum(axis=(1, 2, 3))

    @cached_property
    def alone(self) -> Labeler:
        """Learned from the labels alone, when it is first asked."""
        return self._fit_alone()

    @property
    def doubt(self) -> float:
        """P(the hypotheses are wrong at one transition in twenty, or more)."""
        return float(self.weight[:, :, DEVIATION >= OFTEN].sum())

    @property
    def unwritten(self) -> float:
        """P(people of the type hold wrong what no hypothesis does)."""
        return float(self.weight[(self.facts & self.known.unwritten) > 0].sum())

    def log_answered(self, answers: Answers) -> NDArray[np.float64]:
        """log P of further answers [P], which err by the levels of
        :func:`~xplain.learning.fact_sets.likelihood.by_level`: [P]."""
        one = self.known_rows(answers.transition, answers.message_set)
        error = self.level @ ERROR
        same = np.where(answers.label == 1, one, 1 - one)
        return np.asarray(np.log(same * (1 - error) + (1 - same) * error))

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
        return self._weighed(result, known.features[transition], told)

    def exactly(
        self, transitions: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(f = 1) by the hypotheses alone, of their transitions [P]: [P]. Where transitions
        share their features, nobody knows which of them an answer was about."""
        result = np.zeros(len(transitions))
        for r, facts in enumerate(self.facts.tolist()):
            share = self.known.share_of(facts & ~told, transitions)
            result += (truth(share, self.known.hypotheses.sizes) * self.weight[r]).sum(axis=(1, 2))
        features = self.known.hypotheses.features
        assert features is not None
        return self._weighed(result, features[transitions], told)

    def _weighed(
        self, one: NDArray[np.float64], features: NDArray[Any], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(f = 1) of rows of features [P, F] under message sets [P], where the hypotheses' is
        ``one`` [P]: [P]."""
        if self.trust < 1:
            alone = self.alone.probability(features, told)
            one = self.trust * one + (1 - self.trust) * alone
        return np.clip(one, EDGE, 1 - EDGE)

    def predict_proba(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        """P(label = 0) and P(label = 1) of rows [P, F + n]: [P, 2]."""
        n = self.known.hypotheses.n_messages
        told = x[:, -n:].astype(np.int64) @ (1 << np.arange(n, dtype=np.int64))
        transition = self.known.find(x[:, :-n])
        rows, one = transition >= 0, np.empty(len(x))
        one[rows] = self.known_rows(transition[rows], told[rows])
        if not rows.all():
            one[~rows] = self.alone.probability(x[~rows, :-n].astype(np.float64), told[~rows])
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
