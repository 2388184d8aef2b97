"""The hypotheses as answers are compared with them: by rows of features, and open to what nobody
wrote down."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.domains.users.setting import MAX_MODELS
from xplain.learning.data.dataset import numbered, places
from xplain.learning.fact_sets.growth import grown, posterior_by

UNWRITTEN = 0.1
"""Probability that somebody holds a fact wrong that has a message, but is in no hypothesis."""
MATTERS = 0.2
"""Share of what is explicable otherwise that such a fact makes inexplicable."""


SUPPORTED = 1e-3
"""Posterior given the answers of one observer, or one type, from which on a candidate is compared
with all answers more closely, where facts are too many to list all sets."""


class Answers(NamedTuple):
    """P answers: ``transition`` [P] (of :class:`KnownTransitions`), ``message_set`` [P] and
    ``label`` [P]."""

    transition: NDArray[np.int64]
    message_set: NDArray[np.int64]
    label: NDArray[np.int64]

    @classmethod
    def joined(cls, parts: Iterable[Answers]) -> Answers:
        """All of some, one after the other."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))

    def take(self, rows: NDArray[np.int64]) -> Answers:
        """Some of them."""
        return Answers(*(column[rows] for column in self))


@dataclass(frozen=True)
class KnownTransitions:
    """The hypotheses by rows of features: transitions that share one are one, of mean label.

    A message whose fact is in no hypothesis might yet set something right. People who hold such a
    fact wrong, alone or with others, are candidates as well. What it changes nobody knows: each
    label may be 0 instead, and answers say where it is.

    Attributes:
        hypotheses: with features; with the candidates who hold a fact wrong that nobody wrote down.
        unwritten: these facts, as a bitmask.
        features: [U, F] float32, distinct.
        share: [1 + V, C, U] float64, of the transitions with these features those labelled 1.
    """

    hypotheses: Hypotheses
    features: NDArray[np.float32]
    share: NDArray[np.float64]
    unwritten: int = 0

    @classmethod
    def of(cls, hypotheses: Hypotheses) -> KnownTransitions:
        """Of hypotheses that have features."""
        assert hypotheses.features is not None
        hypotheses, unwritten = _with_unwritten(hypotheses)
        rows = np.asarray(hypotheses.features, dtype=np.float32)
        distinct, which = np.unique(rows, axis=0, return_inverse=True)
        member = which.ravel() == np.arange(len(distinct))[:, None]
        share = hypotheses.tables @ (member / member.sum(axis=1, keepdims=True)).T
        share *= _certain(hypotheses.facts, unwritten)[:, None]
        return cls(hypotheses, distinct, share, unwritten)

    def grown(self, answers: Answers) -> KnownTransitions:
        """With the candidates that the answers of one type make likely, and those next to them."""
        found = grown(self.hypotheses, lambda known: self._posterior(known, answers))
        return self if found is self.hypotheses else KnownTransitions.of(found)

    def with_sets(self, facts: NDArray[np.int64]) -> KnownTransitions:
        """With further candidates, these sets and their subsets."""
        found = self.hypotheses.with_sets(facts)
        return self if found is self.hypotheses else KnownTransitions.of(found)

    def supported(self, answers: Answers) -> NDArray[np.int64]:
        """The essential facts of the candidates for which the answers of one type speak at all,
        ascending; where all sets are candidates, none is left out."""
        if self.hypotheses.complete:
            return np.unique(self.essential)
        posterior = self._posterior(self.hypotheses, answers)
        return np.unique(self.essential[posterior >= min(SUPPORTED, posterior.max())])

    def _posterior(self, hypotheses: Hypotheses, answers: Answers) -> NDArray[np.float64]:
        """Of transitions that share their features, one stands for all."""
        column = self._column[answers.transition]
        return posterior_by(hypotheses, column, answers.message_set, answers.label)

    @cached_property
    def _column(self) -> NDArray[np.int64]:
        """[U] a transition with each row of features."""
        rows = np.asarray(self.hypotheses.features, dtype=np.float32)
        return np.unique(rows, axis=0, return_index=True)[1]

    @cached_property
    def essential(self) -> NDArray[np.int64]:
        """[C] as of the hypotheses; what nobody wrote down is never taken to change nothing."""
        return self.hypotheses.essential | self.hypotheses.facts & self.unwritten

    def prior_of(self, facts: NDArray[np.int64]) -> NDArray[np.float64]:
        """[R] of those whose essential facts these are."""
        every, which = np.unique(self.essential, return_inverse=True)
        prior = np.bincount(which.ravel(), self.hypotheses.prior)
        return np.asarray(prior[np.searchsorted(every, facts)], np.float64)

    def share_of(
        self, held: NDArray[np.int64], transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(label 1) by the hypotheses' own transitions [P], whose features may be shared, of who
        holds these facts [P] wrong: [P, 1 + V]."""
        labels = self.hypotheses.tables[:, self.hypotheses.row(held), transitions]
        return np.asarray((labels * _certain(held, self.unwritten)).T, np.float64)

    @cached_property
    def by_cell(self) -> NDArray[np.float64]:
        """[C · U, 1 + V] :attr:`share` by the key of a cell."""
        return np.ascontiguousarray(self.share.reshape(len(self.share), -1).T)

    @cached_property
    def ambiguous(self) -> NDArray[np.bool_]:
        """[U] whether transitions that share the features are labelled differently."""
        written = self.share[:, self.hypotheses.facts & self.unwritten == 0]
        return np.asarray(((written > 0) & (written < 1)).any(axis=(0, 1)))

    @cached_property
    def _exact(self) -> dict[bytes, int]:
        states, rows = self.hypotheses.states, self.hypotheses.features
        if states is None or rows is None:
            return {}
        return numbered(np.hstack([states, rows.astype(np.float32)]))

    def find_exactly(
        self, features: NDArray[np.float64], states: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """[P] the hypotheses' transitions with these features [P, F] between these states [P, 2];
        −1 where there is none."""
        return places(np.hstack([states, features.astype(np.float32)]), self._exact)

    @cached_property
    def _place(self) -> dict[bytes, int]:
        return numbered(self.features)

    def find(self, features: NDArray[np.floating]) -> NDArray[np.int64]:
        """[P] where rows of features [P, F] are; −1 where the hypotheses do not know them."""
        return places(features.astype(np.float32), self._place)


def _with_unwritten(hypotheses: Hypotheses) -> tuple[Hypotheses, int]:
    """With each candidate those who hold one fact more wrong that has a message, but that no
    candidate holds wrong; and these facts. Their labels are as without it."""
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


def _certain(held: NDArray[np.int64], unwritten: int) -> NDArray[np.float64]:
    """P(the label is that of the hypotheses) of who holds these facts wrong, of any shape."""
    return np.where(held & unwritten, 1 - MATTERS, 1.0)
