r"""How much questions tell: all questions as one matrix of labels where they are few, or searched
where they are many, and mutual information under what is known of a person.

A question is a transition τ and messages H. Under weights w over the candidates R (and variants)::

    P(label 1 | τ, H) = Σ_R w(R) f_τ(R \ H) = w @ L

Only the facts S_τ on which τ depends count, so that H ⊆ S_τ are all questions that differ, and
questions that all candidates label alike share one column of L.

Where facts are many, candidates are few of the 2^n sets. The label function of a transition, over
the candidates, is f(w) = Σ_{A ⊆ w} c_A (its Möbius transform; A, with each set its subsets, are
candidates too, and most c_A are 0). When the facts K are not told, the probability of label 1 is a
polynomial in K::

    P(yes | K) = Σ_{A ⊆ K} c_A Σ_{R ⊇ A} p(R)

A question tells the more the nearer it is to ½, and K is found by turning one fact after the other,
each time that which comes nearest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import entr

from xplain.domains.users.hypotheses import Hypotheses
from xplain.explanation.message_sets import indices, subsets

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
        """See :class:`WeighedQuestions`: two questions a function,
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


MAX_CELLS = 1 << 23
"""Questions by variants that are listed; more are searched instead."""
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
    """All of them; where they are too many, those that a search finds."""
    count = int((1 << np.bitwise_count(hypotheses.matters).astype(np.int64)).sum())
    if hypotheses.complete and count * len(hypotheses.tables) <= MAX_CELLS:
        return QuestionMatrix.of(hypotheses)
    return Interactions.of(hypotheses)


@dataclass(frozen=True)
class QuestionMatrix:
    """Q questions: label functions f, and the facts K that are not told of those S on which each
    depends. P(label 1) of all K follows from the Möbius transform c of f in |S| sweeps.

    Attributes:
        groups: for each S the number of R ∩ S of each candidate R, [C], and c [1 + V, 2^|S|, G].
        function: [Q] the label function of each question.
        told: [Q] its messages.
        transitions: which transitions have each function.
    """

    groups: tuple[tuple[NDArray[np.int64], NDArray[np.int16]], ...]
    function: NDArray[np.int64]
    told: NDArray[np.int64]
    transitions: tuple[NDArray[np.int64], ...]

    @classmethod
    def of(cls, hypotheses: Hypotheses) -> QuestionMatrix:
        """Of all transitions whose label tells anything. Of hypotheses that list some sets, with
        each set its subsets, no candidate holds the others, which count for nothing."""
        tables, facts = hypotheses.tables, hypotheses.facts
        groups, function, told = [], [], []
        transitions: list[NDArray[np.int64]] = []
        for mask in np.unique(hypotheses.matters[hypotheses.matters > 0]).tolist():
            own = np.flatnonzero(hypotheses.matters == mask)
            kept = subsets(indices(mask))
            rows = np.minimum(hypotheses.row(kept), len(facts) - 1)
            values, which = np.unique(tables[:, rows][..., own], axis=2, return_inverse=True)
            count = values.shape[2]
            coefficient = values.astype(np.int16)
            for low, high in _halves(coefficient):
                high -= low
            groups.append((np.searchsorted(kept, facts & mask), coefficient))
            function.append(np.tile(len(transitions) + np.arange(count), len(kept)))
            told.append(np.repeat(mask & ~kept, count))
            transitions += [own[which.ravel() == g] for g in range(count)]
        return cls(
            tuple(groups), np.concatenate(function), np.concatenate(told), tuple(transitions)
        )

    def probability(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """[Q] P(label 1) under the weights [1 + V, C]."""
        found = []
        for cell, coefficient in self.groups:
            size = coefficient.shape[1]
            above = np.stack([np.bincount(cell, own, size) for own in weight])[:, :, None]
            for low, high in _halves(above):
                low += high
            value = (coefficient * above).sum(axis=0)
            for low, high in _halves(value):
                high += low
            found.append(value.ravel())
        return np.concatenate(found)

    def nearest(self, weight: NDArray[np.float64], middle: float, count: int) -> Nearest:
        """See :class:`WeighedQuestions`."""
        off = np.abs(self.probability(weight) - middle)
        last = min(count, len(off)) - 1
        kept = np.flatnonzero(off <= np.partition(off, last)[last] + EQUAL)
        return Nearest(off[kept], self.function[kept], self.told[kept])


def _halves(values: NDArray[Any]) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """For each fact views of the values [..., 2^s, G] of all sets without it, and of the same sets
    with it."""
    *rest, size, count = values.shape
    for i in range(size.bit_length() - 1):
        split = values.reshape(*rest, -1, 2, 1 << i, count)
        yield split[..., 0, :, :], split[..., 1, :, :]


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
