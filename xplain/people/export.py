"""A database, read only: its plan, its participants, their tables with the codebook of every
column, and whether the plan would decide all of it again."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from filelock import FileLock, Timeout

from xplain.errors import InputError, Refused
from xplain.people.flow import Flow, Participant, S
from xplain.people.plan import StoredPlan

if TYPE_CHECKING:
    import pandas as pd

Plan = TypeVar("Plan", bound=StoredPlan)
Row = dict[str, Any]
STREAMS = ("person", "pilot", "bot")
"""Whose data it is; fixed by the invitation, and never mixed in an analysis."""
OTHERS = "…"
"""Ends a column of a codebook that stands for every column beginning with what is before it."""
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_FORMULAS = ("=", "+", "-", "@", "\t", "\r", "＝", "＋", "－", "＠")

# Reading -----------------------------------------------------------------------------------------


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A read-only connection to a database.

    Raises:
        InputError: it is no study's database.
    """
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    connection.row_factory = sqlite3.Row
    try:
        connection.execute("SELECT 1 FROM meta")
        yield connection
    except sqlite3.DatabaseError as error:
        raise InputError("database", str(path), f"not a study's database ({error})") from None
    finally:
        connection.close()


@contextmanager
def reading(path: Path) -> Iterator[sqlite3.Connection]:
    """A read-only connection to a database that no server has open.

    Raises:
        InputError: there is none, it is in use, or it is no study's database.
    """
    if not path.is_file():
        raise InputError("database", str(path), "a study's database or a snapshot of one")
    lock = Path(f"{path}.lock")
    try:
        with FileLock(lock, timeout=0) if lock.exists() else nullcontext(), opened(path) as read:
            yield read
    except Timeout:
        wanted = "in use by a server; take the snapshot that the researcher's page offers"
        raise InputError("database", str(path), wanted) from None


def copied(database: Path, file: Path) -> None:
    """Copies a database, which its server may have open, with the key beside it.

    Raises:
        InputError: it is no such database, its key is missing, or the file exists.
    """
    key = Path(f"{database}.key")
    if not database.is_file() or not key.is_file():
        raise InputError("database", str(database), f"a database with {key.name} beside it")
    if file.exists():
        raise InputError("file", str(file), "a new file")
    with opened(database) as source, closing(sqlite3.connect(file)) as copy:
        source.backup(copy)
    Path(f"{file}.key").write_bytes(key.read_bytes())
    for path in (file, Path(f"{file}.key")):
        path.chmod(0o600)


def plan_of(connection: sqlite3.Connection, kind: type[Plan]) -> Plan | None:
    """The plan that the data was collected under; None where there is none yet.

    Raises:
        InputError: it is one of another kind.
    """
    row = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    return kind.from_text(row[0]) if row else None


def read_plan(path: Path, kind: type[Plan]) -> Plan | None:
    """The plan in a database, which its server may have open; None where there is none yet.

    Raises:
        InputError: the file is no such database.
    """
    if not path.exists() or not path.stat().st_size:
        return None
    with opened(path) as connection:
        return plan_of(connection, kind)


def read(path: Path, plan: type[Plan], state: type[S]) -> tuple[Plan, list[Participant[S]]]:
    """The plan, and everybody who was not erased, with their events, in the order in which they
    came, of a database that no server has open, or of a snapshot.

    Raises:
        InputError: it is no such flow's database.
    """
    with reading(path) as connection:
        found = plan_of(connection, plan)
        if found is None:
            raise InputError("database", str(path), f"a database in which {plan.OF} was started")
        return found, participants(connection, state)


def participants(connection: sqlite3.Connection, state: type[S]) -> list[Participant[S]]:
    """Everybody who was not erased, with their events, in the order in which they came."""
    events: dict[str, list[Row]] = {}
    for event in connection.execute("SELECT * FROM event ORDER BY participant, sequence"):
        known = dict(event) | {"payload": json.loads(event["payload"])}
        events.setdefault(event["participant"], []).append(known)
    rows = connection.execute("SELECT * FROM seen WHERE NOT erased ORDER BY number")
    return [
        Participant(dict(row), state.from_text(row["state"]), tuple(events[row["id"]]))
        for row in rows
    ]


def replayed(flow: Flow[Any, S], people: Iterable[Participant[S]]) -> list[str]:
    """Would this plan decide all of it again? Where not, a sentence for each difference between the
    stored states and those that the same events lead to now."""
    differences = []
    for one in people:
        state = one.state.from_text(one.events[0]["state"])
        for event in [event for event in one.events[1:] if event["state"]]:
            where = f"{one.id}: event {event['sequence']}"
            try:
                state = flow.advance(state, event["kind"], event["payload"])
            except (Refused, KeyError) as error:
                differences.append(f"{where}: {error}")
                break
            stored, again = json.loads(event["state"]), json.loads(state.text)
            differences += [
                f"{where}: {key} is {stored.get(key)}, decided again {again[key]}"
                for key in again
                if stored.get(key) != again[key]
            ]
    return differences


