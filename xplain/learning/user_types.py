"""User types: which observers are of one type, and one labeler for each type
(docs/method.md, section 4).

A component ``clusterer`` is a *type finder*, with one method::

    find(observed, seed) -> UserTypes

It is made with the trainer of the run, ``labeler=``. A :class:`Clusterer` groups the observers, and
fits a labeler to the labels of each group.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, Range, number
from xplain.explanation.label_table import DENSE, LabelTable, stacked
from xplain.learning.answers import AnswerModel
from xplain.learning.data.dataset import Dataset, inputs
from xplain.learning.data.observers import Observed
from xplain.learning.evidence import Evidence
from xplain.learning.labelers import FittedLabeler, Labeler, LabelerTrainer
from xplain.learning.types import Clustering

log = logging.getLogger(__name__)


class TypeFinder(Protocol):
    """Finds user types: the interface of every component ``clusterer``."""

    def find(self, observed: Observed, seed: int) -> UserTypes:
        """The types of the observers, with a labeler each.

        Args:
            observed: the labels of O observers. Their true types, where they are known, are for
                scoring; only :class:`Perfect` reads them.
            seed: of every draw.

        Raises:
            InputError: the method needs what the data do not have.
            TooLargeError: the data, or the messages, are too many for the method.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Clusterer(ABC):
    """A type finder that groups the observers.

    Attributes:
        labeler: fits the labeler of each group.
    """

    labeler: LabelerTrainer = field(default_factory=LabelerTrainer)

    @abstractmethod
    def cluster(self, observed: Observed, seed: int) -> Clustering:
        """Groups the observers: one cluster a type. As :meth:`TypeFinder.find`."""

    def find(self, observed: Observed, seed: int) -> UserTypes:
        """As :meth:`TypeFinder.find`."""
        trainer = self.labeler.given(observed)  # once: what it works out of its task is kept
        clustering = replace(self, labeler=trainer).cluster(observed, seed)
        types = learn_types(observed.dataset, clustering, trainer, seed)
        if types.evidence is not None and types.evidence.lost:
            log.warning("%s", types.evidence)
        return types


class Perfect(Clusterer):
    """The true types: perfect clustering, the source of the oracle's labelers (docs/method.md,
    section 6)."""

    def cluster(self, observed: Observed, seed: int) -> Clustering:
        """Raises InputError where the truth is not known."""
        if observed.behaviour is None:
            wanted = "needs simulated observers, whose type is known"
            raise InputError("clusterer", "perfect", wanted)
        return Clustering(np.asarray(observed.behaviour), "perfect", "truth")


class Single(Clusterer):
    """Everybody is of one type (the paper's baseline)."""

    def cluster(self, observed: Observed, seed: int) -> Clustering:
        """All O observers in cluster 0."""
        everybody = np.zeros(len(observed.dataset.observers), dtype=np.int64)
        return Clustering(everybody, "single", "one type")


@dataclass(frozen=True)
class UserTypes:
    """N learned user types.

    Attributes:
        labelers: N of them.
        clustering: the observers' types they were learned from.
        names: N, for people.
        prior: [N] P(type) of the next user.
        answers: how labels became answers, of the dataset's transitions and observers; None where
            nobody learned it.
        evidence: how well hypotheses foretold the answers; None where there are none.
        everything: the labeler of somebody who believes every fact incorrectly; None where facts
            are unknown.
    """

    labelers: tuple[Labeler, ...]
    clustering: Clustering
    names: tuple[str, ...]
    prior: NDArray[np.float64]
    answers: AnswerModel | None = None
    evidence: Evidence | None = None
    everything: Labeler | None = None

    @property
    def by_observers(self) -> dict[tuple[int, ...], Labeler]:
        """Each cluster's labeler, by its observers."""
        clusters = range(self.clustering.n_types)
        return {tuple(self.clustering.members(t).tolist()): self.labelers[t] for t in clusters}


def label_table(
    labelers: Iterable[Labeler],
    features: NDArray[np.float64],
    transitions: NDArray[np.int64] | None = None,
) -> LabelTable:
    """P(label = 1) of m transitions, a type a labeler.

    Args:
        labelers: N ≥ 1 of them.
        features: [m, F] of the transitions, as the labelers were trained on.
        transitions: [m, 3] with these features, where they are known.

    Raises:
        TooLargeError: a labeler looks at too many messages on these transitions.
    """
    return stacked([labeler.table(features, transitions) for labeler in labelers])


