"""Tables of labels, CSV or Parquet: one row for each label (docs/your-own-data.md).

Columns: ``observer``; ``messages``, names joined by ``;``, empty for none (without this column
nobody received messages); ``label``, 0 or 1. The other columns are features of the transition
(:func:`read_table`). Numbers stay numbers; text becomes one 0/1 feature for each value
(``action=left``; :mod:`xplain.learning.data.cells`). Rows with equal features are the same
transition.

An observer with few labels is kept, with a warning. If an observer answers the same question in
both ways, both labels count, because people err. Errors are: a missing value, a label other than 0
or 1, fewer than two observers, labels that are all equal, and fewer than four distinct (transition,
message set).
"""

from __future__ import annotations

import logging
import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.message_sets import mask_of, names_of
from xplain.learning.data.cells import (
    MISSING,
    as_numbers,
    check_format,
    one_hot,
    option,
    read_cells,
    stripped,
)
from xplain.learning.data.dataset import Dataset, align, columns_of, query_index

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

COLUMNS = ("observer", "messages", "label")
NEARLY_ALL = 0.9
"""A column with more distinct values than this share of the rows cannot describe a transition."""
NOTHING = "none|nothing|nil|missing|no|no messages?|n/a|0|[.]|-|–|—|\\[\\]|{}|\\(\\)"
"""Names that look like an empty message set."""
MAX_MASK = 62
"""Maximum number of messages in a table; a message set is the bits of one integer."""
MIN_QUERIES = 4
"""Minimum number of distinct (transition, message set); a split of fewer has no meaning."""


def read_table(
    path: str | Path,
    messages: Sequence[str] | None = None,
    features: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
    under_way: bool = False,
    like: Sequence[str] = (),
) -> Dataset:
    """Reads a table of labels.

    Args:
        path: ends in ``.csv``, ``.csv.gz`` or ``.parquet``.
        messages: the allowed names, in order; None: all names in the table, sorted.
        features: columns that describe the transition; None: all suitable columns. A column that is
            constant for each person, or different in nearly every row, is not suitable.
        ignore: columns to leave out, if ``features`` is None.
        under_way: accept a table that is too small to learn types from, because more labels will
            follow.
        like: names of the required features, in order; they also decide between number and text.

    Raises:
        InputError: a rule of this module is broken. The line gives the column, the first bad value
            and its row (1 is the first row of data).
    """
    table = _load(Path(path), features, ignore, like)
    told = _told(table, messages)
    columns = table.drop(columns=list(COLUMNS))
    described, names = read_features(columns, like)
    distinct, transition = _distinct(described)
    dataset = Dataset(
        features=distinct,
        feature_names=names,
        transition=transition,
        label=_labels(table["label"]),
        **told,
    )
    if not under_way:
        _check(dataset)
    if like:
        dataset = align(dataset, tuple(like))
    rows, steps = len(dataset), len(dataset.features)
    log.info("data: %d steps by the features %s", steps, ", ".join(map(str, columns)))
    if steps > NEARLY_ALL * rows:
        log.warning("data: nearly every answer is about another step; leave columns out by ignore=")
    log.info("data: nothing was told in %d of %d rows", int((dataset.message_set == 0).sum()), rows)
    return dataset


def read_questions(path: str | Path, like: Dataset) -> tuple[pd.DataFrame, Dataset]:
    """Reads questions to predict answers to, one in each row: a table as in :func:`read_table`.
    Labels may be missing and observers may be new.

    Args:
        path: path of the table.
        like: the labels that predictions are made from; only its features and messages may occur.

    Returns:
        The unchanged table, and a dataset of its rows in order; all its labels are 0 and have no
        meaning.

    Raises:
        InputError: the rows do not fit ``like``.
    """
    table = read_cells(Path(path), "predict")
    columns = dict.fromkeys(name.partition("=")[0] for name in like.feature_names)
    try:
        for name in ("observer", *columns):
            if name not in table.columns:
                raise InputError("data", str(path), f"lacks the column {name}")
        told = _told(table.assign(messages=table.get("messages", "")), like.messages)
        distinct, names = read_features(table[[*columns]], like.feature_names, "predict")
        distinct, transition = _distinct(distinct)
        label = np.zeros(len(table), dtype=np.uint8)
        questions = Dataset(distinct, names, transition=transition, label=label, **told)
        return table, align(questions, like.feature_names)
    except InputError as error:
        raise InputError("predict", error.value, error.allowed) from None


def write_table(dataset: Dataset, path: str | Path) -> None:
    """Writes a table for :func:`read_table`. One-hot features become one column of text again."""
    import pandas as pd

    distinct, mask = np.unique(dataset.message_set, return_inverse=True)
    names = np.array([";".join(names_of(int(one), dataset.messages)) for one in distinct])
    columns: dict[str, Any] = {
        "observer": np.array(dataset.observers)[dataset.observer],
        "messages": names[mask],
    }
    for name, values in columns_of(dataset).items():
        columns[name] = values[dataset.transition]
    columns["label"] = dataset.label
    table = pd.DataFrame(columns)
    if check_format(Path(path), "data") == "parquet":
        table.to_parquet(path, index=False)
    else:
        table.to_csv(path, index=False)


