"""Good questions where facts are so many that not all questions can be weighed.

Candidates are few of the 2^n sets. The label function of a transition, over the candidates, is
f(w) = Σ_{A ⊆ w} c_A (its Möbius transform; A, with each set its subsets, are candidates too, and
most c_A are 0). When the facts K are not told, the probability of label 1 is a polynomial in K,

    P(yes | K) = Σ_{A ⊆ K} c_A Σ_{R ⊇ A} p(R),

exactly that of :mod:`xplain.questions.matrix`. A question tells the more the nearer it is to
½, and K is found by turning one fact after the other, each time that which comes nearest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses

TURN = 1e-9
"""A fact is turned where the question comes nearer by more."""


class Nearest(NamedTuple):
    """Questions, P of them, whose P(label 1) lies near the middle.

    Attributes:
        off: [P] how far from it.
        function: [P] index of the label function.
        told: [P] the message sets, of facts on which the function depends.
    """

    off: NDArray[np.float64]
    function: NDArray[np.int64]
    told: NDArray[np.int64]


@dataclass(frozen=True)
class Interactions:
    """The coefficients c_A ≠ 0, E of them, of G label functions.

    Attributes:
        hypotheses: the candidates.
        transitions: G arrays, which transitions have each function.
        facts: [G] those on which a function depends, as a bitmask.
        function: [E] of which function; ascending.
        row: [E] the candidate A.
        coefficient: [1 + V, E] by variant.
    """

    hypotheses: Hypotheses
    transitions: tuple[NDArray[np.int64], ...]
    facts: NDArray[np.int64]
    function: NDArray[np.int64]
    row: NDArray[np.int64]
    coefficient: NDArray[np.float64]

    @classmethod
    def of(cls, hypotheses: Hypotheses) -> Interactions:
        """Of all transitions whose label tells anything."""
        own = np.flatnonzero(hypotheses.matters)
        tables = hypotheses.tables[:, :, own]
        bits = np.packbits(tables.reshape(-1, len(own)), axis=0)
        _, first, which = np.unique(bits, axis=1, return_index=True, return_inverse=True)
        values = tables[:, :, first].astype(np.int16)
        for _, more, less in hypotheses.pairs:
            values[:, more] -= values[:, less]
        function, row = np.nonzero(values.any(axis=0).T)
        return cls(
            hypotheses,
            tuple(own[which.ravel() == g] for g in range(len(first))),
            hypotheses.matters[own[first]],
            function,
            row,
            values[:, row, function].astype(np.float64),
        )

    @cached_property
    def _sets(self) -> NDArray[np.int64]:
        return self.hypotheses.facts[self.row]

    @cached_property
    def _incidence(self) -> tuple[NDArray[np.int64], ...]:
        """Of each fact in each A: which A, its other facts, and the fact's cell in [G, n]."""
        n = self.hypotheses.n_messages
        entry, fact = np.nonzero(self._sets[:, None] >> np.arange(n) & 1)
        return entry, self._sets[entry] & ~(1 << fact), self.function[entry] * n + fact

    def nearest(self, weight: NDArray[np.float64], middle: float, count: int) -> Nearest:
        """See :class:`xplain.questions.matrix.WeighedQuestions`: two questions a function,
        found from nothing told and from everything told. No question that differs from one of
        them in one message is nearer to the middle."""
        share = self._shares(weight)
        found = []
        for start in (np.zeros_like(self.facts), self.facts):
            kept, off = self._turned(share, middle, start)
            found.append(Nearest(off, np.arange(len(kept)), self.facts & ~kept))
        return Nearest(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def _shares(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """[E] Σ_v c^v_A Σ_{R ⊇ A} weight(v, R)."""
        above = weight.copy()
        for _, more, less in self.hypotheses.pairs:
            above[:, less] += above[:, more]
        return np.asarray((self.coefficient * above[:, self.row]).sum(axis=0))

    def _sum(self, share: NDArray[np.float64], kept: NDArray[np.int64]) -> NDArray[np.float64]:
        inside = self._sets & ~kept[self.function] == 0
        return np.bincount(self.function[inside], share[inside], len(kept)).astype(np.float64)

    def _turned(
        self, share: NDArray[np.float64], middle: float, kept: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """What is not told of each function [G], from ``kept`` on, and how far from the middle."""
        n, every = self.hypotheses.n_messages, np.arange(len(kept))
        entry, rest, cell = self._incidence
        value = self._sum(share, kept)
        while True:
            # Turning fact j adds, or takes away, all A with j whose other facts are not told.
            there = rest & ~kept[self.function[entry]] == 0
            change = np.bincount(cell[there], share[entry[there]], len(kept) * n).reshape(-1, n)
            change *= 1 - 2 * (kept[:, None] >> np.arange(n) & 1)
            off = np.abs(value[:, None] + change - middle)
            best = off.argmin(axis=1)
            better = off[every, best] < np.abs(value - middle) - TURN
            if not better.any():
                return kept, np.abs(value - middle)
            kept = np.where(better, kept ^ 1 << best, kept)
            value = np.where(better, value + change[every, best], value)
