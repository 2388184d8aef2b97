r"""The information of questions: all questions as one matrix of labels, and their mutual
information with the beliefs of a person.

A question is a transition τ and messages H. With weights w over the candidates R (and variants)::

    P(label 1 | τ, H) = Σ_R w(R) f_τ(R \ H)

If H has the messages about all facts except K, this is a sum over the sets R ∩ K, which are
candidates too: the weights of all R with the same R ∩ K are added and multiplied by the matrix of
labels. A question has more information if its P(label 1) is closer to ½.

With few facts, every K is evaluated. Otherwise random sets K are evaluated for the label functions
in random order, until P(label 1) of a question is near enough to ½. (If the most probable candidate
has a weight above ½, the distance is at least this weight minus ½.) If no question is near enough,
the search continues from the best question: it adds single facts to K or removes them from K, as
long as P(label 1) comes closer to ½.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import entr

from xplain.domains.users.hypotheses import Hypotheses
from xplain.explanation.message_sets import indices, subsets

EQUAL = 1e-11
"""Questions tie if the distances of their P(label 1) from ½ differ by less than this number."""
CLOSE = 1e-3
"""A question within this distance of the best possible P(label 1) ends the search. It loses at most
1e-5 bits unless an answer is almost certain."""
SETS = 64
"""Number of random sets of facts in a search."""
PRODUCTS = 1 << 26
"""Maximum number of multiplications at a time."""


class Nearest(NamedTuple):
    """P questions with P(label 1) near a value.

    Attributes:
        off: [P] distance of P(label 1) from the value.
        function: [P] index of the label function.
        told: [P] message sets, restricted to the facts of the function.
    """

    off: NDArray[np.float64]
    function: NDArray[np.int64]
    told: NDArray[np.int64]


@dataclass(frozen=True)
class QuestionMatrix:
    """All questions about T transitions. Transitions with equal labels have one of G label
    functions; a question is such a function with a message set.

    Attributes:
        hypotheses: C candidates.
        labels: [G, (1 + V) · C] uint8, by function, variant and candidate.
        facts: [G] facts that a function depends on, as a bitmask.
        transitions: [P] transitions whose label depends on some fact.
        function: [P] label function of each transition.
        sets: [M] all sets of the facts that matter; None if there are too many.
    """

    hypotheses: Hypotheses
    labels: NDArray[np.uint8]
    facts: NDArray[np.int64]
    transitions: NDArray[np.int64]
    function: NDArray[np.int64]
    sets: NDArray[np.int64] | None

    @classmethod
    def of(cls, hypotheses: Hypotheses) -> QuestionMatrix:
        """Makes the matrix of all questions about transitions whose label depends on some fact."""
        own = np.flatnonzero(hypotheses.matters)
        tables = hypotheses.tables[:, :, own].reshape(-1, len(own))
        bits = np.packbits(tables, axis=0)
        _, first, which = np.unique(bits, axis=1, return_index=True, return_inverse=True)
        labels, facts = tables.T[first], hypotheses.matters[own[first]]
        every = int(np.bitwise_or.reduce(facts))
        few = labels.size << every.bit_count() <= PRODUCTS
        sets = subsets(indices(every)) if few else None
        return cls(hypotheses, labels, facts, own, which.ravel(), sets)

    def having(self, function: int) -> NDArray[np.int64]:
        """Returns the transitions with this label function."""
        return self.transitions[self.function == function]

    def probability(
        self, functions: NDArray[np.int64], kept: NDArray[np.int64], weight: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Computes [g, M] P(label 1) for g label functions and M sets K, if the messages about all
        facts except K are given.

        Args:
            functions: [g] indices of the label functions.
            kept: [M] the sets K.
            weight: [1 + V, C].
        """
        layers, count = weight.shape
        rows = self.hypotheses.row(self.hypotheses.facts & kept[:, None])
        cells = rows[:, None] + count * np.arange(len(kept) * layers).reshape(-1, layers, 1)
        all_weights = np.broadcast_to(weight, cells.shape)
        held = np.bincount(cells.ravel(), all_weights.ravel(), len(kept) * weight.size)
        return self.labels[functions].astype(np.float64) @ held.reshape(len(kept), -1).T

    def nearest(
        self,
        weight: NDArray[np.float64],
        middle: float,
        count: int,
        rng: np.random.Generator,
    ) -> Nearest:
        """Finds the ``count`` questions whose P(label 1) is nearest to ``middle``, if the
        candidates have the weights [1 + V, C]. Also returns all questions that tie with the last
        one, and possibly further questions. The search is exact if ``sets`` has all sets of
        facts."""
        # In each question, the most probable candidate has label 1 or label 0.
        enough = max(float(weight.max()) - middle, 0.0) + CLOSE
        n, best = self.hypotheses.n_messages, np.inf
        kept = self._draw_sets(rng) if self.sets is None else self.sets
        found: list[tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]] = []
        while True:
            for functions in self._split_functions(len(kept), rng):
                found.append(self._select_nearest(functions, kept, weight, middle, count))
                least = float(found[-1][0].min())
                if least <= enough and self.sets is None:
                    break
            off, function, own = (np.concatenate(parts) for parts in zip(*found, strict=True))
            if self.sets is not None or off.min() <= enough or off.min() >= best - EQUAL:
                told = self.facts[function] & ~own
                _, distinct = np.unique([function, told], axis=1, return_index=True)
                return Nearest(off[distinct], function[distinct], told[distinct])
            best = float(off.min())
            kept = own[off.argmin()] ^ (1 << np.arange(n))

    def _draw_sets(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """Draws random sets of facts of all sizes."""
        n = self.hypotheses.n_messages
        bits = rng.random((SETS, n)) < rng.random((SETS, 1))
        return np.asarray(bits @ (1 << np.arange(n)), dtype=np.int64)

    def _split_functions(self, sets: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
        """Splits the label functions, in random order, into groups that fit into memory; makes one
        group if there are few facts."""
        every = np.arange(len(self.facts))
        if self.sets is not None:
            return [every]
        size = max(PRODUCTS // (sets * self.labels.shape[1]), 1)
        return np.array_split(rng.permutation(every), -(-len(every) // size))

    def _select_nearest(
        self,
        functions: NDArray[np.int64],
        kept: NDArray[np.int64],
        weight: NDArray[np.float64],
        middle: float,
        count: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """Finds the questions with P(label 1) nearest to ``middle``. Returns their distances, their
        functions, and the sets K."""
        off = np.abs(self.probability(functions, kept, weight) - middle)
        # A fact without influence on a function makes no other question.
        other = self.sets is None or (kept & ~self.facts[functions, None]) == 0
        g, m = np.nonzero(np.broadcast_to(other, off.shape))
        values = off[g, m]
        last = min(count, len(values)) - 1
        near = np.flatnonzero(values <= np.partition(values, last)[last] + EQUAL)
        return values[near], functions[g[near]], kept[m[near]]


TIE = 1e-9
"""Questions and clips tie if their mutual information (in bits) differs by less than this
number."""


@dataclass(frozen=True)
class Posterior:
    """What is known about a person after some answers. The layers are the assumed values, V
    variants, and "no hypothesis fits".

    Attributes:
        hypotheses: C candidates.
        weight: [2 + V, C] posterior; sums to 1.
        error: [2 + V] probability that an answer is flipped.
        misread: probability that a clip is misread.
        rates: [2, T] slip, P(0 | f = 1), and guess, P(1 | f = 0), of each transition, before the
            flip; None: no slips or guesses.
    """

    hypotheses: Hypotheses
    weight: NDArray[np.float64]
    error: NDArray[np.float64]
    misread: float
    rates: NDArray[np.float64] | None = None

    def labels(self, transitions: ArrayLike, told: int) -> NDArray[np.int64]:
        """Returns [2 + V, C, Q] the labels by layer and candidate; the layer "no hypothesis fits"
        has the labels at the assumed values."""
        labels = self.hypotheses.label(transitions, told).astype(np.int64)
        return np.concatenate([labels, labels[:1]])

    def likelihood(
        self, transitions: Sequence[int], told: int, answers: Sequence[int]
    ) -> NDArray[np.float64]:
        """Computes [2 + V, C] P(answers | layer, candidate) of one question, with one answer for
        each transition."""
        labels, given = self.labels(transitions, told), np.array(answers)
        one = self._predict_answers(labels, np.asarray(transitions))
        each = np.where(given == 1, one, 1 - one).prod(axis=2)
        return np.asarray((1 - self.misread) * each + self.misread / 2 ** len(given))

    def _predict_answers(
        self, labels: NDArray[np.int64], transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [2 + V, C, Q] P(answer 1) given the labels [2 + V, C, Q]."""
        one = labels.astype(np.float64)
        if self.rates is not None:
            slip, guess = self.rates[:, transitions]
            one = np.where(labels == 1, 1 - slip, guess)
        error = self.error[:, None, None]
        return np.asarray((1 - error) * one + error * (1 - one))

    def gains(self, transitions: NDArray[np.int64], told: int) -> NDArray[np.float64]:
        """Computes [Q] the information, in bits, of the answers to Q questions about one transition
        each."""
        one = self._predict_answers(self.labels(transitions, told), transitions)
        one = (1 - self.misread) * one + self.misread / 2
        weight = self.weight[:, :, None]
        mean, noise = (
            (weight * one).sum(axis=(0, 1)),
            (weight * _compute_entropy(one)).sum(axis=(0, 1)),
        )
        return np.asarray(_compute_entropy(mean) - noise)

    def best_of(
        self, questions: Sequence[tuple[int, int]], rng: np.random.Generator
    ) -> tuple[int, int]:
        """Returns the most informative of these questions about one transition; ties are broken at
        random."""
        asked = np.array(questions, dtype=np.int64)
        value = np.empty(len(asked))
        for told in np.unique(asked[:, 1]).tolist():
            own = asked[:, 1] == told
            value[own] = self.gains(asked[own, 0], told)
        ties = np.flatnonzero(value > value.max() - TIE)
        transition, told = asked[rng.choice(ties)].tolist()
        return transition, told

    def best_questions(
        self, questions: QuestionMatrix, count: int, seen: list[int], rng: np.random.Generator
    ) -> list[tuple[int, int]]:
        """Returns the ``count`` most informative questions about one transition, best first. Among
        ties, questions about new transitions come first; other ties are broken at random.

        All errors flip labels 0 and 1 equally often, so a question has more information if its
        P(label 1) is closer to ½.
        """
        found = self._find_nearest(questions, count, rng)
        known = np.zeros(self.hypotheses.n_transitions, dtype=bool)
        known[seen] = True
        fresh = np.zeros(len(questions.facts), dtype=bool)
        fresh[questions.function[~known[questions.transitions]]] = True
        level = np.round(found.off / EQUAL)  # equal up to rounding
        order = np.lexsort((rng.random(len(level)), ~fresh[found.function], level))[:count]
        chosen = []
        for at in order.tolist():
            own = questions.having(found.function[at])
            unseen = own[~known[own]]
            transition = int(rng.choice(unseen if len(unseen) else own))
            chosen.append((transition, int(found.told[at])))
        return chosen

    def best_near_even(
        self, questions: QuestionMatrix, count: int, rng: np.random.Generator
    ) -> tuple[int, int]:
        """Returns the best question about one transition. The candidates are the ``count`` or more
        questions whose P(label 1), without slips and guesses, is nearest to ½."""
        found = self._find_nearest(questions, count, rng)
        pairs = zip(found.function.tolist(), found.told.tolist(), strict=True)
        every = {(int(t), told) for at, told in pairs for t in questions.having(at)}
        return self.best_of(sorted(every), rng)

    def _find_nearest(
        self, questions: QuestionMatrix, count: int, rng: np.random.Generator
    ) -> Nearest:
        weight = (1 - 2 * self.error)[:, None] * self.weight
        weight[0] += weight[-1]
        weight = weight[:-1]
        return questions.nearest(weight, weight.sum() / 2, count, rng)

    def best_clip(
        self, starts: list[tuple[int, int]], length: int, rng: np.random.Generator
    ) -> tuple[list[int], int]:
        """Grows a clip from each start: adds the most informative transition, one at a time.
        Returns the best clip, with its message set."""
        best, most = ([starts[0][0]], starts[0][1]), -1.0
        every = np.arange(self.hypotheses.n_transitions)
        gains = {told: self.gains(every, told) for told in {told for _, told in starts}}
        for start, told in starts:
            clip = [start]
            while len(clip) < length and len(after := self._find_next(clip)):
                own = gains[told][after]
                clip.append(int(rng.choice(after[own > own.max() - TIE])))
            if (value := float(gains[told][clip].sum())) > most + TIE:
                best, most = (clip, told), value
        return best

    def _find_next(self, clip: list[int]) -> NDArray[np.int64]:
        """Returns the transitions that can extend a clip, because they follow its last
        transition."""
        states = self.hypotheses.states
        others = np.setdiff1d(np.arange(self.hypotheses.n_transitions), clip)
        return others if states is None else others[states[others, 0] == states[clip[-1], 1]]


def _compute_entropy(one: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes the entropy, in bits, of an answer that is 1 with this probability."""
    return np.asarray((entr(one) + entr(1 - one)) / np.log(2))
