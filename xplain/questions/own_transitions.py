"""A user's own table of transitions, for robots without a grid."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Domain
from xplain.domains.users.hypotheses import Hypotheses, hypotheses_of
from xplain.domains.users.setting import MAX_MODELS
from xplain.errors import InputError
from xplain.explanation.message_sets import mask_of, names_of
from xplain.learning.data.label_file import Column, features_of, message_sets, read_cells

TEXT, IMAGE, ALT, WHEN = "text", "image", "alt", "inexplicable_if"


@dataclass(frozen=True)
class OwnTransitions:
    """T transitions from a user's table.

    Attributes:
        path: path of the table.
        texts: description of each transition.
        images: path or address of an image of each transition; "" without an image.
        features: [T, F] all other columns of the table; None if there are none.
        feature_names: F names.
        facts: the facts of each transition: a person who believes one or more of them incorrectly
            labels the transition 0; None if the table has no facts.
        alts: description of each image; "" without one.
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
        """The hypotheses: all sets of the facts. A person who believes one of a transition's facts
        incorrectly labels it 0.

        Raises:
            InputError: the table has no facts, or too many.
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


def with_features(known: Hypotheses) -> Hypotheses:
    """Adds features to hypotheses that have none: the texts of the transitions become a feature."""
    if known.features is not None:
        return known
    features, names = features_of([Column.of("transitions", TEXT, known.phrases)])
    return replace(known, features=features, feature_names=names)


def read_transitions(path: str | Path) -> OwnTransitions:
    """Reads a table with one row for each transition.

    Columns: ``text``, what the robot does; optionally ``image``, and ``alt``, a description of the
    image; ``inexplicable_if``, the facts joined by ``;``. A transition is inexplicable to a person
    who believes any of these facts incorrectly. Questions without hypotheses need no
    ``inexplicable_if``. All other columns are features: numbers, or text, which becomes one column
    for each value, as in tables of labels.

    Raises:
        InputError: no such table, a row without text, or a missing feature.
    """
    table = read_cells(Path(path), "transitions")
    if TEXT not in table.columns:
        raise InputError("transitions", str(path), f"lacks the column {TEXT}")
    words = {name: tuple(table[name].str.strip()) for name in table.columns}
    if "" in words[TEXT]:
        row = words[TEXT].index("") + 1
        raise InputError("transitions", TEXT, f"a text in every row; missing in row {row}")
    facts = None
    if WHEN in words:
        sets, known = message_sets(Column.of("transitions", WHEN, table[WHEN]))
        facts = tuple(names_of(int(one), known) for one in sets)
    described = [name for name in table.columns if name not in (TEXT, IMAGE, ALT, WHEN)]
    columns = [Column.of("transitions", name, table[name]) for name in described]
    features, names = features_of(columns) if columns else (None, ())
    nothing = ("",) * len(table)
    return OwnTransitions(
        path=str(path),
        texts=words[TEXT],
        images=words.get(IMAGE, nothing),
        alts=words.get(ALT, nothing),
        features=features,
        feature_names=names,
        facts=facts,
    )


def read_known_facts(
    transitions: str | Path | None, hypotheses: str | None, domain: Domain | None
) -> tuple[Hypotheses | None, tuple[str, ...], dict[str, str]]:
    """Reads the hypotheses from the one given source: a table of transitions, a file of hypotheses,
    or a domain.

    Returns:
        The hypotheses (None without a source); the images of the transitions; and the sentences of
        the messages, if known.

    Raises:
        InputError: both a table and a file are given, or one of these cannot be used.
    """
    if hypotheses is not None and transitions is not None:
        raise InputError("transitions", str(transitions), "either transitions or hypotheses")
    if transitions is not None:
        own = read_transitions(transitions)
        return own.hypotheses, own.images, {}
    if hypotheses is None and domain is None:
        return None, (), {}
    parameters = () if domain is None or hypotheses is not None else domain.parameters
    return hypotheses_of(domain, hypotheses), (), {one.name: one.message for one in parameters}
