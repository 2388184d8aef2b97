"""A transition, given by the columns of a table of labels, as the features of a labeler."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from xplain.errors import InputError


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
