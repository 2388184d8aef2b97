"""User types as the explanation problem wants them: one labeler a cluster, and a prior."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from xplain.by_type import DENSE, ByType, LabelTable
from xplain.data.dataset import Dataset, inputs
from xplain.errors import InputError
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
    return np.stack(
        [
            labeler.table_of(features, n_messages, transitions)
            if transitions is not None and isinstance(labeler, KnowsTransitions)
            else labeler.table(features, n_messages)
            for labeler in labelers
        ]
    )


def learn_types(
    dataset: Dataset,
    clustering: Clustering,
    trainer: LabelerTrainer,
    seed: int,
    prior: Literal["share", "uniform"] = "share",
    none_of_these: float = 0.0,
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
    labelers = [trainer.fit(dataset.of(clustering.members(t)), seed) for t in range(n)]
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
