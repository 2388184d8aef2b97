"""The probability of label 1 for every question at once.

A question is a transition τ and messages H. Under weights p over the candidates R::

    P(yes | τ, H) = Σ_R p(R) f_τ(R \\ H)

Only the facts S_τ on which τ depends count, so that H ⊆ S_τ are all questions that differ, and
transitions with the same label function are weighed once. Write f_τ(w) = Σ_{A ⊆ w} c_A (its Möbius
transform). With K = S_τ \\ H, what is not told, the sum is

    Σ_{A ⊆ K} c_A Σ_{R ⊇ A} p(R),

so that all 2^s questions about τ cost two zeta transforms, s 2^s additions, instead of 4^s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import TooLargeError
from xplain.explanation.message_sets import indices, names_of, subsets
from xplain.questions.interactions import Interactions, Nearest

MAX_FACTS = 14
"""Facts that one transition may depend on."""


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
    """All of them, where every set of facts is a candidate; else, as facts are many, those that a
    search finds (:mod:`xplain.questions.interactions`)."""
    if hypotheses.complete:
        return AllQuestions(groups(hypotheses))
    return Interactions.of(hypotheses)


@dataclass(frozen=True)
class AllQuestions:
    """Every question there is, weighed at once."""

    groups: tuple[FactGroup, ...]

    @cached_property
    def transitions(self) -> Sequence[NDArray[np.int64]]:
        """Of each function, group by group."""
        return [own for group in self.groups for own in group.transitions]

    def nearest(self, weight: NDArray[np.float64], middle: float, count: int) -> Nearest:
        """See :class:`WeighedQuestions`."""
        off = [group.expected(weight) for group in self.groups]
        for values in off:
            np.abs(np.subtract(values, middle, out=values), out=values)
        within = _smallest([values.ravel() for values in off], count) + EQUAL
        found, first = [], 0
        for group, values in zip(self.groups, off, strict=True):
            kept, function = np.nonzero(values <= within)
            told = group.facts[-1] & ~group.facts[kept]
            found.append(Nearest(values[kept, function], first + function, told))
            first += len(group.transitions)
        return Nearest(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


@dataclass(frozen=True)
class FactGroup:
    """The label functions that depend on the same s facts.

    Attributes:
        facts: [2^s] int64 the subsets of these facts, in the order of the table.
        packed: [C] int64 of each candidate the position of its facts among them.
        coefficients: [1 + V, 2^s, G] float64 c_A of each function, by variant.
        transitions: G arrays, which transitions have each function.
    """

    facts: NDArray[np.int64]
    packed: NDArray[np.int64]
    coefficients: NDArray[np.float64]
    transitions: tuple[NDArray[np.int64], ...]

    def expected(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Σ weight(v, R) f^v(R ∩ K) by the facts K that are not told: weight [1 + V, C] →
        [2^s, G]."""
        result = np.zeros(self.coefficients.shape[1:])
        for own, coefficients in zip(weight, self.coefficients, strict=True):
            held = np.bincount(self.packed, own, minlength=len(self.facts))
            # By the complement: sums over supersets become sums over subsets.
            above = held[::-1].astype(np.float64)
            _zeta(above)
            result += coefficients * above[::-1, None]
        _zeta(result)
        return result


def groups(hypotheses: Hypotheses) -> tuple[FactGroup, ...]:
    """The label functions of all transitions whose label tells anything, by their facts.

    Raises:
        TooLargeError: a transition depends on more than MAX_FACTS facts.
    """
    found = []
    for mask in np.unique(hypotheses.matters[hypotheses.matters > 0]).tolist():
        own = np.flatnonzero(hypotheses.matters == mask)
        facts = indices(mask)
        if len(facts) > MAX_FACTS:
            names = ", ".join(names_of(mask, hypotheses.messages))
            raise TooLargeError(
                f"hypotheses: labels of transition {own[0]} depend on {len(facts)} facts, at most "
                f"{MAX_FACTS}: {names}"
            )
        held = subsets(facts)
        known = np.isin(held, hypotheses.facts)  # all others have weight 0
        labels = np.zeros((len(hypotheses.tables), len(held), len(own)))
        labels[:, known] = hypotheses.tables[:, hypotheses.row(held[known])][:, :, own]
        every = labels.reshape(-1, len(own))
        _, first, which = np.unique(
            np.packbits(every.astype(bool), axis=0), axis=1, return_index=True, return_inverse=True
        )
        transitions = tuple(own[which.ravel() == g] for g in range(len(first)))
        packed = np.searchsorted(held, hypotheses.facts & mask)
        coefficients = np.ascontiguousarray(labels[:, :, first])
        for one in coefficients:
            _zeta(one, -1)
        found.append(FactGroup(held, packed, coefficients, transitions))
    return tuple(found)


def _smallest(parts: list[NDArray[np.float64]], count: int) -> float:
    """The ``count``-th smallest of all numbers, or the largest where they are fewer."""
    if count == 1:
        return min(float(part.min()) for part in parts)
    merged = np.concatenate(parts)
    last = min(count, len(merged)) - 1
    return float(np.partition(merged, last)[last])


def _zeta(values: NDArray[np.float64], sign: int = 1) -> None:
    """Sums values [2^s, …] over all subsets of each set, in place; the inverse with sign −1."""
    size = 1
    while size < len(values):
        pairs = values.reshape(-1, 2, size, *values.shape[1:])
        pairs[:, 1] += sign * pairs[:, 0] if sign < 0 else pairs[:, 0]
        size *= 2
