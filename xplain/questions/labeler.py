"""A labeler of hypotheses: P(label = 1) of people of one type, by what they may hold wrong.

What it knows of a type is a posterior over fact sets; where a cell was asked about and the answers
contradict the hypotheses, its label goes by the answers (:mod:`xplain.questions.likelihood`), all
others stay with the hypotheses. docs/what-to-ask.md
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from xplain.data.dataset import Dataset, inputs
from xplain.data.observers import Observed
from xplain.errors import InputError, TooLargeError
from xplain.explanation.label_table import DENSE, LabelTable
from xplain.learning.answer_model import AnswerModel
from xplain.learning.clustering import Clustering
from xplain.learning.labelers import (
    Labeler,
    LabelerTrainer,
    check_looked_at,
    paper_tree,
)
from xplain.message_sets import bits_of, indices, names_of, subsets
from xplain.questions.designs import hypotheses_of
from xplain.questions.fact_sets import errors_of, partition
from xplain.questions.hypotheses import Hypotheses
from xplain.questions.known_transitions import Answers, KnownTransitions
from xplain.questions.likelihood import Cells, by_level, log_prior, scaled, truth
from xplain.randomness import derived_seed, stream

log = logging.getLogger(__name__)

KEPT = 1e-4
"""Fact sets with a smaller share of the posterior are left out of predictions."""
RELEVANT = 0.01
MOST = 12
MAX_TABLE = 1 << 24
EDGE = 0.002
"""Probabilities stay so far from 0 and 1. A label is shown again with every later step, so that
larger doubts about what nothing speaks against would add up to messages that nobody needs."""


class FactSetClassifier:
    """The posterior over the fact sets of one type, with what labelers ask of a classifier.

    It predicts what people find explicable, f, not what they answer: errors in answers are left
    out. Rows of features that the hypotheses do not know are left to ``fallback``.

    Attributes:
        known: the hypotheses.
        fallback: a fitted classifier.
        facts: [R] fact sets that are likely.
        weight: [R, 1 + V, D] their posterior with variant and deviation.
        cells: the answers by cell, for each fact set.
        learned: [N] P(f = 1) of each cell, times the weight of its fact set.
    """

    classes_ = np.array([0, 1])
    is_sound = True

    def __init__(
        self,
        known: KnownTransitions,
        answers: Answers,
        fallback: Any,
        given: NDArray[np.float64] | None = None,
    ) -> None:
        """Works out the posterior over fact sets, variants and deviations.

        Args:
            known, fallback: see above.
            answers: P of people of the type.
            given: [P, 2, E] log P(answer | f) for f = 0 and 1, by levels of error that are as
                likely; None: of answers that all err as often.
        """
        self.known, self.fallback = known, fallback
        given = by_level(answers.label) if given is None else given
        facts = known.supported(answers)
        prior = np.log(known.prior_of(facts) + 1e-300)
        joint = Cells.of(known, answers, facts, given).log_likelihood(len(facts))
        joint += prior[:, None, None, None] + log_prior(known.hypotheses)[:, :, None]
        posterior = np.exp(joint - logsumexp(joint))
        kept = posterior.sum(axis=(1, 2, 3)) > KEPT
        posterior = posterior[kept] / posterior[kept].sum()
        self.facts, self.weight = facts[kept], posterior.sum(axis=3)
        self.cells = Cells.of(known, answers, self.facts, given)
        zero, one = self.cells.log_joint()
        of_cell = np.exp(one - np.logaddexp(zero, one)) * posterior[self.cells.which]
        self.learned = of_cell.sum(axis=(1, 2, 3))

    @property
    def looked_at(self) -> int:
        """The facts that people of the type may hold wrong. Where facts are many, those they do
        with a probability of RELEVANT, the likeliest MOST of them; other messages are
        taken to be never given."""
        if self.known.hypotheses.complete:
            return int(np.bitwise_or.reduce(self.facts, initial=0))
        bits = bits_of(self.facts, self.known.hypotheses.n_messages)
        share = self.weight.sum(axis=(1, 2)) @ bits
        likely = np.argsort(-share, kind="stable")[:MOST]
        return sum(1 << int(j) for j in likely if share[j] >= RELEVANT)

    def known_rows(
        self, transition: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(f = 1) of known transitions [P] under message sets [P]: [P]."""
        known, result = self.known, np.zeros(len(transition))
        for r, facts in enumerate(self.facts.tolist()):
            key = known.hypotheses.row(facts & ~told) * known.share.shape[2] + transition
            cells, place = np.unique(key, return_inverse=True)
            one = (truth(known.by_cell[cells], known.hypotheses.sizes) * self.weight[r]).sum(
                axis=(1, 2)
            )
            own = np.flatnonzero(self.cells.which == r)
            _, here, there = np.intersect1d(
                cells, self.cells.key[own], assume_unique=True, return_indices=True
            )
            one[here] = self.learned[own][there]
            result += one[place.ravel()]
        return np.clip(result, EDGE, 1 - EDGE)

    def exactly(
        self, transitions: NDArray[np.int64], told: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """P(f = 1) by the hypotheses alone, of their transitions [P]: [P]. Where transitions
        share their features, nobody knows which of them an answer was about."""
        result = np.zeros(len(transitions))
        for r, facts in enumerate(self.facts.tolist()):
            share = self.known.share_of(facts & ~told, transitions)
            result += (truth(share, self.known.hypotheses.sizes) * self.weight[r]).sum(axis=(1, 2))
        return np.clip(result, EDGE, 1 - EDGE)

    def predict_proba(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        """P(label = 0) and P(label = 1) of rows [P, F + n]: [P, 2]."""
        n = self.known.hypotheses.n_messages
        told = x[:, -n:].astype(np.int64) @ (1 << np.arange(n, dtype=np.int64))
        transition = self.known.find(x[:, :-n])
        rows, one = transition >= 0, np.empty(len(x))
        one[rows] = self.known_rows(transition[rows], told[rows])
        if not rows.all():
            shares = self.fallback.predict_proba(x[~rows])
            ones = self.fallback.classes_ == 1
            one[~rows] = np.clip(shares[:, ones].sum(axis=1), EDGE, 1 - EDGE)
        return np.stack([1 - one, one], axis=1)

    def tabulated(self) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """All it knows: rows of features [U, F], and P(label = 1) of each by message set
        [U, 2^n].

        Raises:
            TooLargeError: more than MAX_TABLE numbers.
        """
        count, n = len(self.known.features), self.known.hypotheses.n_messages
        if count << n > MAX_TABLE:
            raise TooLargeError(f"types: a table of {count} × 2^{n} labels is too large for a file")
        told = np.tile(np.arange(1 << n), count)
        table = self.known_rows(np.repeat(np.arange(count), 1 << n), told)
        return self.known.features, table.reshape(count, 1 << n)

    def predict(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        """The likelier label of rows [P, F + n]: [P]."""
        return (self.predict_proba(x)[:, 1] >= 0.5).astype(np.int64)


@dataclass(frozen=True)
class HypothesisLabeler(Labeler):
    """A labeler that tells transitions apart that share their features."""

    def table(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64] | None = None
    ) -> LabelTable:
        """As :meth:`Labeler.table`. Where messages are many, those matter that are about facts that
        people of the type likely hold wrong."""
        relevant, table = self._looked_at(features)
        if transitions is not None and isinstance(self.classifier, FactSetClassifier):
            known, every = self.classifier.known, subsets(relevant)
            place = known.find(features)
            rows = np.flatnonzero((place >= 0) & known.ambiguous[place])
            found = known.find_exactly(features[rows], transitions[rows][:, [0, 2]])
            for row, t in zip(rows[found >= 0].tolist(), found[found >= 0].tolist(), strict=True):
                table[row] = self.classifier.exactly(np.full(len(every), t), every)
        return LabelTable.joined_types([relevant], [table])

    def _looked_at(
        self, features: NDArray[np.float64]
    ) -> tuple[Sequence[int], NDArray[np.float64]]:
        if self.n_messages <= DENSE or not isinstance(self.classifier, FactSetClassifier):
            return super()._looked_at(features)
        looked_at = self.classifier.looked_at
        unknown = self.classifier.known.find(features) < 0
        if unknown.any():
            tree = replace(self, classifier=self.classifier.fallback)
            looked_at |= sum(1 << j for j in tree._looked_at(features[unknown])[0])
        relevant = indices(looked_at)
        check_looked_at(len(relevant), self.n_messages)
        every = subsets(relevant)
        table = np.empty((len(features), len(every)))
        for t, row in enumerate(features):
            rows = np.broadcast_to(row, (len(every), len(row)))
            table[t] = self._probability(inputs(rows, every, self.n_messages))
        return relevant, table


@dataclass(frozen=True)
class HypothesisTrainer(LabelerTrainer):
    """Fits labelers that know what people might hold wrong.

    Labels of another task (with other features or messages) say nothing about the hypotheses, and
    are learned by the fallback alone; so are transitions that the hypotheses do not know.

    Attributes:
        classifier: the fallback, any scikit-learn classifier that gives probabilities.
        holdout: share of the distinct points held out to measure the accuracy.
        path: an ``.npz`` file of hypotheses with features; None: the observers' domain's.
        hypotheses: in place of both.
        answers: how the dataset's people err when they answer; None: all as often.
    """

    classifier: Any = field(default_factory=paper_tree)
    path: str | None = None
    hypotheses: Hypotheses | None = None
    answers: AnswerModel | None = None

    def given(self, observed: Observed) -> HypothesisTrainer:
        """With the hypotheses of the observers' domain, and the fact sets that their questions
        found likely, where it has no others."""
        if self.hypotheses is not None or self.path is not None or observed.setting is None:
            return self
        own = hypotheses_of(observed.setting.domain, None)
        return replace(
            self, hypotheses=own if observed.likely is None else own.with_sets(observed.likely)
        )

    @cached_property
    def known(self) -> KnownTransitions:
        """The hypotheses by rows of features.

        Raises:
            InputError: there are none, or none with features.
        """
        hypotheses = self.hypotheses or hypotheses_of(None, self.path)
        if hypotheses.features is None:
            raise InputError("hypotheses.features", None, "needed to match labels with hypotheses")
        return KnownTransitions.of(hypotheses)

    def fit(self, dataset: Dataset, seed: int) -> Labeler:
        """Fits one labeler to all labels of a dataset; see :meth:`LabelerTrainer.fit`.

        Raises:
            InputError: no labels.
        """
        if not _same_task(self.known.hypotheses, dataset.feature_names, dataset.messages):
            return LabelerTrainer(self.classifier, self.holdout).fit(dataset, seed)
        made = super().fit(dataset, seed)
        return HypothesisLabeler(**{one.name: getattr(made, one.name) for one in fields(made)})

    def fitted_to(self, dataset: Dataset, x: NDArray[np.float32], seed: int) -> Any:
        """A classifier fitted to the labels of a dataset, whose rows are x [P, F + n]."""
        fallback = super().fitted_to(dataset, x, seed)
        place = self.known.find(dataset.features)[dataset.transition]
        rows = np.flatnonzero(place >= 0)
        if not _same_task(self.known.hypotheses, dataset.feature_names, dataset.messages):
            return fallback
        own = dataset.take(rows)
        answers = _answers(place[rows], own)
        given = None
        if self.answers is not None:
            label = answers.label
            given = scaled(self.answers.log_given(own.transition, own.observer, label), label)
        return FactSetClassifier(self.known.grown(answers), answers, fallback, given)

    def with_errors(self, dataset: Dataset, assignment: NDArray[np.int64]) -> HypothesisTrainer:
        """With how these people err when they answer, their types [O] being given."""
        found = self._known_answers(dataset)
        if found is None:
            return self
        place, known, observers = found
        made = errors_of(known, observers, assignment)
        answers = replace(made, slip=made.slip[[*place, -1]], guess=made.guess[[*place, -1]])
        return replace(self, answers=answers)

    def find_types(self, dataset: Dataset, concentration: float, seed: int) -> Clustering | None:
        """The types by a Dirichlet process over fact sets; None where the hypotheses know nothing
        of the dataset.

        Args:
            dataset: labels of O observers.
            concentration: α of the process.
            seed: of the sampler.
        """
        found_answers = self._known_answers(dataset)
        if found_answers is None:
            return None
        place, known, observers = found_answers
        found = partition(known, observers, concentration, stream(derived_seed(seed, "types")))
        _, first = np.unique(found.facts, return_index=True)
        needs = found.facts[np.sort(first)]
        if surprise := int(np.bitwise_or.reduce(needs & known.unwritten)):
            names = ", ".join(names_of(surprise, dataset.messages))
            log.warning("some hold wrong what no hypothesis does; it is set right by: %s", names)
        expected = found.expected
        if expected is not None:
            ones = np.bincount(dataset.transition, dataset.label, len(place))
            mean = (ones + 1) / (np.bincount(dataset.transition, minlength=len(place)) + 2)
            expected = np.where(place >= 0, expected[:, place], mean)
        return Clustering(found.facts, "dirichlet", "hypotheses", needs=needs, expected=expected)

    def _known_answers(
        self, dataset: Dataset
    ) -> tuple[NDArray[np.int64], KnownTransitions, list[Answers]] | None:
        """Where the dataset's features [T] are among those that hypotheses know (−1 nowhere), these
        with all that any observer's answers make likely, and the answers of each observer; None
        where they know nothing of the dataset."""
        known = self.known
        if not _same_task(known.hypotheses, dataset.feature_names, dataset.messages):
            return None
        place = known.find(dataset.features)
        if (place < 0).all():
            return None
        every = _answers(place[dataset.transition], dataset)
        rows = [np.flatnonzero(dataset.observer == o) for o in range(len(dataset.observers))]
        observers = [every.take(own[every.transition[own] >= 0]) for own in rows]
        for own in observers:
            known = known.with_sets(self.known.grown(own).supported(own))
        return place, known, observers


def _answers(place: NDArray[np.int64], dataset: Dataset) -> Answers:
    """The labels of a dataset, about transitions [P]."""
    label = dataset.label.astype(np.int64)
    return Answers(place, dataset.message_set, label, np.ones(len(dataset)))


def _same_task(
    hypotheses: Hypotheses, feature_names: tuple[str, ...], messages: tuple[str, ...]
) -> bool:
    names = hypotheses.feature_names or feature_names
    return names == feature_names and hypotheses.messages == messages
