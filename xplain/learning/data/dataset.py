"""Labels of observers. Each label belongs to an observer, a transition and a message set
(docs/method.md, section 2).

Labels of simulated observers and labels of real people from a file have the same form. The features
of a file are its columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.explanation.message_sets import bits_of


@dataclass(frozen=True)
class Dataset:
    """P labels by O observers on T distinct transitions.

    Attributes:
        features: [T, F] float64 of the distinct transitions.
        feature_names: F names.
        messages: n names; bit j of a message set is message j.
        observers: O names.
        observer: [P] int64 index into ``observers``.
        transition: [P] int64 index into ``features``.
        message_set: [P] int64 bitmask (n ≤ 62).
        label: [P] uint8, 1 = explicable.
    """

    features: NDArray[np.float64]
    feature_names: tuple[str, ...]
    messages: tuple[str, ...]
    observers: tuple[str, ...]
    observer: NDArray[np.int64]
    transition: NDArray[np.int64]
    message_set: NDArray[np.int64]
    label: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.label)

    @property
    def n_messages(self) -> int:
        """n, the number of messages."""
        return len(self.messages)

    @cached_property
    def rows(self) -> list[NDArray[np.int64]]:
        """For each observer, the indices of their labels, ascending."""
        order = np.argsort(self.observer, kind="stable")
        begin = np.searchsorted(self.observer[order], np.arange(1, len(self.observers)))
        return np.split(order, begin)

    def of(self, observers: NDArray[np.int64]) -> Dataset:
        """Returns the dataset with only the labels by these observers. Observers, features and
        messages keep their indices."""
        return self.take(np.flatnonzero(np.isin(self.observer, observers)))

    def take(self, rows: NDArray[np.int64]) -> Dataset:
        """Returns the dataset whose label i is label ``rows[i]`` of this dataset. Observers,
        features and messages keep their indices."""
        return replace(
            self,
            observer=self.observer[rows],
            transition=self.transition[rows],
            message_set=self.message_set[rows],
            label=self.label[rows],
        )


def number_rows(rows: ArrayLike) -> dict[bytes, int]:
    """Returns a mapping from the bytes of each row to the row's index. The rows [U, F] are
    distinct; 0 and −0 have the same bytes."""
    return {row.tobytes(): u for u, row in enumerate(np.asarray(rows, np.float64) + 0.0)}


def places(rows: ArrayLike, known: ArrayLike | Mapping[bytes, int]) -> NDArray[np.int64]:
    """Finds rows of features among known rows.

    Args:
        rows: [P, F] rows to find.
        known: [U, F] known rows, or the mapping :func:`number_rows` of these rows.

    Returns:
        [P] index of the equal known row; −1 if there is none.
    """
    number = known if isinstance(known, Mapping) else number_rows(known)
    found = [number.get(row.tobytes(), -1) for row in np.asarray(rows, np.float64) + 0.0]
    return np.array(found, dtype=np.int64)


def query_index(dataset: Dataset) -> NDArray[np.int64]:
    """Returns [P] the number of each label's query (transition, message set). Distinct queries have
    the numbers 0, 1, … in the order of (transition, message set)."""
    told = np.unique(dataset.message_set, return_inverse=True)[1]
    key = dataset.transition * (told.max(initial=0) + 1) + told
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def inputs(
    features: NDArray[np.float64], message_sets: NDArray[np.int64], n_messages: int
) -> NDArray[np.float32]:
    """Makes the float32 input [P, F + n] of a classifier: features [P, F] and one bit for each
    message."""
    return np.hstack([features, bits_of(message_sets, n_messages)]).astype(np.float32)


def make_labelled_inputs(dataset: Dataset) -> NDArray[np.float32]:
    """Makes the classifier's input [P, F + n] for each label (:func:`inputs`)."""
    return inputs(dataset.features[dataset.transition], dataset.message_set, dataset.n_messages)
