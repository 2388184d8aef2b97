"""What answers say of the fact set behind them, where hypotheses may be wrong here and there.

Who holds the facts R wrong and was told H is in the *cell* (τ, R \\ H) when asked about τ. Its
label f is that of the hypotheses but with probability δ, and each answer is f but with
probability ε::

    P(answers in a cell) = Σ_f P(f | hypotheses, δ) Π P(answer | f, ε)

so that one contradiction is taken for an error and several at one cell are believed. δ is a type's,
ε everybody's; both are among a few levels and summed out, or learned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain.questions.hypotheses import Hypotheses
from xplain.questions.known_transitions import Answers, KnownTransitions

DEVIATION = np.array([0.0005, 0.005, 0.05, 1 / 3])
"""δ is one of these; the last is that of people whom no hypothesis fits."""
DEVIATION_PRIOR = np.array([0.9, 0.06, 0.03, 0.01])
DISPUTED = 20.0
"""δ is so much larger, up to ⅓, where variants of the hypotheses disagree."""
ERROR = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""ε is one of these, as likely each."""


@dataclass(frozen=True)
class Cells:
    """Answers by cell, for some fact sets at once.

    Attributes:
        which: [N] which of the fact sets a cell belongs to.
        key: [N] row of what is held wrong · U + transition; ascending for each fact set.
        share: [N, 1 + V] the hypotheses' P(label 1), by variant.
        ones, zeros: [N] answers.
        sizes: [1 + V] see :attr:`~xplain.questions.hypotheses.Hypotheses.sizes`.
    """

    which: NDArray[np.int64]
    key: NDArray[np.int64]
    share: NDArray[np.float64]
    ones: NDArray[np.float64]
    zeros: NDArray[np.float64]
    sizes: NDArray[np.bool_]

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
        sizes = known.hypotheses.sizes
        return cls(cells // size, inner, known.by_cell[inner], ones, total - ones, sizes)

    def log_joint(self, error: NDArray[np.float64]) -> NDArray[np.float64]:
        """log P(answers in the cell, f | variant, δ, ε) of f = 0 and 1: [2, N, 1 + V, D, E] for
        errors [E]."""
        prior = truth(self.share, self.sizes)[..., None]
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
