"""Reads people's own tables (CSV or Parquet), such as tables of labels (docs/your-own-data.md).

A table of labels has one row for each label. Its columns are ``observer``, ``label`` (0 or 1), and
``messages``: names joined by ``;``. The cell is empty if the observer received no messages. Without
this column, nobody received messages. All other columns are features of the transition
(:func:`read_table`). Rows with equal features are the same transition.

Every cell is first read as a text. A column becomes numbers only if no text loses information:
``007``, ``1E2``, and ``1.1`` beside ``1.10`` stay texts. A column of texts becomes one 0/1 feature
for each value (``action=left``).

An observer with only one label is kept, with a warning. If an observer answers the same question in
both ways, both labels count, because people make errors. A table is refused if it has a missing
value, a label other than 0 or 1, fewer than two observers, only equal labels, or fewer than four
distinct questions (transition, message set).
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import logging
import math
import re
import shlex
import unicodedata
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, first_line, one_of, quote
from xplain.explanation.message_sets import mask_of, names_of
from xplain.learning.data.dataset import Dataset, query_index

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

MISSING = frozenset(("", "NA", "N/A", "NaN", "nan", "null", "NULL", "<NA>", "#N/A"))
NUMBER = r"[+-]?(?:(?:(?:0|[1-9]\d*)(?:\.\d*)?|\.\d+)(?:e[+-]?\d+|E[+-]\d+)?|inf)"
"""A number as programs write it. R and spreadsheets write a sign after E, as in 1E+05, so 1E2 is a
text."""
TIME = r".*(\d{4}[-/.]\d\d?[-/.]\d\d?|\d\d?[-/.]\d\d?[-/.]\d{4}|\b\d\d?:\d\d(:\d\d|\b)).*"
SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar"}
COLUMNS = ("observer", "messages", "label")
NEARLY_ALL = 0.9
"""A column with more distinct values than this share of the rows cannot describe a transition."""
NOTHING = "none|nothing|nil|missing|no|no messages?|n/a|0|[.]|-|–|—|\\[\\]|{}|\\(\\)"
"""Names that look like an empty message set."""
MAX_MASK = 62
"""Maximum number of messages in a table; a message set is the bits of one integer."""
MIN_QUERIES = 4
"""Minimum number of distinct (transition, message set), so that training and test parts have a
meaning."""
PREFIXES = {"data": "", "observers.path": "observers."}
"""For each key that holds the path of a table of labels: the prefix of the other keys about this
table."""


class Column(NamedTuple):
    """A column of P cells with U different texts.

    Attributes:
        key: the user's key, for errors.
        name: name of the column.
        words: [U] the distinct texts, without spaces at their ends, sorted.
        code: [P] index into ``words``.
    """

    key: str
    name: str
    words: NDArray[Any]
    code: NDArray[np.int64]

    @classmethod
    def of(cls, key: str, name: str, cells: Any) -> Column:
        """Makes a column from the texts of its cells."""
        import pandas as pd

        code, words = pd.factorize(pd.Series(cells, dtype=object).str.strip(), sort=True)
        return cls(key, name, np.asarray(words, dtype=object), code.astype(np.int64))

    def different_with(self, *others: Column) -> int:
        """Returns the number of distinct rows in the table of this column and the columns
        ``others``."""
        code = self.code
        for other in others:
            code = np.unique(code * len(other.words) + other.code, return_inverse=True)[1]
        return len(np.unique(code))

    def refuse(self, bad: Any, what: str, advice: str = "") -> None:
        """Raises InputError if some words [U] are bad; the error gives the first row with a bad
        word."""
        rows = np.flatnonzero(np.asarray(bad, dtype=bool)[self.code])
        if len(rows):
            word = self.words[self.code[rows[0]]] or self.name
            where = f"{what} in {len(rows)} rows of {self.name}, first in row {rows[0] + 1}"
            raise InputError(self.key, word, where + advice)

    def numbers(self) -> NDArray[np.float64] | None:
        """Converts the words to numbers [U]; true is 1, false is 0, a missing cell is NaN. Returns
        None if a word is no number, or if two words would be the same number."""
        given = [word for word in self.words if word not in MISSING]
        if {word.lower() for word in given} <= {"true", "false"}:
            found = {word: float(word.lower() == "true") for word in given}
        elif all(re.fullmatch(NUMBER, word) for word in given):
            found, first = {word: float(word) for word in given}, dict[float, str]()
            for word, number in found.items():
                if (other := first.setdefault(number, word)) != word:
                    alike = f"{other} and {word} would be one number"
                    log.warning("the column %s is text: %s", self.name, alike)
                    return None
        else:
            if all(re.fullmatch(rf"{NUMBER}|\d+,\d+", word) for word in given):
                log.warning("the column %s is text: a number is written 1.5, not 1,5", self.name)
            return None
        return np.array([found.get(word, math.nan) for word in self.words])

    def warn_of_similar(self) -> None:
        """Warns about words that differ only by invisible marks, case, or two encodings of one
        character or number."""
        seen: dict[str, str] = {}
        for word in self.words:
            plain = unicodedata.normalize("NFKC", word).casefold()
            plain = re.sub(r"[\u200b-\u200f\ufeff]|^0+(?=\d)|(?<=\d)\.0+$", "", plain)
            if (other := seen.setdefault(plain, word)) != word:
                text = "%s: %a and %a in the column %s look alike; they count as two"
                log.warning(text, self.key, other, word, self.name)

    def features(self, like: Sequence[str] = ()) -> tuple[NDArray[Any], tuple[str, ...]]:
        """Returns the features [U, F] of the column's U distinct texts, and the names of the
        features.

        Args:
            like: names of known features. A column with one of these names is read as numbers. If
                some names have the form ``column=value``, the column is read as text, and only
                these values are allowed. Otherwise the column's texts decide.

        Raises:
            InputError: a text is missing, no number or infinite, or is a value that ``like`` does
                not allow.
        """
        prefix = f"{self.name}="
        known = [name.removeprefix(prefix) for name in like if name.startswith(prefix)]
        numbers = None if known else self.numbers()
        absent, mend = [word in MISSING for word in self.words], "; leave those rows out"
        if self.key in PREFIXES:
            mend += f", or the column by {option(self.key, 'ignore', self.name)}"
        if self.name in like and numbers is None:
            numbers = np.array([_read_float(word) for word in self.words])
            self.refuse(np.isnan(numbers) & ~np.array(absent), "no number")
        if numbers is not None:
            self.refuse(np.isnan(numbers), "missing", mend)
            self.refuse(np.isinf(numbers), "infinite")
            return numbers[:, None], (self.name,)
        self.refuse(self.words == "", "missing", mend)
        if any(absent):
            word = self.words[absent.index(True)]
            log.warning("%s: %s in the column %s is a text", self.key, word, self.name)
        self.warn_of_similar()
        values = known or [*self.words]
        others = [word not in values for word in self.words]
        self.refuse(others, "unknown value", f"; known: {', '.join(values)}")
        return self.words[:, None] == np.array(values, object), tuple(prefix + x for x in values)


def _read_float(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def features_of(
    columns: Iterable[Column], like: Sequence[str] = ()
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Returns the features [P, F] of some columns, and their names. The names in ``like`` decide
    which columns are read as numbers, and which as text."""
    made = [(column, *column.features(like)) for column in columns]
    found = np.hstack([values[column.code] for column, values, _ in made]).astype(np.float64)
    return found, tuple(name for *_, own in made for name in own)


