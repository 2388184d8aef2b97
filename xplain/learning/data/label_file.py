"""Tables of labels, CSV or Parquet: one row for each label (docs/your-own-data.md).

Columns: ``observer``; ``messages``, names joined by ``;``, empty for none (no such column: nobody
was told anything); ``label``, 0 or 1; every other column is a feature of the transition unless a
list names them. Numbers stay numbers, text becomes one 0/1 feature for each value
(``action=left``). Rows with equal features are the same transition.

The rules: an observer with few labels, even one, is kept, with a warning. An observer who answers
the same question in both ways is kept too, and both labels count, because people err.
Anything missing, a label other than 0 or 1, fewer than two observers, labels that are all equal,
or fewer than four distinct (transition, message set) is an error.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.message_sets import mask_of, names_of
from xplain.learning.data.dataset import Dataset, query_index
from xplain.learning.data.encoding import columns_of, encoded

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

COLUMNS = ("observer", "messages", "label")
MISSING = ["", "NA", "N/A", "NaN", "nan", "null", "NULL", "<NA>", "#N/A"]
MAX_MASK = 62
"""Most messages in a table; a message set is the bits of one integer."""
MIN_QUERIES = 4
"""Least number of distinct (transition, message set); with fewer a split says nothing."""


def read_table(
    path: str | Path,
    messages: Sequence[str] | None = None,
    features: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
    under_way: bool = False,
) -> Dataset:
    """Reads a table of labels.

    Args:
        path: ends in ``.csv``, ``.csv.gz`` or ``.parquet``.
        messages: the allowed names, in order; None: those that occur, sorted.
        features: columns that describe the transition; None: all other columns.
        ignore: columns to leave out, if ``features`` is None.
        under_way: accept a table that is too small to learn types from, because more will come.

    Raises:
        InputError: a rule of this module is broken; the line gives the column, the first bad value
            and its row (1 is the first row of data).
    """
    table = _load(Path(path), features, ignore)
    told = _told(table, messages)
    described, names = _features(table.drop(columns=list(COLUMNS)))
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
    return dataset


def read_questions(
    path: str | Path,
    like: Dataset,
    features: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
) -> Dataset:
    """Reads questions whose answers are to be predicted, a row each: a table as of
    :func:`read_table`, in which labels may be missing and observers be new.

    Args:
        path, features, ignore: as of :func:`read_table`.
        like: the labels that predictions are made from; its features and messages may occur.

    Returns:
        The rows, in their order; all labels are 0, and mean nothing.

    Raises:
        InputError: the rows do not fit ``like``.
    """
    table = _load(Path(path), features, ignore, key="predict")
    told = _told(table, like.messages)
    described = table.drop(columns=list(COLUMNS)).reset_index(drop=True)
    group = described.groupby(list(described.columns), sort=False, dropna=False)
    first = described.drop_duplicates()  # in the order of the groups
    rows: list[dict[str, Any]] = [
        dict(zip(first.columns, row, strict=True)) for row in first.itertuples(index=False)
    ]
    try:
        distinct = np.array([encoded(row, like.feature_names) for row in rows])
    except InputError as error:
        raise InputError("predict", error.value, error.allowed) from None
    return Dataset(
        features=distinct,
        feature_names=like.feature_names,
        transition=np.asarray(group.ngroup(), dtype=np.int64),
        label=np.zeros(len(table), dtype=np.uint8),
        **told,
    )


def write_table(dataset: Dataset, path: str | Path) -> None:
    """Writes a table that :func:`read_table` can read. One-hot features become one column of text
    again."""
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


def check_format(path: Path, key: str) -> str:
    """``csv`` or ``parquet``, by the end of the name; ``key`` is the key that the user set.

    Raises:
        InputError: another ending.
    """
    name = path.name.lower()
    if name.endswith((".csv", ".csv.gz")):
        return "csv"
    if name.endswith(".parquet"):
        return "parquet"
    raise InputError(key, str(path), "a file that ends in .csv, .csv.gz or .parquet")


def _load(
    path: Path, features: Sequence[str] | None, ignore: Sequence[str], key: str = "data"
) -> pd.DataFrame:
    """The columns that count, :data:`COLUMNS` first. Of questions (``predict``) labels may be
    missing; without the column of messages nobody was told anything."""
    import pandas as pd

    kind = check_format(path, key)
    if not path.is_file():
        raise InputError(key, str(path), "no such file")
    repeated: list[str] = []
    try:
        if kind == "parquet":
            table = pd.read_parquet(path)
        else:
            header = pd.read_csv(path, nrows=0).columns
            # pandas would number the second of two columns of one name.
            first = pd.read_csv(path, header=None, nrows=1, dtype=str, keep_default_na=False)
            repeated = [name for name in first.iloc[0][first.iloc[0].duplicated()] if name]
            # An observer may be called "NA"; a feature that says so is missing.
            missing = {name: [""] if name in COLUMNS[:2] else MISSING for name in header}
            text = dict.fromkeys(COLUMNS[:2], str)
            table = pd.read_csv(path, keep_default_na=False, na_values=missing, dtype=text)
    except (OSError, EOFError, zlib.error, ValueError, pd.errors.ParserError) as error:
        reason = str(error).strip().splitlines()[0] if str(error) else type(error).__name__
        raise InputError(key, str(path), f"not a readable table ({reason})") from None
    if repeated:
        raise InputError(key, repeated[0], "two columns have this name")
    if "messages" not in table.columns:
        table["messages"] = ""
    if key == "predict":
        table["label"] = 0
    columns = [str(name) for name in table.columns]
    for name in (*COLUMNS, *(features or ()), *ignore):
        if name not in columns:
            raise InputError(key, str(path), f"lacks the column {name}; it has {columns}")
    if features is not None:
        wanted = [*COLUMNS, *features]
    else:
        wanted = [name for name in columns if name not in set(ignore) - set(COLUMNS)]
    if len(wanted) == len(COLUMNS):
        raise InputError(key, str(path), "needs a column that describes the transition")
    if len(set(wanted)) < len(wanted):
        raise InputError(key, wanted, "each column once")
    if not len(table):
        raise InputError(key, str(path), "has no rows")
    return table[wanted]


def _row(bad: Any) -> int:
    """The number of the first bad row, from 1."""
    return int(np.flatnonzero(np.asarray(bad))[0]) + 1


def _complete(column: pd.Series[Any], mend: str = "") -> pd.Series[Any]:
    """A column without missing values.

    Raises:
        InputError: one is missing; ``mend`` says what can be done.
    """
    missing = column.isna()
    if missing.any():
        count, first = int(missing.sum()), _row(missing)
        name = str(column.name)
        raise InputError("data", name, f"missing in {count} rows, first in row {first}{mend}")
    return column


def _factorized(column: pd.Series[Any]) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    import pandas as pd

    code, names = pd.factorize(column, sort=True)
    return code.astype(np.int64), tuple(str(name) for name in names)


def _told(table: pd.DataFrame, messages: Sequence[str] | None) -> dict[str, Any]:
    """Who was asked, and what they were told before: these attributes of a dataset."""
    observer, observers = _factorized(_complete(table["observer"]).astype(str).str.strip())
    message_set, known = _message_sets(table["messages"], messages)
    return {
        "observer": observer,
        "observers": observers,
        "message_set": message_set,
        "messages": known,
    }


def _message_sets(
    column: pd.Series[Any], messages: Sequence[str] | None
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    code, cells = _factorized(column.fillna("").astype(str))
    given = [[name.strip() for name in cell.split(";") if name.strip()] for cell in cells]
    found = sorted({name for names in given for name in names})
    known = tuple(messages) if messages is not None else tuple(found)
    if len(known) > MAX_MASK:
        raise InputError("data", len(known), f"at most {MAX_MASK} different messages")
    for at, names in enumerate(given):
        if unknown := [name for name in names if name not in known]:
            allowed = f"unknown message in row {_row(code == at)}; known: {', '.join(known)}"
            raise InputError("data", unknown[0], allowed)
    masks = np.array([mask_of(names, known, "data") for names in given], dtype=np.int64)
    return masks[code], known


def _labels(column: pd.Series[Any]) -> NDArray[np.uint8]:
    import pandas as pd

    numbers = pd.to_numeric(_complete(column).astype(object), errors="coerce")
    bad = ~numbers.isin([0, 1])
    if bad.any():
        first = column.astype(object)[bad].iloc[0]
        raise InputError("data", first, f"label in row {_row(bad)}: a label is 0 or 1")
    return np.asarray(numbers, dtype=np.uint8)


def _features(table: pd.DataFrame) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """[P, F], text columns one-hot in alphabetical order of their values."""
    from pandas.api.types import is_bool_dtype, is_numeric_dtype

    columns: list[NDArray[np.float64]] = []
    names: list[str] = []
    for name in table.columns:
        mend = f"; leave those rows out, or the column by ignore=[{name}]"
        column = _complete(table[name], mend)
        if is_numeric_dtype(column) or is_bool_dtype(column):
            number = column.to_numpy(dtype=np.float64)
            if not np.isfinite(number).all():
                raise InputError("data", str(name), f"infinite in row {_row(~np.isfinite(number))}")
            columns.append(number)
            names.append(str(name))
        else:
            code, values = _factorized(column.astype(str))
            columns.extend((code == at).astype(np.float64) for at in range(len(values)))
            names.extend(f"{name}={value}" for value in values)
    return np.stack(columns, axis=1), tuple(names)


def _distinct(
    features: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The distinct rows, and the index of each row among them. It goes column by column: linear in
    the rows except for a sort of small numbers."""
    number = np.zeros(len(features), dtype=np.int64)
    for column in features.T:
        values, code = np.unique(column, return_inverse=True)
        _, first, number = np.unique(
            number * len(values) + code, return_index=True, return_inverse=True
        )
    return features[first], number.astype(np.int64)


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
    _, where = np.unique(own, return_inverse=True)
    ones = np.bincount(where, weights=dataset.label)
    torn = int(((ones > 0) & (ones < np.bincount(where))).sum())
    if torn:
        log.warning("%d questions were answered both ways by one observer: both labels count", torn)
