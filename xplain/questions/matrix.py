r"""The information of questions: all questions as one matrix of labels, and their mutual
information with the beliefs of a person.

A candidate R is a set of facts that a person may believe incorrectly. The person believes each of
these facts at an inaccurate value: the assumed values, or one of V variants (half the value, double
the value, …). A question is a transition τ with a set H of messages. The label function f_τ maps
the set of facts that are still believed incorrectly to the label of τ. With weights w over the
candidates, and for one variant::

    P(label 1 | τ, H) = Σ_R w(R) f_τ(R \ H)

With variants, this is also summed over the variants. If H has the messages about all facts except
K, then R \ H = R ∩ K, which is a candidate too. So the weights of all R with the same R ∩ K are
added, and multiplied by the matrix of labels. A question has more information if its P(label 1) is
closer to ½.

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
    """P questions whose P(label 1) is near a target value.

    Attributes:
        off: [P] distance of each question's P(label 1) from the target value.
        function: [P] index of each question's label function.
        told: [P] message set of each question; it has only messages about facts on which the label
            function depends.
    """

    off: NDArray[np.float64]
    function: NDArray[np.int64]
    told: NDArray[np.int64]


@dataclass(frozen=True)
class QuestionMatrix:
    """All questions about T transitions. A label function gives the labels of a transition by
    candidate and variant (see the module). Transitions with equal labels share one of G label
    functions; a question is a label function with a message set.

    Attributes:
        hypotheses: C candidates, with V variants of the inaccurate values.
        labels: [G, (1 + V) · C] uint8, labels of each label function. Columns 0 … C − 1 are the
            candidates at the assumed values, and the next C columns are the candidates of the first
            variant.
        facts: [G] bitmask of the facts on which each label function depends.
        transitions: [P] transitions whose label depends on some fact.
        function: [P] index of the label function of each of these transitions.
        sets: [M] all sets of the facts on which some label depends; None if there are too many
            sets.
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
        """Returns the transitions that have this label function."""
        return self.transitions[self.function == function]

    def probability(
        self, functions: NDArray[np.int64], kept: NDArray[np.int64], weight: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Computes P(label 1) of g · M questions: each of g label functions, with the messages
        about all facts except each of M sets K.

        Args:
            functions: [g] indices of the label functions.
            kept: [M] the sets K, as bitmasks.
            weight: [1 + V, C] weight of each candidate, at the assumed values and in each variant.

        Returns:
            [g, M] sum of the weights whose label is 1. This is P(label 1) if all weights sum to 1.
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
        """Finds the ``count`` questions whose P(label 1) is nearest to a target value. The search
        is exact if ``sets`` is not None.

        Args:
            weight: [1 + V, C] weight of each candidate, at the assumed values and in each variant.
            middle: the target value.
            count: number of questions.
            rng: random generator of the search.

        Returns:
            The questions, all questions that tie with the last of them, and possibly further
            questions.
        """
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
        """Draws SETS random sets of facts, small and large, as bitmasks."""
        n = self.hypotheses.n_messages
        bits = rng.random((SETS, n)) < rng.random((SETS, 1))
        return np.asarray(bits @ (1 << np.arange(n)), dtype=np.int64)

    def _split_functions(self, sets: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
        """Returns groups of label functions, in random order, such that a group and ``sets``
        sets K fit into memory. If all sets of facts can be listed, there is only one group."""
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
        """Selects the questions whose P(label 1) is nearest to a target value. The candidates for
        selection are all pairs of a label function and a set K. Such a question gives the messages
        about all facts except K.

        Args:
            functions: indices of the label functions.
            kept: the sets K, as bitmasks.
            weight: [1 + V, C] weight of each candidate, at the assumed values and in each variant.
            middle: the target value.
            count: minimum number of questions, if there are so many; ties with the last one are
                added.

        Returns:
            The distance from the target value, the label function, and the set K of each selected
            question.
        """
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
    """What is known about a person after some answers.

    The posterior has 2 + V layers. In layer 0, the person's incorrect beliefs have the assumed
    values. In layers 1 … V, they have the values of one variant of the hypotheses. In the last
    layer, no hypothesis fits the person.

    Attributes:
        hypotheses: C candidates, with V variants.
        weight: [2 + V, C] posterior of each layer and candidate; sums to 1.
        error: [2 + V] probability that an answer is flipped, in each layer.
        misread: probability that a clip (a question about several transitions) is misread.
        rates: [2, T] slip, P(0 | label 1), and guess, P(1 | label 0), of each transition, before an
            answer is flipped; None: no slips or guesses.
    """

    hypotheses: Hypotheses
    weight: NDArray[np.float64]
    error: NDArray[np.float64]
    misread: float
    rates: NDArray[np.float64] | None = None

    def labels(self, transitions: ArrayLike, told: int) -> NDArray[np.int64]:
        """Returns [2 + V, C, Q] the labels of Q transitions, by layer and candidate. The last
        layer, "no hypothesis fits", has the labels of layer 0."""
        labels = self.hypotheses.label(transitions, told).astype(np.int64)
        return np.concatenate([labels, labels[:1]])

    def likelihood(
        self, transitions: Sequence[int], told: int, answers: Sequence[int]
    ) -> NDArray[np.float64]:
        """Computes [2 + V, C] P(answers | layer, candidate) of one question.

        Args:
            transitions: the transitions of the question.
            told: its message set.
            answers: one answer for each transition.
        """
        labels, given = self.labels(transitions, told), np.array(answers)
        one = self._predict_answers(labels, np.asarray(transitions))
        each = np.where(given == 1, one, 1 - one).prod(axis=2)
        return np.asarray((1 - self.misread) * each + self.misread / 2 ** len(given))

    def _predict_answers(
        self, labels: NDArray[np.int64], transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [2 + V, C, Q] P(answer 1) of Q transitions whose labels are [2 + V, C, Q]."""
        one = labels.astype(np.float64)
        if self.rates is not None:
            slip, guess = self.rates[:, transitions]
            one = np.where(labels == 1, 1 - slip, guess)
        error = self.error[:, None, None]
        return np.asarray((1 - error) * one + error * (1 - one))

    def gains(self, transitions: NDArray[np.int64], told: int) -> NDArray[np.float64]:
        """Computes [Q] the information, in bits, of the answer to each of Q questions about one
        transition. All have the message set ``told``."""
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
        """Returns the most informative of the listed questions. Each is about one transition:
        (transition, message set). Ties are broken at random."""
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
        """Returns the ``count`` most informative questions about one transition, best first, as
        (transition, message set). Among ties, questions about transitions that are not in ``seen``
        come first; other ties are broken at random.

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
        """Returns the most informative question about one transition, as (transition, message
        set). Only some questions are compared: the ``count`` or more whose P(label 1), without
        slips and guesses, is nearest to ½."""
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
        """Returns the most informative clip (a question about several transitions) that the search
        finds. A clip grows from each start: the most informative transition is added, one at a
        time.

        Args:
            starts: (first transition, message set) of each clip.
            length: maximum number of transitions.
            rng: breaks ties.

        Returns:
            The transitions of the clip, and its message set.
        """
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
