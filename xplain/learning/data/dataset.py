"""Labels of observers. Each label belongs to an observer, a transition and a message set
(docs/method.md, section 2).

Simulated observers and files of real people's labels give the same kind of table. The features of a
file are its columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xplain.errors import InputError, one_of
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

    def of(self, observers: NDArray[np.int64]) -> Dataset:
        """Selects the labels of some observers (by index); tables of names are kept."""
        return self.take(np.flatnonzero(np.isin(self.observer, observers)))

    def take(self, rows: NDArray[np.int64]) -> Dataset:
        """Selects the labels ``rows`` [R], in this order; tables of names and features are kept."""
        return replace(
            self,
            observer=self.observer[rows],
            transition=self.transition[rows],
            message_set=self.message_set[rows],
            label=self.label[rows],
        )


def numbered(rows: ArrayLike) -> dict[bytes, int]:
    """Maps each row of distinct rows [U, F] to its index. 0 and −0 are equal."""
    return {row.tobytes(): u for u, row in enumerate(np.asarray(rows, np.float64) + 0.0)}


def places(rows: ArrayLike, known: ArrayLike | Mapping[bytes, int]) -> NDArray[np.int64]:
    """[P] indices of rows of features [P, F] among known rows [U, F] (or a map of
    :func:`numbered`); −1 if missing."""
    number = known if isinstance(known, Mapping) else numbered(known)
    found = [number.get(row.tobytes(), -1) for row in np.asarray(rows, np.float64) + 0.0]
    return np.array(found, dtype=np.int64)


def query_index(dataset: Dataset) -> NDArray[np.int64]:
    """[P] index of each label's query (transition, message set), 0 … distinct queries − 1, in the
    order of (transition, message set)."""
    told = np.unique(dataset.message_set, return_inverse=True)[1]
    key = dataset.transition * (told.max(initial=0) + 1) + told
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def inputs(
    features: NDArray[np.float64], message_sets: NDArray[np.int64], n_messages: int
) -> NDArray[np.float32]:
    """[P, F + n] float32 input of the classifier: features [P, F] and one bit for each message."""
    return np.hstack([features, bits_of(message_sets, n_messages)]).astype(np.float32)


def labelled_inputs(dataset: Dataset) -> NDArray[np.float32]:
    """[P, F + n] :func:`inputs` of each label."""
    return inputs(dataset.features[dataset.transition], dataset.message_set, dataset.n_messages)


def encoded(
    transition: Mapping[str, float | str], feature_names: Sequence[str]
) -> tuple[float, ...]:
    """Returns the F features of a transition, in order.

    A text becomes one 0/1 feature for each value (``zone=river``), as in
    :mod:`xplain.learning.data.label_file`.

    Args:
        transition: a number or a text for each column that the features come from.
        feature_names: F names.

    Raises:
        InputError: a column is missing or unknown, or has a text that the labels do not have.
    """
    row: dict[str, float] = {}
    for column, value in transition.items():
        values = [n.removeprefix(f"{column}=") for n in feature_names if n.startswith(f"{column}=")]
        if column in feature_names and isinstance(value, str):
            raise InputError(f"trace.{column}", value, "a number")
        if column in feature_names:
            row[column] = float(value)
        elif not values:
            raise InputError("trace", column, f"columns of {', '.join(feature_names)}")
        elif str(value) not in values:
            raise InputError(f"trace.{column}", value, f"one of {', '.join(values)}")
        else:
            row |= {f"{column}={other}": float(other == str(value)) for other in values}
    missing = [name for name in feature_names if name not in row]
    if missing:
        raise InputError("trace", dict(transition), f"a value of {missing[0].partition('=')[0]}")
    return tuple(row[name] for name in feature_names)


def align(dataset: Dataset, names: tuple[str, ...]) -> Dataset:
    """Returns the same labels with exactly these features, in this order.

    A value of a text column that does not occur in the data is a feature that is always 0.

    Raises:
        InputError: another feature is missing, or a feature is not among ``names``.
    """
    have = dict(zip(dataset.feature_names, dataset.features.T, strict=True))
    for name in have:
        one_of("data", name, names, "feature")
    text = {name.split("=")[0] for name in have if "=" in name}
    for name in names:
        if name not in have and name.split("=")[0] not in text:
            raise InputError("data", name, "this feature of the domain is missing in the table")
    never = np.zeros(len(dataset.features))
    columns = [have.get(name, never) for name in names]
    return replace(dataset, features=np.stack(columns, axis=1), feature_names=names)


def columns_of(dataset: Dataset) -> dict[str, NDArray[Any]]:
    """Columns [T] of the transitions; one-hot features are converted back to text."""
    groups: dict[str, list[int]] = {}
    for j, name in enumerate(dataset.feature_names):
        groups.setdefault(name.split("=")[0], []).append(j)
    columns: dict[str, NDArray[Any]] = {}
    for name, members in groups.items():
        if "=" in dataset.feature_names[members[0]]:
            values = np.array([dataset.feature_names[j].split("=", 1)[1] for j in members])
            columns[name] = values[dataset.features[:, members].argmax(axis=1)]
        else:
            columns[name] = dataset.features[:, members[0]]
    return columns