@dataclass(frozen=True)
class AskedOnce:
    """:func:`label_table`, but each labeler is asked of each transition once, however many traces
    hold it: asking may take longer than all that follows.

    Attributes:
        tables: [2^n] by labeler and transition; no more than the traces' own.
    """

    tables: dict[tuple[int, bytes], NDArray[np.float64]] = field(default_factory=dict)

    def label_table(
        self,
        labelers: Sequence[Labeler],
        features: NDArray[np.float64],
        transitions: NDArray[np.int64],
    ) -> LabelTable:
        """See :func:`label_table`. The labelers must live as long as this object."""
        return stacked([self._of(labeler, features, transitions) for labeler in labelers])

    def _of(
        self, labeler: Labeler, features: NDArray[np.float64], transitions: NDArray[np.int64]
    ) -> LabelTable:
        if labeler.n_messages > DENSE:  # a trace has relevant messages of its own
            return labeler.table(features, transitions)
        keys = [(id(labeler), row.tobytes()) for row in np.hstack([features, transitions])]
        new = {key: i for i, key in enumerate(keys) if key not in self.tables}
        if new:
            rows = list(new.values())
            asked = labeler.table(features[rows], transitions[rows])
            self.tables.update(zip(new, asked.p[:, :, 0], strict=True))
        return LabelTable.dense([[self.tables[key] for key in keys]])


def learn_types(
    dataset: Dataset,
    clustering: Clustering,
    trainer: LabelerTrainer,
    seed: int,
    known: Mapping[tuple[int, ...], Labeler] | None = None,
) -> UserTypes:
    """One labeler from the pooled labels of each cluster (paper, section 4.1); everybody's for a
    cluster without labels.

    Args:
        dataset: the labels.
        clustering: of its observers.
        trainer: fits the labelers.
        seed: of every fit. It is one for all types, so that a labeler depends on its labels alone,
            not on how clusters are numbered.
        known: labelers by their observers, fitted to this dataset with this trainer and seed: they
            are not fitted again.
    """
    clusters = [clustering.members(t) for t in range(clustering.n_types)]
    trainer, answers, evidence = trainer.with_errors(dataset, clustering.assignment)
    if trainer.means_truth and {tuple(own.tolist()) for own in clusters} != {*(known or ())}:
        known = None  # how people err was learned with other types
    labelers = tuple(
        (known or {}).get(tuple(own.tolist()))
        or trainer.fit(dataset.of(own) if np.isin(own, dataset.observer).any() else dataset, seed)
        for own in clusters
    )
    names = tuple(f"type_{t}" for t in range(clustering.n_types))
    answers = answers or clustering.answers
    shares, everything = clustering.shares, trainer.everything()
    return UserTypes(labelers, clustering, names, shares, answers, evidence, everything)


def with_none_of_these(types: UserTypes, dataset: Dataset, weight: float) -> UserTypes:
    """With one more type, for users unlike all others: it labels at everybody's rate, whatever is
    shown and said.

    Args:
        types: learned from the dataset.
        dataset: the labels.
        weight: prior weight of that type, in observers (α in a Dirichlet process); 0: no such type.

    Raises:
        InputError: a negative weight.
    """
    number("none_of_these", weight, Range(0))
    if weight == 0:
        return types
    count = np.append(np.bincount(types.clustering.assignment), weight)
    return replace(
        types,
        labelers=(*types.labelers, base_rate(dataset)),
        names=(*types.names, "none of these"),
        prior=count / count.sum(),
    )


def base_rate(dataset: Dataset) -> Labeler:
    """Says 1 with the probability with which a label of the dataset is 1, whatever is asked."""
    from sklearn.tree import DecisionTreeClassifier

    x = inputs(dataset.features[dataset.transition], dataset.message_set, dataset.n_messages)
    # A tree that may not split; a labeler of shares reads its root.
    root = DecisionTreeClassifier(min_samples_split=len(x) + 2).fit(x, dataset.label)
    ones = int(dataset.label.sum())
    return FittedLabeler(
        classifier=root,
        n_messages=dataset.n_messages,
        confidence=(max(ones, len(x) - ones) + 1) / (len(x) + 2),
        accuracy=max(ones, len(x) - ones) / len(x),
        n_train=0,
        n_test=len(x),
    )
