r"""The likelihood of answers if hypotheses may be wrong at some transitions, and the fact sets that
are compared by this likelihood.

A person believes the facts R incorrectly and was given the messages H. The answer of this person
about τ belongs to the *cell* (τ, R \ H). The label f of a cell differs from the hypotheses with
probability δ, and an answer may differ from the label (:mod:`xplain.learning.answers`)::

    P(answers in a cell) = Σ_f P(f | hypotheses, δ) Π P(answer | f)

So one contradiction in a cell counts as an error, and several change the label of the cell. Each
type has one of a few levels of δ, which is summed out. The error rates of answers are learned from
all people. If only one person's answers are known, all answers have one error rate ε, and its few
levels are summed out too.

If there are too many facts to list all sets, the first candidates are the sets of very few facts.
For each likely set, all sets with one further fact (its *neighbours*) are added. The list then has
the likely sets and their neighbours; a missing set differs from every likely set by several facts.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit, logsumexp

from xplain.domains.users.hypotheses import Hypotheses
from xplain.domains.users.setting import MAX_MODELS
from xplain.errors import DomainError, TooLargeError
from xplain.learning.answers import sum_by_group
from xplain.learning.data.dataset import Dataset, number_rows, places

log = logging.getLogger(__name__)


def log_cell(
    one: NDArray[np.float64], given_zero: ArrayLike, given_one: ArrayLike
) -> NDArray[np.float64]:
    """Computes the log probability of the answers in a cell, log Σ_f P(f) P(answers | f). All
    searches for types share this likelihood.

    Args:
        one: P(f = 1) before any answer, strictly between 0 and 1.
        given_zero, given_one: log P(answers in the cell | f) for f = 0, and for f = 1; shapes that
            broadcast with ``one``.
    """
    zero, own = np.asarray(given_zero), np.asarray(given_one)
    top = np.maximum(zero, own)
    return np.asarray(np.log((1 - one) * np.exp(zero - top) + one * np.exp(own - top)) + top)


def cell_posterior(one: NDArray[np.float64], said: ArrayLike) -> NDArray[np.float64]:
    """Computes P(f = 1 | answers in the cell).

    Args:
        one: P(f = 1) before any answer.
        said: log likelihood ratio, log P(answers | f = 1) − log P(answers | f = 0).
    """
    return np.asarray(expit(logit(one) + said))


WRONG = 0.05
"""Probability of a wrong answer if the error rate is unknown."""
LIKELY = 0.2
"""If the posterior of a set is at least this value, its neighbours are added. A neighbour whose
further fact was never asked about has a smaller share of the posterior, so it adds no neighbours
itself."""


def grow(
    hypotheses: Hypotheses, posterior: Callable[[Hypotheses], NDArray[np.float64]]
) -> Hypotheses:
    """Adds all neighbours of likely sets, until every neighbour of a likely set is a candidate.

    Args:
        hypotheses: the candidates so far; returned unchanged if labels of further sets are unknown
            or cannot be computed.
        posterior: returns the posterior [C] of the candidates.
    """
    while hypotheses.further is not None:
        likely = hypotheses.facts[posterior(hypotheses) >= LIKELY]
        more = likely[:, None] | 1 << np.arange(hypotheses.n_messages)
        new = np.setdiff1d(more, hypotheses.facts)  # one further fact, no candidates yet
        if not len(new):
            break
        try:
            hypotheses = hypotheses.with_sets(new)
        except (DomainError, TooLargeError) as error:
            log.info("no further hypotheses: %s", error)
            break
    return hypotheses


def posterior_by(
    hypotheses: Hypotheses,
    transitions: NDArray[np.int64],
    told: NDArray[np.int64],
    labels: NDArray[np.integer],
) -> NDArray[np.float64]:
    """Computes the posterior of the candidates given the answers of one type. One answer in twenty
    is assumed to be wrong.

    Args:
        hypotheses: C candidates.
        transitions, told, labels: [P] transition, message set and label of each answer.

    Returns:
        [C] the posterior.
    """
    agree = (hypotheses.label(transitions, told) == labels).sum(axis=2)
    with np.errstate(divide="ignore"):
        joint = agree * np.log((1 - WRONG) / WRONG) + np.log(hypotheses.prior)
    joint += np.log(hypotheses.variant_prior)[:, None]
    return np.asarray(np.exp(joint - logsumexp(joint)).sum(axis=0))


UNWRITTEN = 0.1
"""Probability that a person believes a fact incorrectly that no hypothesis contains."""
MATTERS = 0.2
"""Share of the otherwise explicable labels that such a fact makes inexplicable."""


SUPPORTED = 1e-3
"""If there are too many facts to list all sets, only candidates with at least this posterior, given
the answers of one observer or one type, are compared in more detail with all answers."""


@dataclass(frozen=True)
class KnownTransitions:
    """Label table of the hypotheses with one column for each distinct row of features. Transitions
    with equal features share a column, which has their mean label.

    A message whose fact is in no hypothesis may still correct a belief. So there are also
    candidates with such a fact, alone or with other facts. The effect of such a fact is unknown:
    any label may be 0 instead of 1, and the answers show which labels are 0.

    In the shapes, C is the number of candidates, U of distinct rows of features, and V of variants
    of the inaccurate values; index 0 of 1 + V is for the values without a variant. f is the label
    of a cell. It differs from the hypotheses with probability δ, which has one of the D values in
    :data:`DEVIATION`.

    Attributes:
        hypotheses: hypotheses with features, including the candidates with unwritten facts.
        unwritten: facts that no hypothesis contains, as a bitmask.
        features: [U, F] float32, distinct rows of F features.
        first: [U] the first transition of the hypotheses with each row of features.
        share: [1 + V, C, U] float64, share of the transitions with these features that are labelled
            1.
    """

    hypotheses: Hypotheses
    features: NDArray[np.float32]
    first: NDArray[np.int64]
    share: NDArray[np.float64]
    unwritten: int = 0

    @classmethod
    def of(cls, hypotheses: Hypotheses) -> KnownTransitions:
        """Groups the transitions of hypotheses by their features."""
        assert hypotheses.features is not None
        hypotheses, unwritten = _add_unwritten(hypotheses)
        rows = np.asarray(hypotheses.features, dtype=np.float32)
        distinct, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        member = which.ravel() == np.arange(len(distinct))[:, None]
        share = hypotheses.tables @ (member / member.sum(axis=1, keepdims=True)).T
        share *= _compute_certainty(hypotheses.facts, unwritten)[:, None]
        return cls(hypotheses, distinct, first, share, unwritten)

    def grow(self, answers: Dataset) -> KnownTransitions:
        """Adds all neighbours (sets with one further fact) of each candidate that is likely given
        the answers of one type, until every neighbour of a likely candidate is a candidate."""
        found = grow(self.hypotheses, lambda known: self._compute_posterior(known, answers))
        return self if found is self.hypotheses else KnownTransitions.of(found)

    def with_sets(self, facts: NDArray[np.int64]) -> KnownTransitions:
        """Adds these fact sets and their subsets as candidates."""
        found = self.hypotheses.with_sets(facts)
        return self if found is self.hypotheses else KnownTransitions.of(found)

    def find_supported(self, answers: Dataset) -> NDArray[np.int64]:
        """Returns the distinct sets of essential facts (bitmasks, ascending) of the probable
        candidates, given the answers of one type. If all fact sets are candidates, returns the sets
        of all candidates."""
        if self.hypotheses.complete:
            return np.unique(self.essential)
        posterior = self._compute_posterior(self.hypotheses, answers)
        return np.unique(self.essential[posterior >= min(SUPPORTED, posterior.max())])

    def _compute_posterior(self, hypotheses: Hypotheses, answers: Dataset) -> NDArray[np.float64]:
        """Computes the posterior [C] of the candidates given the answers of one type. One
        transition represents all transitions with the same features."""
        transition = self.first[answers.transition]
        return posterior_by(hypotheses, transition, answers.message_set, answers.label)

    @cached_property
    def essential(self) -> NDArray[np.int64]:
        """[C] for each candidate, a bitmask of its facts that at least one question can reveal
        (``Hypotheses.essential``) and of its unwritten facts (attribute ``unwritten``)."""
        return self.hypotheses.essential | self.hypotheses.facts & self.unwritten

    def prior_of(self, facts: NDArray[np.int64]) -> NDArray[np.float64]:
        """Computes the prior of each fact set in ``facts`` [R]: the sum over all candidates whose
        essential facts are this set."""
        every, which = np.unique(self.essential, return_inverse=True)
        prior = np.bincount(which.ravel(), self.hypotheses.prior)
        return np.asarray(prior[np.searchsorted(every, facts)], np.float64)

    @cached_property
    def log_prior(self) -> NDArray[np.float64]:
        """[1 + V, D] log prior of each pair (variant, δ)."""
        return np.log(self.hypotheses.variant_prior)[:, None] + np.log(DEVIATION_PRIOR)

    def exactly(
        self, held: NDArray[np.int64], transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Computes [P, 1 + V, D] P(f = 1) from the label of each transition itself, not from the
        mean label of the transitions with the same features.

        Args:
            held: [P] facts that the person believes incorrectly, as bitmasks.
            transitions: [P] transitions of the hypotheses.
        """
        labels = self.hypotheses.tables[:, self.hypotheses.row(held), transitions]
        return self._add_deviations((labels * _compute_certainty(held, self.unwritten)).T)

    @cached_property
    def _by_cell(self) -> NDArray[np.float64]:
        """[C · U, 1 + V] the values of :attr:`share`. Row c · U + u is for candidate c and row u of
        the features; this number is the cell's key."""
        return np.ascontiguousarray(self.share.reshape(len(self.share), -1).T)

    def truth(self, key: NDArray[np.int64]) -> NDArray[np.float64]:
        """Computes [..., 1 + V, D] P(f = 1) before any answer, for each variant and value of δ, of
        the cells with the keys ``key`` [...] (see :attr:`Cells.key`)."""
        return self._add_deviations(self._by_cell[key])

    def _add_deviations(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        """Computes P(f = 1) of cells if their labels may differ from the hypotheses.

        δ, the probability that a label differs, is DISPUTED times larger (but at most ⅓) in cells
        in which ``share`` is not the same for all variants of ``Hypotheses.sizes``.

        Args:
            share: [..., 1 + V] P(label = 1) as the hypotheses predict it, by variant.

        Returns:
            [..., 1 + V, D] P(f = 1), by variant and δ.
        """
        of_sizes = share[..., self.hypotheses.sizes]
        disputed = of_sizes.min(axis=-1) != of_sizes.max(axis=-1)
        more = np.minimum(DISPUTED * DEVIATION, DEVIATION[-1])
        deviation = np.where(disputed[..., None], more, DEVIATION)[..., None, :]
        one = share[..., None]
        return np.asarray(one * (1 - deviation) + (1 - one) * deviation)

    @cached_property
    def ambiguous(self) -> NDArray[np.bool_]:
        """[U] True if transitions with these features have different labels."""
        written = self.share[:, self.hypotheses.facts & self.unwritten == 0]
        return np.asarray(((written > 0) & (written < 1)).any(axis=(0, 1)))

    @cached_property
    def _exact(self) -> dict[bytes, int]:
        states, rows = self.hypotheses.states, self.hypotheses.features
        if states is None or rows is None:
            return {}
        return number_rows(np.hstack([states, rows.astype(np.float32)]))

    def find_exactly(
        self, features: NDArray[np.float64], states: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Returns [P] the index of the hypotheses' transition with each row of ``features`` [P, F]
        and of ``states`` [P, 2] (start and end state); −1 if there is no such transition."""
        return places(np.hstack([states, features.astype(np.float32)]), self._exact)

    @cached_property
    def _place(self) -> dict[bytes, int]:
        return number_rows(self.features)

    def find(self, features: NDArray[np.floating]) -> NDArray[np.int64]:
        """Returns [P] the index in :attr:`features` of each of the given rows [P, F]; −1 for rows
        that the hypotheses do not contain."""
        return places(features.astype(np.float32), self._place)


def _add_unwritten(hypotheses: Hypotheses) -> tuple[Hypotheses, int]:
    """Adds candidates with unwritten facts: facts with a message that no candidate contains.

    Each new candidate is an old candidate with one unwritten fact added, and has the same labels.
    Returns the hypotheses and the unwritten facts.
    """
    written = int(np.bitwise_or.reduce(hypotheses.facts))
    open_facts = [1 << j for j in range(hypotheses.n_messages) if not written >> j & 1]
    candidates = len(hypotheses.facts)
    if not open_facts or candidates * (1 + len(open_facts)) > MAX_MODELS:
        return hypotheses, 0
    facts = np.concatenate([hypotheses.facts | more for more in (0, *open_facts)])
    order = np.argsort(facts)
    like = np.tile(np.arange(candidates), 1 + len(open_facts))[order]
    each = [1 - UNWRITTEN, *[UNWRITTEN / len(open_facts)] * len(open_facts)]
    share = np.repeat(each, candidates)[order]
    extended = replace(
        hypotheses,
        labels=hypotheses.labels[like],
        facts=facts[order],
        prior=hypotheses.prior[like] * share,
        variants=hypotheses.variants[:, like] if len(hypotheses.variants) else hypotheses.variants,
    )
    return extended, sum(open_facts)


def _compute_certainty(held: NDArray[np.int64], unwritten: int) -> NDArray[np.float64]:
    """Computes the factor on P(label = 1) for people who believe unwritten facts incorrectly: 1 −
    MATTERS for people who believe at least one unwritten fact incorrectly, otherwise 1.

    Args:
        held: the facts that people believe incorrectly, as bitmasks.
        unwritten: the unwritten facts, as a bitmask.
    """
    return np.where(held & unwritten, 1 - MATTERS, 1.0)


DEVIATION = np.array([0.0005, 0.005, 0.05, 1 / 3])
"""The possible values of δ. The last value is for people whom no hypothesis fits."""
DEVIATION_PRIOR = np.array([0.9, 0.06, 0.03, 0.01])
DISPUTED = 20.0
"""Factor on δ if variants of the hypotheses disagree; the product is at most ⅓."""
ERROR = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""The possible values of ε, equally likely."""


def by_level(label: NDArray[np.integer]) -> NDArray[np.float64]:
    """Computes [P, 2, E] log P(answer | f, ε) of P answers, for f = 0 and 1 and for each of the E
    error rates ε in :data:`ERROR`."""
    right = label[:, None] == np.arange(2)
    return np.asarray(np.where(right[:, :, None], np.log1p(-ERROR), np.log(ERROR)))


SCALE = np.array([0.05, 0.15, 0.4, 1.0, 2.0])
"""Possible factors by which one type's slips, guesses and error rates differ from the learned ones,
equally likely. Many contradictions in a cell are then explained by f rather than by slips if f fits
as well."""


def scale_errors(given: NDArray[np.float64], label: NDArray[np.integer]) -> NDArray[np.float64]:
    """Computes log P(answer | f) with error rates multiplied by each of the E factors in
    :data:`SCALE`.

    Args:
        given: [P, 2] log P(answer | f) of P answers with the learned error rates, for f = 0 and 1.
        label: [P] the answers, 0 or 1.

    Returns:
        [P, 2, E] log P(answer | f) for each factor.
    """
    right = label[:, None] == np.arange(2)
    wrong = np.exp(np.where(right, np.log(-np.expm1(given)), given))[:, :, None] * SCALE
    wrong = np.minimum(wrong, 0.45)
    return np.asarray(np.where(right[:, :, None], np.log1p(-wrong), np.log(wrong)))


@dataclass(frozen=True)
class Cells:
    """The cells (fact set still believed incorrectly, transition) of the P answers of one type, for
    each of R fact sets that the type may have. For each of these R sets the cells are separate.

    Attributes:
        which: [N] the index 0 … R − 1 of the fact set to which each cell belongs.
        where: [R, P] the index of each answer's cell, by fact set.
        key: [N] c · U + u: c is the index of the candidate with the facts that are still believed
            incorrectly, u the row of features. Ascending within a fact set.
        one: [N, 1 + V, D] P(f = 1) before any answer, by variant and δ.
    """

    which: NDArray[np.int64]
    where: NDArray[np.int64]
    key: NDArray[np.int64]
    one: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        known: KnownTransitions,
        transition: NDArray[np.int64],
        told: NDArray[np.int64],
        facts: NDArray[np.int64],
    ) -> Cells:
        """Finds the cells of P answers about known transitions, after the messages ``told`` [P],
        for people who believe ``facts`` [R] incorrectly."""
        held = known.hypotheses.row(facts[:, None] & ~told)
        size = known.share[0].size
        key = held * known.share.shape[2] + transition
        cells, where = np.unique(key + size * np.arange(len(facts))[:, None], return_inverse=True)
        key = cells % size
        return cls(cells // size, where.reshape(held.shape), key, known.truth(key))

    def sum_evidence(self, given: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sums the log likelihoods of the answers in each cell.

        Args:
            given: [P, 2, E] log P(answer | f) for f = 0 and 1 and each of E error rates or factors.

        Returns:
            [2, N, 1, 1, E] log P(answers in the cell | f).
        """
        every = np.tile(given, (len(self.where), 1, 1))
        total = sum_by_group(every, self.where.ravel(), len(self.key))
        return np.moveaxis(total, 1, 0)[:, :, None, None]

    def log_likelihood(self, given: NDArray[np.float64]) -> NDArray[np.float64]:
        """Computes the log likelihood of all answers for each fact set.

        Args:
            given: [P, 2, E] log P(answer | f) for f = 0 and 1 and each of E error rates or factors.

        Returns:
            [R, 1 + V, D, E] log P(answers | fact set, variant, δ, error rate or factor).
        """
        value = log_cell(self.one[..., None], *self.sum_evidence(given))
        return sum_by_group(value, self.which, len(self.where))
