"""A table of one's own transitions: real robots are no grids."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xplain.domains.users.hypotheses import Hypotheses
from xplain.domains.users.setting import MAX_MODELS
from xplain.errors import InputError
from xplain.explanation.message_sets import mask_of
from xplain.learning.data.encoding import one_hot

TEXT, IMAGE, ALT, WHEN = "text", "image", "alt", "inexplicable_if"


@dataclass(frozen=True)
class OwnTransitions:
    """A designer's T transitions.

    Attributes:
        path: of the table.
        texts: of each transition, what the robot does.
        images: of each transition, a path or address; "" where it has none.
        features: [T, F] the columns of the table that mean nothing else; None without any.
        feature_names: F names.
        facts: of each transition, the facts of which each makes it inexplicable to who holds it
            wrong; None where nobody wrote them down.
        alts: of each image, what it shows, in words; "" where nobody wrote it.
    """

    path: str
    texts: tuple[str, ...]
    images: tuple[str, ...]
    features: NDArray[np.float64] | None
    feature_names: tuple[str, ...]
    facts: tuple[tuple[str, ...], ...] | None
    alts: tuple[str, ...] = ()

    @cached_property
    def hypotheses(self) -> Hypotheses:
        """All sets of the facts; a transition is labelled 0 by whoever holds one of its own wrong.

        Raises:
            InputError: nobody wrote facts down, or too many.
        """
        if self.facts is None:
            raise InputError("transitions", self.path, f"lacks the column {WHEN}")
        names = tuple(sorted({name for row in self.facts for name in row}))
        if not names:
            raise InputError("transitions", self.path, f"a fact in some row of {WHEN}")
        if 1 << len(names) > MAX_MODELS:
            raise InputError(
                "transitions", len(names), f"at most {MAX_MODELS.bit_length() - 1} facts"
            )
        masks = np.array([mask_of(row, names) for row in self.facts], dtype=np.int64)
        held = np.arange(1 << len(names))
        return Hypotheses.of(
            (held[:, None] & masks) == 0,
            messages=names,
            phrases=self.texts,
            features=self.features,
            feature_names=self.feature_names,
        )

    def told_apart(self) -> tuple[NDArray[np.float64], tuple[str, ...]]:
        """Features [T, F] and their names; where the table has none, the text is one."""
        if self.features is not None:
            return self.features, self.feature_names
        return one_hot(TEXT, self.texts)


def with_features(known: Hypotheses) -> Hypotheses:
    """Hypotheses whose transitions have features; where they have none, the text is one."""
    if known.features is not None:
        return known
    features, names = one_hot(TEXT, known.phrases)
    return replace(known, features=features, feature_names=names)


def read_transitions(path: str | Path) -> OwnTransitions:
    """Reads a CSV table, one row a transition: ``text``, what the robot does; optionally
    ``image``, and ``alt``, what it shows in words; ``inexplicable_if``, the facts joined by ``;``
    of which each makes the transition inexplicable to who holds it wrong (not needed where one
    asks without hypotheses). All other columns are features: numbers, or text, which becomes one
    column a value, as in tables of labels.

    Raises:
        InputError: no such table, a row without text, or a feature missing.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            columns = reader.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("transitions", str(path), f"a .csv file ({error})") from None
    if TEXT not in columns:
        raise InputError("transitions", str(path), f"lacks the column {TEXT}")
    if not rows:
        raise InputError("transitions", str(path), "has no rows")
    texts = tuple((row[TEXT] or "").strip() for row in rows)
    if "" in texts:
        raise InputError("transitions", f"row {texts.index('') + 2}", "a text in every row")
    facts = [
        tuple(one.strip() for one in (row.get(WHEN) or "").split(";") if one.strip())
        for row in rows
    ]
    features, names = _features(rows, [c for c in columns if c not in (TEXT, IMAGE, ALT, WHEN)])
    return OwnTransitions(
        path=str(path),
        texts=texts,
        images=tuple((row.get(IMAGE) or "").strip() for row in rows),
        alts=tuple((row.get(ALT) or "").strip() for row in rows),
        features=features,
        feature_names=names,
        facts=tuple(facts) if WHEN in columns else None,
    )


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
            own, named = one_hot(column, values)
        else:
            if not np.isfinite(number).all():
                raise InputError("transitions", column, "finite numbers")
            own, named = number[:, None], (column,)
        parts.append(own)
        names += named
    return (np.hstack(parts) if parts else None), tuple(names)