def _load(
    path: Path, features: Sequence[str] | None, ignore: Sequence[str], like: Sequence[str]
) -> pd.DataFrame:
    """Loads the used columns, :data:`COLUMNS` first. Without a column of messages all message sets
    are empty."""
    table = read_cells(path, "data")
    columns = [*table.columns]
    for name in ("observer", "label", *(features or ()), *ignore):
        if name not in columns:
            raise InputError("data", str(path), f"lacks the column {name}; it has {columns}")
    if "messages" not in columns:
        table["messages"] = ""
    if features is not None and len({*COLUMNS, *features}) < len(COLUMNS) + len(features):
        raise InputError("data", [*COLUMNS, *features], "each column once")
    wanted = features
    if wanted is None:
        others = [name for name in columns if name not in {*COLUMNS, *ignore}]
        wanted = _choose_features(table, others, {name.partition("=")[0] for name in like})
    if not wanted:
        raise InputError("data", str(path), "needs a column that describes the transition")
    return table[[*COLUMNS, *wanted]]


def _choose_features(table: pd.DataFrame, columns: Sequence[str], sure: set[str]) -> list[str]:
    """Chooses the columns that can describe a transition. A log line gives the others with the
    reason.

    Args:
        table: the whole table.
        columns: columns to choose from.
        sure: columns that are always features.

    Raises:
        InputError: no column is suitable.
    """
    people, left = table["observer"].nunique(), {}
    for name in (name for name in columns if name not in sure):
        if people < len(table) and len(table[["observer", name]].drop_duplicates()) == people:
            left[name] = "the same in all rows of a person"
        elif table[name].nunique() > NEARLY_ALL * len(table):
            left[name] = "another value in nearly every row"
    taken = [name for name in columns if name not in left]
    reasons = ", ".join(f"{name} ({why})" for name, why in left.items())
    if columns and not taken:
        name, why = next(iter(left.items()))
        raise InputError("data", name, f"{why}; if it is a feature: {option('features', [name])}")
    if left:
        log.warning("data: left out: %s; to take all: %s", reasons, option("features", columns))
    return taken


def _row(bad: Any) -> int:
    """The number of the first bad row, from 1."""
    return int(np.flatnonzero(np.asarray(bad))[0]) + 1


