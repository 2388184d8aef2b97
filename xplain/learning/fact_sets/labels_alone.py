"""Hypotheses against labels alone: what both foretell of answers (:mod:`xplain.learning.evidence`),
of a dataset, and while people are asked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset
from xplain.learning.evidence import Evidence, cheap, foretold
from xplain.learning.fact_sets.fact_set_classifier import FactSetClassifier
from xplain.learning.fact_sets.known_transitions import Answers, KnownTransitions
from xplain.learning.prediction import log_likelihood


@dataclass(frozen=True)
class TwoWays:
    """To foretell answers about transitions that the hypotheses know.

    Attributes:
        known: the hypotheses.
        place: [T] where these know the transitions of a dataset.
    """

    known: KnownTransitions
    place: NDArray[np.int64]

    def hypotheses(self, train: Dataset, test: Dataset) -> NDArray[np.float64]:
        """log P of each label of ``test``: [Q]."""
        return self.learned(train).log_answered(answers_of(self.place, test))

    def labels(self, train: Dataset, test: Dataset) -> NDArray[np.float64]:
        """The same, without hypotheses."""
        return log_likelihood(cheap().fit(train, 0), test)

    def learned(self, data: Dataset) -> FactSetClassifier:
        """Of people of one type, who err all as often."""
        answers = answers_of(self.place, data)
        return FactSetClassifier(self.known.grown(answers), answers, partial(cheap().fit, data, 0))

    def evidence(self, dataset: Dataset, assignment: NDArray[np.int64]) -> Evidence:
        """Of a dataset whose observers' types [O] are given."""
        dataset = dataset.take(np.flatnonzero(self.place[dataset.transition] >= 0))
        rows, *logs = foretold(dataset, assignment, (self.hypotheses, self.labels))
        members = (np.flatnonzero(assignment == t) for t in range(int(assignment.max()) + 1))
        types = [self.learned(dataset.of(own)) for own in members]
        doubt, unwritten = np.array([(one.doubt, one.unwritten) for one in types]).T
        of_type = assignment[dataset.observer[rows]]
        return Evidence(logs[0], logs[1], of_type, doubt, unwritten)


def by_observer(place: NDArray[np.int64], dataset: Dataset) -> list[Answers]:
    """:func:`answers_of` each observer, those about transitions that the hypotheses know."""
    every, known = answers_of(place, dataset), place[dataset.transition] >= 0
    observers = range(len(dataset.observers))
    return [every.take(np.flatnonzero(known & (dataset.observer == o))) for o in observers]


def answers_of(place: NDArray[np.int64], dataset: Dataset) -> Answers:
    """The labels of a dataset, about transitions that the hypotheses have at ``place`` [T]."""
    label = dataset.label.astype(np.int64)
    return Answers(place[dataset.transition], dataset.message_set, label)
