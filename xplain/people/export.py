"""Exports participants' data as tables with a codebook of every column, and replays the events to
check that they lead to the stored states."""

import csv
import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import pandas as pd

from xplain.errors import Refused
from xplain.people.flow import Event, Flow, Participant, S
from xplain.people.plan import StoredPlan

Row = dict[str, Any]
OTHERS = "…"
"""End of a codebook column that represents all columns with the same beginning."""
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_FORMULAS = ("=", "+", "-", "@", "\t", "\r", "＝", "＋", "－", "＠")


def find_differences(flow: Flow[Any, S], people: Iterable[Participant[S]]) -> list[str]:
    """Replays the events of all participants. Returns a sentence for each difference between a
    stored state and the replayed state."""
    differences = []
    for one in people:
        first, *later = [event for event in one.events if event.state]
        state = one.kind.from_text(str(first.state))
        for event in later:
            where = f"{one.id}: event {event.sequence}"
            try:
                state = flow.advance(state, event.kind, event.payload)
            except (Refused, KeyError) as error:
                differences.append(f"{where}: {error}")
                break
            stored, again = json.loads(str(event.state)), json.loads(state.text)
            differences += [
                f"{where}: {key} is {stored.get(key)}, decided again {again[key]}"
                for key in again
                if stored.get(key) != again[key]
            ]
    return differences


# Tables ------------------------------------------------------------------------------------------


def codebook(package: str) -> list[dict[str, str]]:
    """Lists every column of the tables of a flow: its table, name, type, unit and meaning. The rows
    are in ``codebook.csv`` of the flow's package and, for columns that all exports have, of
    xplain.people."""
    books = [files(one).joinpath("codebook.csv") for one in (package, "xplain.people")]
    texts = [book.read_text(encoding="utf-8").splitlines() for book in books]
    return [row for lines in texts for row in csv.DictReader(lines)]


def order_columns(name: str, rows: Iterable[Row], columns: Sequence[str]) -> pd.DataFrame:
    """Makes the table ``name`` from its rows, and orders its columns as in the codebook.

    A codebook entry that ends in :data:`OTHERS` describes all columns with the same beginning. Such
    columns come last, ordered as in the first row.

    Raises:
        ValueError: the columns of a row differ from the columns of the codebook. An export would
            lose such a column, or leave it unexplained.
    """
    rows = list(rows)
    fixed = [column for column in columns if not column.endswith(OTHERS)]
    beginnings = tuple(column[: -len(OTHERS)] for column in columns if column.endswith(OTHERS))
    others = [column for column in (rows[0] if rows else {}) if column not in columns]
    unknown = [column for column in others if not column.startswith(beginnings)]
    missing = {column for row in rows for column in {*fixed, *others} ^ row.keys()}
    if unknown or missing:
        raise ValueError(
            f"{name}: these columns differ from the codebook: {sorted({*unknown, *missing})}"
        )
    return pd.DataFrame(rows, columns=[*fixed, *others])


def defuse(cell: Any) -> Any:
    """Puts an apostrophe before a text that a spreadsheet would run as a formula. Numbers stay
    unchanged."""
    if not isinstance(cell, str) or cell[:1] not in _FORMULAS or _NUMBER.fullmatch(cell):
        return cell
    return f"'{cell}"


def measure_seconds(first: Event, last: Event) -> tuple[float | None, str]:
    """Measures the time from an event to a later event, by the server's monotonic clock, or by its
    wall clock if the server restarted in between.

    Returns:
        The seconds and the name of the clock, "monotonic" or "wall". If the wall clock was set
        back, (None, "impossible").
    """
    clock = "monotonic" if first.boot == last.boot else "wall"
    took = getattr(last, clock) - getattr(first, clock)
    return (took, clock) if took >= 0 else (None, "impossible")


Tables = Callable[[Any, list[Participant[Any]]], Mapping[str, Iterable[Row]]]
"""Returns the rows of every table by name, for a plan and its participants."""


def write(
    folder: Path, package: str, plan: StoredPlan, people: list[Participant[Any]], tables: Tables
) -> str:
    """Writes the tables of a flow into a folder, with the events of everybody who did not withdraw,
    the codebook and the plan.

    Returns:
        SHA-256 of the file of events, to be published with a preregistration.
    """
    book, rows = codebook(package), dict(tables(plan, people))
    rows["codebook"] = book
    rows["events"] = [
        {**event._asdict(), "payload": json.dumps(event.payload, sort_keys=True)}
        for one in people
        for event in one.events
        if one.state.stage != "withdrawn" and event.source != "identity"
    ]
    folder.mkdir(parents=True, exist_ok=True)
    for name in rows:
        columns = [row["column"] for row in book if row["table"] == name]
        table = order_columns(name, rows[name], columns)
        table.map(defuse).to_csv(folder / f"{name}.csv", index=False)
        table.to_parquet(folder / f"{name}.parquet", index=False)
    text = json.dumps(json.loads(plan.text), indent=1, ensure_ascii=False)
    (folder / "plan.json").write_text(f"{text}\n", encoding="utf-8")
    digest = hashlib.sha256((folder / "events.csv").read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text(f"{digest}  events.csv\n", encoding="ascii")
    return digest


def write_identifiers(people: Iterable[Participant[Any]], file: Path) -> None:
    """Writes identifiers for payment into a separate file: a row for each participant with the
    completion code and, if the server keeps them, the platform's ids."""
    rows = [
        {"participant": one.id, "completion_code": one.identity["code"]}
        | one.identity.get("kept", {})
        for one in people
    ]
    pd.DataFrame(rows).map(defuse).to_csv(file, index=False)
