"""Answers counted by cell for the fact sets in use, and what one more person's would add: what a
sampler of fact sets asks in its innermost loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xplain.learning.answer_model import summed
from xplain.questions.known_transitions import Answers, KnownTransitions
from xplain.questions.likelihood import DEVIATION, truth


class CountedAnswers:
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
