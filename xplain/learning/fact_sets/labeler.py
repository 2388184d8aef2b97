"""A labeler of hypotheses: P(label = 1) of people of one type, by what they may hold wrong.

What it knows of a type is a posterior over fact sets; where a cell was asked about and the answers
contradict the hypotheses, its label goes by the answers
(:mod:`xplain.learning.fact_sets.likelihood`), all others stay with the hypotheses.
docs/what-to-ask.md
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.errors import InputError
from xplain.explanation.label_table import DENSE, LabelTable
from xplain.explanation.message_sets import indices, names_of, subsets
from xplain.learning.answer_model import AnswerModel
from xplain.learning.clustering import Clustering
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observed
from xplain.learning.evidence import Evidence, cheap
from xplain.learning.fact_sets.fact_set_classifier import FactSetClassifier
from xplain.learning.fact_sets.known_transitions import Answers, KnownTransitions
from xplain.learning.fact_sets.labels_alone import TwoWays, answers_of, by_observer
from xplain.learning.fact_sets.likelihood import scaled
from xplain.learning.fact_sets.partition import errors_of, partition
from xplain.learning.labelers import (
    Labeler,
    LabelerTrainer,
    check_looked_at,
    paper_tree,
)

log = logging.getLogger(__name__)


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

    @property
    def wrong(self) -> NDArray[np.float64] | None:
        """As :attr:`Labeler.wrong`; None where the hypotheses know nothing of the task."""
        facts = isinstance(self.classifier, FactSetClassifier)
        return self.classifier.wrong if facts else None

    def _looked_at(
        self, features: NDArray[np.float64]
    ) -> tuple[Sequence[int], NDArray[np.float64]]:
        if self.n_messages <= DENSE or not isinstance(self.classifier, FactSetClassifier):
            return super()._looked_at(features)
        looked_at = self.classifier.looked_at
        alone = (self.classifier.known.find(features) < 0) | (self.classifier.trust < 1)
        if alone.any():
            looked_at |= sum(1 << j for j in self.classifier.alone._looked_at(features[alone])[0])
        relevant = indices(looked_at)
        check_looked_at(len(relevant), self.n_messages)
        return relevant, self._by_sets(features, subsets(relevant))


@dataclass(frozen=True)
class HypothesisTrainer(LabelerTrainer):
    """Fits labelers that know what people might hold wrong.

    Labels of another task (with other features or messages) say nothing about the hypotheses, and
    are learned without them; so are transitions that the hypotheses do not know. Where people of a
    type think otherwise than the hypotheses say, these are weighed against what is learned without
    them (:mod:`xplain.learning.evidence`).

    Attributes:
        classifier: learns from labels alone; any of scikit-learn that gives probabilities.
        holdout: share of the distinct points held out to measure the accuracy.
        path: an ``.npz`` file of hypotheses with features; None: the observers' domain's.
        hypotheses: in place of both.
        answers: how the dataset's people err when they answer; None: all as often.
        evidence: how well the dataset's answers were foretold; None: hypotheses are believed.
        types: [O] of the dataset's observers, as in ``evidence``.
    """

    classifier: Any = field(default_factory=paper_tree)
    path: str | None = None
    hypotheses: Hypotheses | None = None
    answers: AnswerModel | None = None
    evidence: Evidence | None = None
    types: NDArray[np.int64] | None = None

    def given(self, observed: Observed) -> LabelerTrainer:
        """With the hypotheses of the observers' domain, and the fact sets that their questions
        found likely, where it has no others."""
        if self.hypotheses is not None or self.path is not None:
            return self
        return replace(self, hypotheses=observed.hypotheses)

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

    def fit(self, dataset: Dataset, seed: int, measured: bool = True) -> Labeler:
        """As :meth:`LabelerTrainer.fit`; without hypotheses, where the labels are of another
        task."""
        if not _same_task(self.known.hypotheses, dataset.feature_names, dataset.messages):
            return self._alone.fit(dataset, seed, measured)
        made = super().fit(dataset, seed, measured)
        return HypothesisLabeler(**{one.name: getattr(made, one.name) for one in fields(made)})

    def fitted_to(self, dataset: Dataset, x: NDArray[np.float32], seed: int) -> Any:
        """A classifier fitted to the labels of a dataset, whose rows are x [P, F + n]."""
        place = self.known.find(dataset.features)
        own = dataset.take(np.flatnonzero(place[dataset.transition] >= 0))
        answers = answers_of(place, own)
        given, trust = None, 1.0
        if self.answers is not None:
            label = answers.label
            given = scaled(self.answers.log_given(own.transition, own.observer, label), label)
        if self.evidence is not None and self.types is not None:
            trust = float(self.evidence.trust[self.types[own.observer]].mean())
        trainer = self._alone if dataset.n_messages <= DENSE else cheap()
        alone = partial(trainer.fit, dataset, seed)
        return FactSetClassifier(self.known.grown(answers), answers, alone, given, trust)

    @property
    def _alone(self) -> LabelerTrainer:
        """Learns from labels alone."""
        return LabelerTrainer(self.classifier, self.holdout, "leaf")

    def with_errors(self, dataset: Dataset, assignment: NDArray[np.int64]) -> HypothesisTrainer:
        """With how these people err when they answer, their types [O] being given."""
        found = self._known_answers(dataset)
        if found is None:
            return self
        place, known, observers = found
        made = errors_of(known, observers, assignment)
        answers = replace(made, slip=made.slip[[*place, -1]], guess=made.guess[[*place, -1]])
        evidence = TwoWays(self.known, place).evidence(dataset, assignment)
        return replace(self, answers=answers, types=assignment, evidence=evidence)

    def find_types(self, dataset: Dataset, concentration: float) -> Clustering | None:
        """The types by a Dirichlet process over fact sets; None where the hypotheses know nothing
        of the dataset.

        Args:
            dataset: labels of O observers.
            concentration: α of the process.
        """
        found = self._known_answers(dataset)
        if found is None:
            return None
        place, known, observers = found
        facts, _, expected = partition(known, observers, concentration)
        same = np.unique(facts, return_inverse=True)[1]
        if TwoWays(self.known, place).evidence(dataset, same).beaten:
            return None
        if surprise := int(np.bitwise_or.reduce(facts & known.unwritten)):
            names = ", ".join(names_of(surprise, dataset.messages))
            log.warning("some hold wrong what no hypothesis does; it is set right by: %s", names)
        if expected is not None:
            ones = np.bincount(dataset.transition, dataset.label, len(place))
            mean = (ones + 1) / (np.bincount(dataset.transition, minlength=len(place)) + 2)
            expected = np.where(place >= 0, expected[:, place], mean)
        return Clustering.by_facts(facts, "hypotheses", expected=expected)

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
        observers = by_observer(place, dataset)
        for own in observers:
            known = known.with_sets(self.known.grown(own).supported(own))
        return place, known, observers


def _same_task(
    hypotheses: Hypotheses, feature_names: tuple[str, ...], messages: tuple[str, ...]
) -> bool:
    names = hypotheses.feature_names or feature_names
    return names == feature_names and hypotheses.messages == messages
