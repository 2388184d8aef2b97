"""What answers say of the fact set behind them, where hypotheses may be wrong here and there.

Who holds the facts R wrong and was told H is in the *cell* (τ, R \\ H) when asked about τ. Its
label f is that of the hypotheses but with probability δ, and an answer is not a label
(:mod:`xplain.learning.answer_model`)::

    P(answers in a cell) = Σ_f P(f | hypotheses, δ) Π P(answer | f)

so that one contradiction is taken for an error and several at one cell are believed. δ is a type's,
one of a few levels, and summed out. How answers err is learned from everybody's; where nobody else
is known, all answers err as often, with a probability ε of a few levels that is summed out too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.learning.answer_model import summed
from xplain.learning.fact_sets.known_transitions import Answers, KnownTransitions

DEVIATION = np.array([0.0005, 0.005, 0.05, 1 / 3])
"""δ is one of these; the last is that of people whom no hypothesis fits."""
DEVIATION_PRIOR = np.array([0.9, 0.06, 0.03, 0.01])
DISPUTED = 20.0
"""δ is so much larger, up to ⅓, where variants of the hypotheses disagree."""
ERROR = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""ε is one of these, as likely each."""


def by_level(label: NDArray[np.int64]) -> NDArray[np.float64]:
    """log P(answer | f, ε) of answers [P] for f = 0 and 1 and every level of ε: [P, 2, E]."""
    right = label[:, None] == np.arange(2)
    return np.asarray(np.where(right[:, :, None], np.log1p(-ERROR), np.log(ERROR)))


SCALE = np.array([0.05, 0.15, 0.4, 1.0, 2.0])
"""Of people of one type all slips, guesses and errors may be so many times those learned of
everybody, each as likely: what many contradict is f rather than a slip, if f fits as well."""


def scaled(given: NDArray[np.float64], label: NDArray[np.int64]) -> NDArray[np.float64]:
    """log P(answer | f) [P, 2] of answers [P], errors being by a level of :data:`SCALE` more or
    less: [P, 2, E]."""
    right = label[:, None] == np.arange(2)
    wrong = np.exp(np.where(right, np.log(-np.expm1(given)), given))[:, :, None] * SCALE
    wrong = np.minimum(wrong, 0.45)
    return np.asarray(np.where(right[:, :, None], np.log1p(-wrong), np.log(wrong)))


@dataclass(frozen=True)
class Cells:
    """Answers by cell, for some fact sets at once.

    Attributes:
        which: [N] number of the fact set that a cell belongs to.
        where: [R, P] the cell of each answer, by fact set.
        key: [N] row of what is held wrong · U + transition; ascending for each fact set.
        share: [N, 1 + V] the hypotheses' P(label 1), by variant.
        given: [N, 2, E] log P(answers in the cell | f) for f = 0 and 1 and E levels of error.
        sizes: [1 + V] see :attr:`~xplain.domains.users.hypotheses.Hypotheses.sizes`.
    """

    which: NDArray[np.int64]
    where: NDArray[np.int64]
    key: NDArray[np.int64]
    share: NDArray[np.float64]
    given: NDArray[np.float64]
    sizes: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        known: KnownTransitions,
        answers: Answers,
        facts: NDArray[np.int64],
        given: NDArray[np.float64],
        person: NDArray[np.int64] | int = 0,
    ) -> Cells:
        """The cells of these answers, were they of people who hold ``facts`` [R] wrong.

        Args:
            known: the hypotheses.
            answers: P of them.
            facts: candidates.
            given: [P, 2, E] log P(answer | f) of each answer.
            person: [P] who gave it, 0, 1, …; different people share no cell, and fact set r of
                person o is number o R + r. 0: all are of one type.
        """
        transitions = known.share.shape[2]
        held = known.hypotheses.row(facts[:, None] & ~answers.message_set)
        size = known.share[0].size
        number = np.arange(len(facts))[:, None] + len(facts) * np.asarray(person)
        key = number * size + held * transitions + answers.transition
        cells, where = np.unique(key, return_inverse=True)
        total = summed(np.tile(given, (len(facts), 1, 1)), where.ravel(), len(cells))
        inner, where = cells % size, where.reshape(key.shape)
        share = known.by_cell[inner]
        return cls(cells // size, where, inner, share, total, known.hypotheses.sizes)

    def log_joint(self) -> NDArray[np.float64]:
        """log P(answers in the cell, f | variant, δ, level) of f = 0 and 1: [2, N, 1 + V, D, E]."""
        prior = truth(self.share, self.sizes)[..., None]
        zero, one = (self.given[:, f, None, None, :] for f in (0, 1))
        return np.stack([np.log1p(-prior) + zero, np.log(prior) + one])

    def log_likelihood(self, sets: int) -> NDArray[np.float64]:
        """log P(answers | R, variant, δ, level): [R, 1 + V, D, E]."""
        return summed(np.logaddexp(*self.log_joint()), self.which, sets)


def truth(share: NDArray[np.float64], sizes: NDArray[np.bool_]) -> NDArray[np.float64]:
    """P(f = 1) of cells [N, 1 + V] by how often the hypotheses are wrong: [N, 1 + V, D]. Where
    variants that differ in ``sizes`` [1 + V] disagree, more than the others may be true."""
    of_sizes = share[:, sizes]
    disputed = of_sizes.min(axis=1) != of_sizes.max(axis=1)
    more = np.minimum(DISPUTED * DEVIATION, DEVIATION[-1])
    deviation = np.where(disputed[:, None], more, DEVIATION)[:, None]
    return np.asarray(share[:, :, None] * (1 - deviation) + (1 - share[:, :, None]) * deviation)


def log_prior(hypotheses: Hypotheses) -> NDArray[np.float64]:
    """log P(variant, δ): [1 + V, D]."""
    return np.asarray(np.log(hypotheses.variant_prior)[:, None] + np.log(DEVIATION_PRIOR))