def put_in_order(
    features: NDArray[np.float64], names: Sequence[str], like: Sequence[str], key: str
) -> NDArray[np.float64]:
    """Returns a table of features whose columns are sorted in the order of ``like``.

    Args:
        features: [..., F] the unsorted table.
        names: F names of the table's columns.
        like: F names in the required order.
        key: the user's key, for errors.

    Raises:
        InputError: a feature is missing, or is not one of ``like``.
    """
    for name in names:
        one_of(key, name, like, "feature")
    for name in like:
        if name not in names:
            raise InputError(key, name.partition("=")[0], "this column is missing")
    return features[..., [names.index(name) for name in like]]


def encode_transition(
    transition: Mapping[str, float | str], feature_names: Sequence[str]
) -> tuple[float, ...]:
    """Returns the F features of a transition, in order.

    Args:
        transition: a number or a text for each column that the features come from.
        feature_names: F names.

    Raises:
        InputError: a column is missing or unknown, or has a text that the labels do not have.
    """
    alone = np.zeros(1, dtype=np.int64)
    columns = [
        Column("trace", name, np.array([str(value).strip()], dtype=object), alone)
        for name, value in transition.items()
    ]
    if not columns:
        raise InputError("trace", dict(transition), "a value for each column")
    found = put_in_order(*features_of(columns, feature_names), feature_names, "trace")
    return tuple(found[0].tolist())