def _factorized(column: pd.Series[Any]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    import pandas as pd

    code, names = pd.factorize(column, sort=True)
    return code.astype(np.int64), tuple(str(name) for name in names)


def _told(table: pd.DataFrame, messages: Sequence[str] | None) -> dict[str, Any]:
    """Reads the observers and the messages that they received. Returns these attributes of a
    dataset."""
    who = stripped(table["observer"])
    _refuse_missing("observer", who == "")
    observer, observers = _factorized(who)
    seen: dict[str, str] = {}
    for name in observers:  # ignores invisible marks, case, and two encodings of one character
        plain = unicodedata.normalize("NFKC", name).casefold()
        plain = re.sub(r"[\u200b-\u200f\ufeff]|^0+(?=\d)|(?<=\d)\.0+$", "", plain)
        if (other := seen.setdefault(plain, name)) != name:
            log.warning("data: the observers %a and %a look alike; they count as two", other, name)
    message_set, known = _message_sets(table["messages"], messages)
    return {
        "observer": observer,
        "observers": observers,
        "message_set": message_set,
        "messages": known,
    }


def _refuse_missing(name: str, missing: Any, mend: str = "", key: str = "data") -> None:
    """Raises InputError if a value is missing in a row; ``mend`` is the suggested correction."""
    if missing.any():
        allowed = f"missing in {missing.sum()} rows, first in row {_row(missing)}{mend}"
        raise InputError(key, name, allowed)


def _message_sets(
    column: pd.Series[Any], messages: Sequence[str] | None
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    code, cells = _factorized(stripped(column))
    absent = {*MISSING} - {*(messages or ())}
    given = [[" ".join(name.split()) for name in cell.split(";") if name.strip()] for cell in cells]
    given = [[] if len(names) == 1 and names[0] in absent else names for names in given]
    found = sorted({name for names in given for name in names})
    if messages is None:
        _ask_about_names(found)
    known = tuple(messages) if messages is not None else tuple(found)
    if len(known) > MAX_MASK:
        raise InputError("data", len(known), f"at most {MAX_MASK} different messages")
    for at, names in enumerate(given):
        if unknown := [name for name in names if name not in known]:
            allowed = f"unknown message in row {_row(code == at)}; known: {', '.join(known)}"
            raise InputError("data", unknown[0], allowed)
    masks = np.array([mask_of(names, known, "data") for names in given], dtype=np.int64)
    return masks[code], known


def _ask_about_names(names: Sequence[str]) -> None:
    """Raises InputError for a name that looks like several names, like no message, or like another
    name."""
    one = f"if it is one message: {option('messages', names)}"
    for name in names:
        parts = [part.strip() for part in re.split(r"[,|+&/\\]", name)]
        single = not any(" " in part for part in parts)
        joined = len(parts) > 1 and all(parts) and (single or {*parts} & {*names})
        others = "|".join(re.escape(other) for other in names if other != name)
        several = rf"\W*({others})((\W|_)+(and\W+)?({others}))+\W*"
        if name in MISSING or re.fullmatch(NOTHING, name, re.IGNORECASE):
            raise InputError("data", name, f"leave the cell empty if nothing was told; {one}")
        bracket = name[0] in "[{('\"" or name[-1] in ")}]"
        if bracket or joined or (others and re.fullmatch(several, name)):
            allowed = f"looks like messages joined by something else than a semicolon; {one}"
            raise InputError("data", name, allowed)
        for other in names:
            if name < other and name.casefold() == other.casefold():
                raise InputError("data", name, f"differs from {other} by case alone; {one}")


def _labels(column: pd.Series[Any]) -> NDArray[np.uint8]:
    import pandas as pd

    words = stripped(column)
    _refuse_missing("label", words.isin(MISSING))
    truth = words.str.lower().replace({"true": "1", "false": "0"})
    numbers = pd.to_numeric(truth, errors="coerce")
    bad = ~numbers.isin([0, 1])
    if bad.any():
        first = words[bad].iloc[0]
        raise InputError("data", first, f"label in row {_row(bad)}: a label is 0 or 1")
    return np.asarray(numbers, dtype=np.uint8)


def read_features(
    table: pd.DataFrame, like: Sequence[str] = (), key: str = "data"
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Reads the features [P, F] from all columns of a table, with their names. Text columns become
    one-hot features in alphabetical order of their values.

    Args:
        table: a table of :func:`~xplain.learning.data.cells.read_cells`.
        like: names of features; they decide whether a column is read as numbers or text.
        key: the user's key, for errors.

    Raises:
        InputError: a value is missing or infinite, or no number although ``like`` has numbers.
    """
    import pandas as pd

    columns: list[NDArray[np.float64]] = []
    names: list[str] = []
    for name in table.columns:
        words = stripped(table[name])
        numbers = as_numbers(words)
        if name in like and numbers is None:
            numbers = pd.to_numeric(words, errors="coerce").to_numpy(dtype=float)
            bad = np.isnan(numbers) & ~words.isin(MISSING)
            if bad.any():
                raise InputError(key, words[bad].iloc[0], f"a number in row {_row(bad)} of {name}")
        mend = "; leave those rows out"
        mend += f", or the column by {option('ignore', [name])}" if key == "data" else ""
        if numbers is None or any(other.startswith(f"{name}=") for other in like):
            _refuse_missing(name, words == "", mend, key)
            if (absent := words[words.isin(MISSING)]).any():
                log.warning("%s: %s in the column %s is a text", key, absent.iloc[0], name)
            own, named = one_hot(name, words)
        else:
            _refuse_missing(name, np.isnan(numbers), mend, key)
            if np.isinf(numbers).any():
                raise InputError(key, name, f"infinite in row {_row(np.isinf(numbers))}")
            own, named = numbers[:, None], (name,)
        columns.append(own)
        names += named
    return np.hstack(columns), tuple(names)


def _distinct(
    features: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Returns the distinct rows, sorted, and the index of each row among them."""
    import pandas as pd

    table = pd.DataFrame(features)
    number = table.groupby([*table.columns], sort=True).ngroup().to_numpy(dtype=np.int64)
    first = np.unique(number, return_index=True)[1]
    return features[first], np.asarray(number, dtype=np.int64)


def _check(dataset: Dataset) -> None:
    if len(dataset.observers) < 2:
        raise InputError("data", dataset.observers[0], "one observer; types need at least two")
    if dataset.label.min() == dataset.label.max():
        raise InputError("data", int(dataset.label[0]), "all labels are equal; nothing to learn")
    query = query_index(dataset)
    count = int(query.max()) + 1
    if count < MIN_QUERIES:
        raise InputError(
            "data", count, f"a split needs at least {MIN_QUERIES} distinct (transition, messages)"
        )
    single = np.bincount(dataset.observer) == 1
    if single.any():
        log.warning("%d observers gave one label only: kept, placed by it", int(single.sum()))
    own = query * len(dataset.observers) + dataset.observer
    if torn := len(np.unique(2 * own + dataset.label)) - len(np.unique(own)):
        log.warning("%d questions were answered both ways by one observer: both labels count", torn)
