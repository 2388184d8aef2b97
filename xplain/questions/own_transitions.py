"""Hypotheses written as a table of one's own transitions: real robots are no grids."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.message_sets import mask_of
from xplain.questions.hypotheses import Hypotheses
from xplain.users.setting import MAX_MODELS

TEXT, IMAGE, WHEN = "text", "image", "inexplicable_if"


@dataclass(frozen=True)
class OwnTransitions:
    """A designer's transitions.

    Attributes:
        hypotheses: a transition is labelled 0 by whoever holds one of its facts wrong. Its
            features are the columns of the table that mean nothing else, if there are any.
        images: of each transition, a path or address; "" where it has none.
    """

    hypotheses: Hypotheses
    images: tuple[str, ...]


def read_transitions(path: str | Path) -> OwnTransitions:
    """Reads a CSV table, one row a transition: ``text``, what the robot does; optionally
    ``image``; ``inexplicable_if``, the facts joined by ``;`` of which each makes the transition
    inexplicable to who holds it wrong. All other columns are features: numbers, or text, which
    becomes one column a value, as in tables of labels.

    Raises:
        InputError: no such table, a row without text, a feature missing, or no fact in any row.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            columns = reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("transitions", str(path), f"a .csv file ({error})") from None
    if missing := {TEXT, WHEN} - set(columns):
        raise InputError("transitions", str(path), f"lacks the column {min(missing)}")
    texts = tuple((row[TEXT] or "").strip() for row in rows)
    if "" in texts:
        raise InputError("transitions", f"row {texts.index('') + 2}", "a text in every row")
    facts = [[one.strip() for one in (row[WHEN] or "").split(";") if one.strip()] for row in rows]
    names = tuple(sorted({name for row in facts for name in row}))
    if not names:
        raise InputError("transitions", str(path), f"a fact in some row of {WHEN}")
    if 1 << len(names) > MAX_MODELS:
        raise InputError("transitions", len(names), f"at most {MAX_MODELS.bit_length() - 1} facts")
    masks = np.array([mask_of(row, names) for row in facts], dtype=np.int64)
    held = np.arange(1 << len(names))
    features, feature_names = _features(rows, [c for c in columns if c not in (TEXT, IMAGE, WHEN)])
    hypotheses = Hypotheses.of(
        (held[:, None] & masks) == 0,
        messages=names,
        phrases=texts,
        features=features,
        feature_names=feature_names,
    )
    return OwnTransitions(hypotheses, tuple((row.get(IMAGE) or "").strip() for row in rows))


def _features(
    rows: list[dict[str, str]], columns: list[str]
) -> tuple[NDArray[np.float64] | None, tuple[str, ...]]:
    """[T, F] and their names; None where no column is a feature."""
    parts: list[NDArray[np.float64]] = []
    names: list[str] = []
    for column in columns:
        values = [(row[column] or "").strip() for row in rows]
        if "" in values:
            raise InputError("transitions", f"row {values.index('') + 2}", f"a value of {column}")
        try:
            number = np.array([float(value) for value in values])
        except ValueError:
            distinct = sorted(set(values))
            parts += [np.array([value == one for value in values], float) for one in distinct]
            names += [f"{column}={one}" for one in distinct]
        else:
            if not np.isfinite(number).all():
                raise InputError("transitions", column, "finite numbers")
            parts.append(number)
            names.append(column)
    return (np.stack(parts, axis=1) if parts else None), tuple(names)