def read_table(
    path: str | Path,
    messages: Sequence[str] | None = None,
    features: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
    under_way: bool = False,
    like: Sequence[str] = (),
    key: str = "data",
) -> Dataset:
    """Reads a table of labels.

    Args:
        path: ends in ``.csv``, ``.csv.gz`` or ``.parquet``.
        messages: the allowed names, in order; None: all names in the table, sorted.
        features: columns that describe the transition; None: all suitable columns. A column is not
            suitable if it is constant for each person, different in nearly every row, a date or a
            time, or a number that counts the rows of each person.
        ignore: columns to leave out, if ``features`` is None.
        under_way: accept a table that is too small to learn types from, because more labels will
            follow.
        like: names of the required features, in order; they also decide which columns are read as
            numbers, and which as text.
        key: the user's key, for errors.

    Raises:
        InputError: a rule of this module is broken. The error gives the column, the first bad value
            and its row (1 is the first row of data).
    """
    table = read_cells(Path(path), key)
    _require_columns(table, path, key, ("observer", "label", *(features or ()), *ignore), like)
    columns = _find_columns(table, key)
    if features is None:
        others = [name for name in columns if name not in {*COLUMNS, *ignore}]
        sure = {*like, *(name.partition("=")[0] for name in like)}
        features = _choose_features(columns, others, sure)
    if len({*COLUMNS, *features}) < len(COLUMNS) + len(features):
        raise InputError(key, [*COLUMNS, *features], "each column once")
    if not features:
        raise InputError(key, str(path), "needs a column that describes the transition")
    label = columns["label"]
    label.refuse([word in MISSING for word in label.words], "missing")
    truth = {"true": 1.0, "false": 0.0}
    numbers = np.array([truth.get(word.lower(), _read_float(word)) for word in label.words])
    label.refuse(~np.isin(numbers, (0, 1)), "no label", "; a label is 0 or 1")
    said = numbers.astype(np.uint8)[label.code]
    dataset = _make_dataset(columns, features, said, messages, like)
    if not under_way:
        _check_dataset(dataset, key)
    rows, steps = len(dataset), len(dataset.features)
    log.info("%s: %d steps by the features %s", key, steps, ", ".join(features))
    if steps > NEARLY_ALL * rows and len(features) > 1:
        most = max(features, key=lambda name: len(columns[name].words))
        advice = option(key, "features", *(name for name in features if name != most))
        log.warning("%s: nearly every answer is about another step; try %s", key, advice)
    silent = int((dataset.message_set == 0).sum())
    log.info("%s: %d of %d rows have no messages", key, silent, rows)
    return dataset


def read_questions(path: str | Path, like: Dataset) -> tuple[pd.DataFrame, Dataset]:
    """Reads a table of questions, one in each row, whose answers will be predicted. The table is as
    in :func:`read_table`, but labels may be missing and observers may be new.

    Args:
        path: path of the table.
        like: the labels that the predictions are made from; other features or messages are refused.

    Returns:
        The unchanged table, and a dataset of its rows in order; all its labels are 0 and have no
        meaning.

    Raises:
        InputError: the rows do not fit ``like``.
    """
    table, names = read_cells(Path(path), "predict"), like.feature_names
    features = [*dict.fromkeys(name.partition("=")[0] for name in names)]
    _require_columns(table, path, "predict", ("observer", *features))
    columns, label = _find_columns(table, "predict"), np.zeros(len(table), dtype=np.uint8)
    return table, _make_dataset(columns, features, label, like.messages, names)


def write_table(dataset: Dataset, path: str | Path) -> None:
    """Writes a table for :func:`read_table`. One-hot features become one column of text again."""
    import pandas as pd

    distinct, mask = np.unique(dataset.message_set, return_inverse=True)
    sets = np.array([";".join(names_of(int(one), dataset.messages)) for one in distinct])
    columns: dict[str, Any] = {
        "observer": np.array(dataset.observers)[dataset.observer],
        "messages": sets[mask],
    }
    for name, values in columns_of(dataset.features, dataset.feature_names).items():
        columns[name] = values[dataset.transition]
    columns["label"] = dataset.label
    table = pd.DataFrame(columns)
    if is_parquet(Path(path), "data"):
        table.to_parquet(path, index=False)
    else:
        table.to_csv(path, index=False)


