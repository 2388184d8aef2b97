"""Reads people's own tables, CSV or Parquet. Every cell is first a text, exactly as in the file.

A column becomes numbers only if its texts lose nothing: ``007``, ``1E2``, and ``1.1`` beside
``1.10`` stay texts.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import logging
import re
import shlex
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, quoted

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

MISSING = ("", "NA", "N/A", "NaN", "nan", "null", "NULL", "<NA>", "#N/A")
NUMBER = r"[+-]?(?:(?:(?:0|[1-9]\d*)(?:\.\d*)?|\.\d+)(?:e[+-]?\d+|E[+-]\d+)?|inf)"
"""A number as programs write it. R and spreadsheets write a sign as in 1E+05, so 1E2 is a name."""
SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar"}


def check_format(path: Path, key: str) -> str:
    """Returns ``csv`` or ``parquet``, by the ending of the name; ``key`` is the user's key.

    Raises:
        InputError: another ending.
    """
    name = path.name.lower()
    if name.endswith((".csv", ".csv.gz")):
        return "csv"
    if name.endswith(".parquet"):
        return "parquet"
    raise InputError(key, str(path), "a file that ends in .csv, .csv.gz or .parquet")


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

    kind = check_format(path, key)
    if not path.is_file():
        raise InputError(key, str(path), "no such file")
    try:
        table = _read_csv(path, key) if kind == "csv" else _as_texts(pd.read_parquet(path))
    except UnicodeDecodeError:
        raise InputError(key, str(path), 'not in UTF-8; save it as "CSV UTF-8"') from None
    except (OSError, EOFError, zlib.error, ValueError, csv.Error, pd.errors.ParserError) as error:
        if isinstance(error, InputError):
            raise
        reason = str(error).strip().splitlines()[0] if str(error) else type(error).__name__
        raise InputError(key, str(path), f"not a readable table ({reason})") from None
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
    content = gzip.decompress(content) if path.name.lower().endswith(".gz") else content
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if wide else "utf-8-sig")
    text = re.sub(r"^\ufeff*(sep=.\r?\n)?", "", text)  # written by Excel
    if not text.strip():
        raise ValueError("it is empty")
    if "\0" in text:
        raise UnicodeDecodeError("utf-8", content, 0, 1, "UTF-16 without its mark")
    first = re.sub('"[^"]*"', "", text.lstrip().partition("\n")[0])
    separator = max(SEPARATORS, key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    header = [name.strip() or f"Unnamed: {i}" for i, name in enumerate(next(filter(any, reader)))]
    if len({*header}) < len(header):
        repeated = next(name for name in header if header.count(name) > 1)
        raise InputError(key, repeated, "two columns have this name")
    rows: list[list[str]] = []
    for row in reader:
        if not any(row):
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


def stripped(column: pd.Series[Any]) -> pd.Series[Any]:
    """The texts of a column without surrounding spaces. Each distinct text is processed once."""
    return column.map({cell: cell.strip() for cell in column.unique()})


def as_numbers(words: pd.Series[Any]) -> NDArray[np.float64] | None:
    """[rows] the numbers in a column of stripped texts; true is 1, false is 0, a missing cell is
    NaN. None if some texts are no numbers."""
    given = words[~words.isin(MISSING)].drop_duplicates()
    small = given.str.lower()
    if small.isin(["true", "false"]).all():
        numbers = (small == "true").astype(float)
    elif given.str.fullmatch(NUMBER).all():
        numbers = given.astype(float)
        if (twice := given[numbers.duplicated(keep=False)]).any():
            alike = " and ".join(twice[numbers[twice.index] == numbers[twice.index[0]]][:2])
            log.warning("the column %s is text: %s would be one number", words.name, alike)
            return None
    else:
        if given.str.fullmatch(rf"{NUMBER}|\d+,\d+").all():
            log.warning("the column %s is text: a number is written 1.5, not 1,5", words.name)
        return None
    return np.asarray(words.map(dict(zip(given, numbers, strict=True))), dtype=np.float64)


def one_hot(column: str, values: Any) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Converts a column of texts [P] into one 0/1 feature for each value, in alphabetical order.
    Returns the features [P, values] and their names."""
    import pandas as pd

    code, different = pd.factorize(np.asarray(values, dtype=object), sort=True)
    return np.eye(len(different))[code], tuple(f"{column}={one}" for one in different)


def option(key: str, values: Iterable[str]) -> str:
    """The command-line option that sets a key to this list of texts."""
    return shlex.quote(f"{key}=[{','.join(map(_quote, values))}]")


def _quote(value: str) -> str:
    """Quotes a text for Hydra; a word needs no quotation marks."""
    word = re.fullmatch(r"(?!(?i:null|true|false|nan|inf)$)[A-Za-z_]\w*", value, re.ASCII)
    return value if word else quoted(value, '"')