# Tables ------------------------------------------------------------------------------------------


def codebook(package: str) -> list[dict[str, str]]:
    """Every column of the tables of a flow: its table, name, type, unit and meaning. They stand in
    a file beside the flow; those that every export has are beside this module."""
    books = [files(one).joinpath("codebook.csv") for one in (package, "xplain.people")]
    texts = [book.read_text(encoding="utf-8").splitlines() for book in books]
    return [row for lines in texts for row in csv.DictReader(lines)]


def described(name: str, rows: Iterable[Row], columns: Sequence[str]) -> pd.DataFrame:
    """A table of rows with the columns of its codebook, in that order; those that one entry stands
    for (:data:`OTHERS`) come last, in their own.

    Raises:
        ValueError: a row has a column that the codebook does not describe, or lacks one that it
            does: an export would lose it, or leave it unexplained.
    """
    import pandas as pd

    rows = list(rows)
    fixed = [column for column in columns if not column.endswith(OTHERS)]
    beginnings = tuple(column[: -len(OTHERS)] for column in columns if column.endswith(OTHERS))
    others = [column for column in (rows[0] if rows else {}) if column not in columns]
    unknown = [column for column in others if not column.startswith(beginnings)]
    missing = {column for row in rows for column in {*fixed, *others} ^ row.keys()}
    if unknown or missing:
        raise ValueError(f"{name}: not as its codebook says: {sorted({*unknown, *missing})}")
    return pd.DataFrame(rows, columns=[*fixed, *others])


def defused(cell: Any) -> Any:
    """A text that a spreadsheet would run as a formula, with an apostrophe before it; numbers
    stay as they are."""
    if not isinstance(cell, str) or cell[:1] not in _FORMULAS or _NUMBER.fullmatch(cell):
        return cell
    return f"'{cell}"


def seconds(first: Mapping[str, Any], last: Mapping[str, Any]) -> tuple[float | None, str]:
    """From an event to a later one, and by which of the server's clocks: the monotonic one, or the
    wall clock where the machine was restarted in between. None where it cannot be, because the
    wall clock was set back."""
    clock = "monotonic" if first["boot"] == last["boot"] else "wall"
    took = last[clock] - first[clock]
    return (took, clock) if took >= 0 else (None, "impossible")


Tables = Callable[[Any, list[Participant[Any]]], Mapping[str, Iterable[Row]]]
"""Rows of every table by name, of the plan and its participants."""


def write(
    folder: Path, package: str, plan: StoredPlan, people: list[Participant[Any]], tables: Tables
) -> str:
    """Writes the tables of a flow into a folder, with the events of everybody who did not withdraw,
    the codebook and the plan; and SHA-256 of the file of events, to be published with a
    preregistration.

    Returns:
        The hash.
    """
    book, rows = codebook(package), dict(tables(plan, people))
    rows["codebook"] = book
    rows["events"] = [
        {**event, "payload": json.dumps(event["payload"], sort_keys=True)}
        for one in people
        for event in one.events
        if one.state.stage != "withdrawn"
    ]
    folder.mkdir(parents=True, exist_ok=True)
    for name in rows:
        columns = [row["column"] for row in book if row["table"] == name]
        table = described(name, rows[name], columns)
        table.map(defused).to_csv(folder / f"{name}.csv", index=False)
        table.to_parquet(folder / f"{name}.parquet", index=False)
    text = json.dumps(json.loads(plan.text), indent=1, ensure_ascii=False)
    (folder / "plan.json").write_text(f"{text}\n", encoding="utf-8")
    digest = hashlib.sha256((folder / "events.csv").read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text(f"{digest}  events.csv\n", encoding="ascii")
    return digest


def write_identifiers(database: Path, file: Path) -> None:
    """Writes who is who, for paying people, apart from the tables that may be published: a row a
    participant with the completion code and, where the server keeps them, the platform's ids.

    Raises:
        InputError: it is no database of a study or a collection.
    """
    import pandas as pd

    query = (
        "SELECT id AS participant, code AS completion_code, kept FROM participant WHERE NOT erased"
    )
    with reading(database) as connection:
        rows = [dict(row) for row in connection.execute(f"{query} ORDER BY number")]
    table = pd.DataFrame([row | json.loads(row.pop("kept")) for row in rows])
    table.map(defused).to_csv(file, index=False)