def columns_of(features: NDArray[np.float64], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Returns the columns [T] of transitions with these features [T, F]. One-hot features become
    one column of text."""
    columns: dict[str, NDArray[Any]] = {}
    groups: dict[str, list[int]] = {}
    for j, name in enumerate(names):
        groups.setdefault(name.partition("=")[0], []).append(j)
    for column, own in groups.items():
        columns[column] = features[:, own[0]]
        if names[own[0]] != column:
            texts = np.array([names[j].partition("=")[2] for j in own])
            columns[column] = texts[features[:, own].argmax(axis=1)]
    return columns


def is_parquet(path: Path, key: str) -> bool:
    """True if the name of a table has the ending of a Parquet file, False if it has the ending of a
    CSV file.

    Raises:
        InputError: the name has another ending; the error names ``key``.
    """
    name = path.name.lower()
    if not name.endswith((".csv", ".csv.gz", ".parquet")):
        raise InputError(key, str(path), "a file that ends in .csv, .csv.gz or .parquet")
    return name.endswith(".parquet")


def read_cells(path: Path, key: str) -> pd.DataFrame:
    """Reads a table of texts; a missing cell is "". A column without a name gets a name as in
    pandas, such as "Unnamed: 0".

    Args:
        path: a CSV file (comma, semicolon, tab or bar; UTF-8 or UTF-16), or a Parquet file.
        key: the user's key, for errors.

    Raises:
        InputError: the file cannot be read, two columns have the same name, a row has more or fewer
            cells than the header, or there are no rows. Rows without any text do not count.
    """
    import pandas as pd

    parquet = is_parquet(path, key)
    if not path.is_file():
        raise InputError(key, str(path), "no such file")
    try:
        table = _as_texts(pd.read_parquet(path)) if parquet else _read_csv(path, key)
    except UnicodeDecodeError:
        raise InputError(key, str(path), 'not in UTF-8; save it as "CSV UTF-8"') from None
    except InputError:
        raise
    except (OSError, EOFError, zlib.error, ValueError, csv.Error, pd.errors.ParserError) as error:
        raise InputError(key, str(path), f"not a readable table ({first_line(error)})") from None
    if not len(table):
        raise InputError(key, str(path), "has no rows")
    return table


def _as_texts(table: pd.DataFrame) -> pd.DataFrame:
    """Converts all cells and column names to texts; a missing cell becomes ""."""
    cells = table.astype(object).where(table.notna(), "").astype(str).astype(object)
    return cells.set_axis(table.columns.map(str), axis=1)


def _read_csv(path: Path, key: str) -> pd.DataFrame:
    import pandas as pd

    content = path.read_bytes()
    content = gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if wide else "utf-8-sig")
    text = re.sub(r"^\ufeff*(sep=.[\r\n]+)?", "", text)  # written by Excel
    if not text.strip():
        raise ValueError("it is empty")
    if "\0" in text:
        raise UnicodeDecodeError("utf-8", content, 0, 1, "UTF-16 without its mark")
    first = re.split(r"[\r\n]", re.sub('"[^"]*"', "", text.lstrip()), maxsplit=1)[0]
    separator = max(SEPARATORS, key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    names = (" ".join(name.split()) for name in next(filter(any, reader)))
    header = [name or f"Unnamed: {i}" for i, name in enumerate(names)]
    for name in header:
        if header.count(name) > 1:
            raise InputError(key, name, "two columns have this name")
    rows: list[list[str]] = []
    for row in reader:
        if not "".join(row).strip():
            continue
        if len(row) != len(header):
            allowed = (
                f"line {reader.line_num} has {len(row)} cells, the header has {len(header)}; write "
                f'a text that holds a {SEPARATORS[separator]} in double quotes, "like this"'
            )
            if len(header) == 1:
                allowed = f"the first line, {header[0]!r}, is no header; delete it"
            if len(row) == len(header) + 1 and not rows and row[-1]:  # row names, written by R
                begin = f"begin the header with a {SEPARATORS[separator]}"
                allowed += f"; if each line begins with its number, {begin}"
            raise InputError(key, str(path), allowed)
        rows.append(row)
    if len(rows) > 1 and rows[1][0].startswith('{"ImportId"'):
        log.warning("%s: the second and third row of the header (Qualtrics) are left out", key)
        del rows[:2]
    return pd.DataFrame(rows, columns=header, dtype=object)


def option(key: str, name: str, *values: str) -> str:
    """Writes the command-line option that sets ``name`` (such as ``ignore``) to a list of texts,
    for the table whose path is set by the key ``key``."""
    return shlex.quote(f"{PREFIXES.get(key, '')}{name}=[{','.join(map(_quote, values))}]")


def _quote(value: str) -> str:
    """Quotes a text for Hydra; a word needs no quotation marks."""
    word = re.fullmatch(r"(?!(?i:null|true|false|nan|inf)$)[A-Za-z_]\w*", value, re.ASCII)
    return value if word else quote(value, '"')


def _require_columns(
    table: pd.DataFrame, path: str | Path, key: str, names: Iterable[str], like: Sequence[str] = ()
) -> None:
    """Raises InputError if a column is missing, or if the name of a column is nearly one of
    :data:`COLUMNS`, or has a "=" and is not in ``like``."""
    columns = [*table.columns]
    for name in columns:
        if "=" in name and name not in like:
            raise InputError(key, name, "rename this column: a name has no =")
        for near in {*COLUMNS} - {*columns}:
            if name.casefold().rstrip("s") == near.rstrip("s"):
                raise InputError(key, name, f"rename this column to {near}")
    for name in names:
        if name not in columns:
            raise InputError(key, str(path), f"lacks the column {name}; it has {columns}")


def _choose_features(
    columns: Mapping[str, Column], names: Sequence[str], sure: set[str]
) -> list[str]:
    """Chooses the columns that can describe a transition. A warning gives all other columns, with
    the reasons.

    Args:
        columns: all columns of the table.
        names: columns to choose from.
        sure: columns that are always features.

    Raises:
        InputError: no column is suitable.
    """
    observer, left = columns["observer"], dict[str, str]()
    people, rows = len(observer.words), len(observer.code)
    for name in (name for name in names if name not in sure):
        column = columns[name]
        if people < rows and column.different_with(observer) == people:
            left[name] = "the same in all rows of a person"
        elif len(column.words) > NEARLY_ALL * rows:
            left[name] = "another value in nearly every row"
        elif all(re.fullmatch(TIME, word, re.DOTALL) for word in column.words):
            left[name] = "dates or times"
    for name in [name for name in names if name not in {*left, *sure}]:
        others = [columns[x] for x in names if x not in {name, *left}]
        if others and _is_row_number(columns[name], observer, others, columns["messages"]):
            left[name] = "it counts the rows of each person"
    taken, key = [name for name in names if name not in left], observer.key
    reasons = ", ".join(f"{name} ({why})" for name, why in left.items())
    if names and not taken:
        name, why = next(iter(left.items()))
        raise InputError(key, name, f"{why}; if it is a feature: {option(key, 'features', name)}")
    if left:
        advice = option(key, "features", *names)
        log.warning("%s: left out: %s; to take all: %s", key, reasons, advice)
    return taken


def _is_row_number(
    column: Column, observer: Column, others: Sequence[Column], messages: Column
) -> bool:
    """True if a column only counts the rows of each person: its numbers rise from row to row of
    each person, and do not identify the transition. This is so if rows with the same number differ
    in other columns, or if each number has only one message set."""
    number = np.array([_read_float(word) for word in column.words])[column.code]
    order, values = np.argsort(observer.code, kind="stable"), len(column.words)
    rises = np.diff(number[order])[np.diff(observer.code[order]) == 0] > 0
    if not len(rises) or not rises.all():
        return False
    fixed = len(messages.words) > 1 and column.different_with(messages) == values
    return fixed or column.different_with(*others) > values


def _find_columns(table: pd.DataFrame, key: str) -> dict[str, Column]:
    """Returns the columns by name. Without a column ``messages``, nobody received messages."""
    table = table if "messages" in table.columns else table.assign(messages="")
    return {name: Column.of(key, name, table[name]) for name in table.columns}


def _make_dataset(
    columns: Mapping[str, Column],
    described: Sequence[str],
    label: NDArray[np.uint8],
    messages: Sequence[str] | None,
    like: Sequence[str],
) -> Dataset:
    """Makes the dataset of labels [P]. The columns ``described`` describe the transitions; the
    other arguments are as in :func:`read_table`."""
    import pandas as pd

    features, names = features_of([columns[name] for name in described], like)
    table = pd.DataFrame(features)
    number = table.groupby([*table.columns], sort=True).ngroup()
    transition = np.asarray(number, dtype=np.int64)
    distinct = features[np.unique(transition, return_index=True)[1]]
    observer = columns["observer"]
    observer.refuse(observer.words == "", "missing")
    observer.warn_of_similar()
    message_set, known = message_sets(columns["messages"], messages)
    if like:
        distinct, names = put_in_order(distinct, names, like, observer.key), tuple(like)
    return Dataset(
        features=distinct,
        feature_names=names,
        messages=known,
        observers=tuple(observer.words),
        observer=observer.code,
        transition=transition,
        message_set=message_set,
        label=label,
    )


def message_sets(
    column: Column, messages: Sequence[str] | None = None
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Returns the message set of each row [P], and the names of all messages.

    Args:
        column: names joined by ``;`` in each cell.
        messages: the allowed names, in order; None: all names in the column, sorted.

    Raises:
        InputError: a name is unknown, looks like several names, means "no message", or differs from
            another name only by case; or there are too many names.
    """
    absent = MISSING - {*(messages or ())}
    given = [[" ".join(x.split()) for x in cell.split(";") if x.strip()] for cell in column.words]
    given = [[] if len(names) == 1 and names[0] in absent else names for names in given]
    found = sorted({name for names in given for name in names})
    if messages is None:
        _refuse_unclear_names(column.key, found)
    known = tuple(found if messages is None else messages)
    if len(known) > MAX_MASK:
        raise InputError(column.key, len(known), f"at most {MAX_MASK} different messages")
    unknown = [not {*names} <= {*known} for names in given]
    column.refuse(unknown, "unknown message", f"; known: {', '.join(known)}")
    masks = np.array([mask_of(names, known, column.key) for names in given], dtype=np.int64)
    return masks[column.code], known


def _refuse_unclear_names(key: str, names: Sequence[str]) -> None:
    """Raises InputError for a name that looks like several names, means "no message", or differs
    from another name only by case."""
    one = "if it is one message, give it another name"
    if key in PREFIXES:
        one = f"if it is one message: {option(key, 'messages', *names)}"
    parts = {x: [part.strip() for part in re.split(r"[,|+&/\\]", x)] for x in names}
    for name, own in parts.items():
        single = not any(" " in part for part in own)
        elsewhere = {part for other in names if other != name for part in parts[other]}
        joined = len(own) > 1 and all(own) and (single or {*own} & elsewhere)
        others = "|".join(re.escape(other) for other in names if other != name)
        several = rf"\W*({others})((\W|_)+(and\W+)?({others}))+\W*"
        if name in MISSING or re.fullmatch(NOTHING, name, re.IGNORECASE):
            raise InputError(key, name, f"leave the cell empty if no message was given; {one}")
        bracket = name[0] in "[{('\"" or name[-1] in ")}]"
        if bracket or joined or (others and re.fullmatch(several, name)):
            allowed = f"looks like messages joined by another sign than a semicolon; {one}"
            raise InputError(key, name, allowed)
        for other in names:
            if name < other and name.casefold() == other.casefold():
                raise InputError(key, name, f"differs from {other} by case alone; {one}")


def _check_dataset(dataset: Dataset, key: str) -> None:
    if len(dataset.observers) < 2:
        raise InputError(key, dataset.observers[0], "one observer; types need at least two")
    if dataset.label.min() == dataset.label.max():
        raise InputError(key, int(dataset.label[0]), "all labels are equal; nothing to learn")
    query = query_index(dataset)
    count = int(query.max()) + 1
    if count < MIN_QUERIES:
        raise InputError(
            key, count, f"a split needs at least {MIN_QUERIES} distinct (transition, messages)"
        )
    single = np.bincount(dataset.observer) == 1
    if single.any():
        log.warning("%d observers gave only one label, which decides their type", int(single.sum()))
    own = query * len(dataset.observers) + dataset.observer
    if torn := len(np.unique(2 * own + dataset.label)) - len(np.unique(own)):
        log.warning("%d questions were answered both ways by one observer: both labels count", torn)
