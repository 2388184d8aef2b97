"""All questions as one matrix of labels.

A question is a transition τ and messages H. Under weights w over the candidates R (and variants)::

    P(label 1 | τ, H) = Σ_R w(R) f_τ(R \\ H) = w @ L

Only the facts S_τ on which τ depends count, so that H ⊆ S_τ are all questions that differ, and
questions that all candidates label alike share one column of L.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.explanation.message_sets import indices, subsets
from xplain.questions.interactions import Interactions, Nearest

MAX_CELLS = 1 << 25
"""Labels of all questions by all candidates that are listed; more are searched instead."""
EQUAL = 1e-11
"""Questions tie when their P(label 1) lie as far from ½, but for this."""


class WeighedQuestions(Protocol):
    """All questions whose answer tells anything, by distinct label functions.

    Attributes:
        transitions: of each function those that have it.
    """

    @property
    def transitions(self) -> Sequence[NDArray[np.int64]]: ...

    def nearest(self, weight: NDArray[np.float64], middle: float, count: int) -> Nearest:
        """The ``count`` questions with P(label 1) nearest to ``middle`` under the weights
        [1 + V, C], those tied with the last of them, and maybe others."""
        ...


def questions_of(hypotheses: Hypotheses) -> WeighedQuestions:
    """All of them; where they are too many, those that a search finds
    (:mod:`xplain.questions.interactions`)."""
    count = int((1 << np.bitwise_count(hypotheses.matters).astype(np.int64)).sum())
    if hypotheses.complete and count * hypotheses.tables[:, :, 0].size <= MAX_CELLS:
        return QuestionMatrix.of(hypotheses)
    return Interactions.of(hypotheses)


@dataclass(frozen=True)
class QuestionMatrix:
    """Q questions, D of which all candidates label differently.

    Attributes:
        labels: [(1 + V) · C, D] of 0 and 1.
        column: [Q] the column of each question.
        function: [Q] its label function.
        told: [Q] its messages.
        transitions: G arrays, which transitions have each function.
    """

    labels: NDArray[np.float64]
    column: NDArray[np.int64]
    function: NDArray[np.int64]
    told: NDArray[np.int64]
    transitions: tuple[NDArray[np.int64], ...]

    @classmethod
    def of(cls, hypotheses: Hypotheses) -> QuestionMatrix:
        """Of all transitions whose label tells anything."""
        tables, facts = hypotheses.tables, hypotheses.facts
        columns, function, told = [], [], []
        transitions: list[NDArray[np.int64]] = []
        for mask in np.unique(hypotheses.matters[hypotheses.matters > 0]).tolist():
            own = np.flatnonzero(hypotheses.matters == mask)
            bits = np.packbits(tables[:, :, own].reshape(-1, len(own)), axis=0)
            _, first, which = np.unique(bits, axis=1, return_index=True, return_inverse=True)
            kept = subsets(indices(mask))  # what is not told
            rows = hypotheses.row(facts[:, None] & kept)
            labels = tables[:, rows][..., own[first]]
            columns.append(labels.reshape(tables[:, :, 0].size, -1))
            function.append(np.tile(len(transitions) + np.arange(len(first)), len(kept)))
            told.append(np.repeat(mask & ~kept, len(first)))
            transitions += [own[which.ravel() == g] for g in range(len(first))]
        every = np.concatenate(columns, axis=1)
        number: dict[bytes, int] = {}
        bits = np.packbits(every, axis=0).T
        column = np.array([number.setdefault(row.tobytes(), len(number)) for row in bits])
        distinct = every[:, np.unique(column, return_index=True)[1]].astype(np.float64)
        return cls(
            distinct, column, np.concatenate(function), np.concatenate(told), tuple(transitions)
        )

    def nearest(self, weight: NDArray[np.float64], middle: float, count: int) -> Nearest:
        """See :class:`WeighedQuestions`."""
        off = np.abs(weight.ravel() @ self.labels - middle)[self.column]
        last = min(count, len(off)) - 1
        kept = np.flatnonzero(off <= np.partition(off, last)[last] + EQUAL)
        return Nearest(off[kept], self.function[kept], self.told[kept])
