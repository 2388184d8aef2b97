"""Features of a labeler, and the columns of a table of labels that they come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, one_of
from xplain.learning.data.dataset import Dataset


def encoded(
    transition: Mapping[str, float | str], feature_names: Sequence[str]
) -> tuple[float, ...]:
    """The features of a transition, in order: F numbers.

    Text is one 0/1 feature for each value (``zone=river``), as in
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
    """The same labels with exactly these features, in this order.

    A value of a text column that does not occur in the data (``action=left`` if ``action`` has
    only other values) is a feature that is always 0.

    Raises:
        InputError: another feature is missing, or one is not among ``names``.
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
    """Columns [T] of the transitions; one-hot features become text again."""
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
