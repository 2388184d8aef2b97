"""User types as the explanation problem wants them: one labeler a cluster, and a prior."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from xplain.data.dataset import Dataset, inputs
from xplain.errors import InputError
from xplain.explanation.by_type import DENSE, ByType, LabelTable
from xplain.learning.clustering import Clustering
from xplain.learning.labelers import Labeler, LabelerTrainer


@dataclass(frozen=True)
class UserTypes:
    """N learned user types.

    Attributes:
        labelers: N of them.
        clustering: the observers' types they were learned from.
        names: N, for people.
        prior: [N] P(type) of the next user.
    """

    labelers: tuple[Labeler, ...]
    clustering: Clustering
    names: tuple[str, ...]
    prior: NDArray[np.float64]

    @property
    def by_observers(self) -> dict[tuple[int, ...], Labeler]:
        """Each cluster's labeler, by its observers."""
        clusters = range(self.clustering.n_types)
        return {tuple(self.clustering.members(t).tolist()): self.labelers[t] for t in clusters}


@runtime_checkable
class KnowsTransitions(Protocol):
    """A labeler that tells transitions apart that share their features."""

    def table_of(
        self, features: NDArray[np.float64], n_messages: int, transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """As ``table``, of the transitions [T, 3] with these features [T, F]: [T, 2^n]."""
        ...

    def relevant_table_of(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """As ``relevant_table``, of these transitions: [r] and [T, 2^r]."""
        ...


def p_explicable(
    labelers: Iterable[Labeler],
    features: NDArray[np.float64],
    n_messages: int,
    transitions: NDArray[np.int64] | None = None,
) -> LabelTable:
    """P(label = 1) of m transitions under every message set, one table a labeler: [N, m, 2^n], and
    kept by type where messages are more than DENSE.

    Args:
        labelers: N ≥ 1 of them.
        features: [m, F] of the transitions, as the labelers were trained on.
        n_messages: n; the last axis is indexed by the message set's bitmask.
        transitions: [m, 3] with these features, where they are known.

    Raises:
        InputError: a labeler was trained with another number of messages.
        TooLargeError: a labeler looks at too many of them on these transitions.
    """
    if n_messages > DENSE:
        own = [
            labeler.relevant_table_of(features, transitions)
            if transitions is not None and isinstance(labeler, KnowsTransitions)
            else labeler.relevant_table(features)
            for labeler in labelers
        ]
        return ByType.padded([row for row, _ in own], [table for _, table in own])
    return np.stack([_table(own, features, n_messages, transitions) for own in labelers])


def _table(
    labeler: Labeler,
    features: NDArray[np.float64],
    n_messages: int,
    transitions: NDArray[np.int64] | None,
) -> NDArray[np.float64]:
    """P(label = 1) of m transitions under every message set: [m, 2^n]."""
    if transitions is not None and isinstance(labeler, KnowsTransitions):
        return labeler.table_of(features, n_messages, transitions)
    return labeler.table(features, n_messages)


@dataclass(frozen=True)
class AskedOnce:
    """:func:`p_explicable`, but each labeler is asked of each transition once, however many traces
    hold it: asking may take longer than all that follows.

    Attributes:
        tables: [2^n] by labeler and transition; no more than the traces' own.
    """

    tables: dict[tuple[int, bytes], NDArray[np.float64]] = field(default_factory=dict)

    def p_explicable(
        self,
        labelers: Sequence[Labeler],
        features: NDArray[np.float64],
        n_messages: int,
        transitions: NDArray[np.int64],
    ) -> LabelTable:
        """See :func:`p_explicable`. The labelers must live as long as this object."""
        if n_messages > DENSE:
            return p_explicable(labelers, features, n_messages, transitions)
        result = np.empty((len(labelers), len(features), 1 << n_messages))
        for table, labeler in zip(result, labelers, strict=True):
            told_apart = isinstance(labeler, KnowsTransitions)
            what = np.hstack([features, transitions]) if told_apart else features
            keys = [(id(labeler), row.tobytes()) for row in what]
            new = {key: i for i, key in enumerate(keys) if key not in self.tables}
            if new:
                rows = list(new.values())
                asked = _table(labeler, features[rows], n_messages, transitions[rows])
                self.tables.update(zip(new, asked, strict=True))
            table[:] = [self.tables[key] for key in keys]
        return result


def learn_types(
    dataset: Dataset,
    clustering: Clustering,
    trainer: LabelerTrainer,
    seed: int,
    prior: Literal["share", "uniform"] = "share",
    none_of_these: float = 0.0,
    known: Mapping[tuple[int, ...], Labeler] | None = None,
) -> UserTypes:
    """One labeler from the pooled labels of each cluster (paper, section 4.1).

    Args:
        dataset: the labels.
        clustering: of its observers.
        trainer: fits the labelers.
        seed: of every fit. It is one for all types, so that a labeler depends on its labels alone,
            not on how clusters are numbered.
        prior: ``share`` of the observers, or ``uniform``.
        none_of_these: where positive, one more type for users unlike all others, with the prior
            weight of so many observers (of one type where the prior is uniform, α in a Dirichlet
            process). It labels at everybody's rate, whatever is shown and said.
        known: labelers by their observers, fitted to this dataset with this trainer and seed: they
            are not fitted again.

    Raises:
        InputError: another prior, a negative weight.
    """
    n = clustering.n_types
    if not none_of_these >= 0:
        raise InputError("none_of_these", none_of_these, "a weight ≥ 0")
    if prior not in ("share", "uniform"):
        raise InputError("prior", prior, "share or uniform")
    weight = np.bincount(clustering.assignment, minlength=n).astype(np.float64)
    if prior == "uniform":
        weight[:] = 1
    clusters = [clustering.members(t) for t in range(n)]
    labelers = [
        (known or {}).get(tuple(own.tolist())) or trainer.fit(dataset.of(own), seed)
        for own in clusters
    ]
    names = [f"type_{t}" for t in range(n)]
    if none_of_these > 0:
        labelers.append(base_rate(dataset))
        names.append("none of these")
        weight = np.append(weight, none_of_these)
    return UserTypes(tuple(labelers), clustering, tuple(names), weight / weight.sum())


def base_rate(dataset: Dataset) -> Labeler:
    """Says 1 with the probability with which a label of the dataset is 1, whatever is asked."""
    from sklearn.tree import DecisionTreeClassifier

    x = inputs(dataset.features[dataset.transition], dataset.message_set, dataset.n_messages)
    # A tree that may not split; a labeler of shares reads its root.
    root = DecisionTreeClassifier(min_samples_split=len(x) + 2).fit(x, dataset.label)
    ones = int(dataset.label.sum())
    return Labeler(
        classifier=root,
        n_messages=dataset.n_messages,
        confidence=(max(ones, len(x) - ones) + 1) / (len(x) + 2),
        accuracy=max(ones, len(x) - ones) / len(x),
        n_train=0,
        n_test=len(x),
    )
