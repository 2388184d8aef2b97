"""What every export is made of: the participants with their events, tables whose columns are those
of a codebook, and the plan."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

from xplain.people.analysis.codebook import CODEBOOK, explained
from xplain.people.analysis.stored import Plan, plan_of, reading
from xplain.people.flow import S

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
Codebook = Mapping[str, Mapping[str, str]]
"""What every column of every table means."""
OTHERS = "…"
"""Ends an entry of a codebook that stands for every column beginning with what is before it."""
_NUMBER = re.compile(r"[+-]?\d+(\.\d*)?(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_FORMULAS = ("=", "+", "-", "@", "\t", "\r", "＝", "＋", "－", "＠")


@dataclass(frozen=True)
class ParticipantRow(Generic[S]):
    """A row of the participant table, with its state and events in order, payloads decoded."""

    row: Row
    state: S
    events: tuple[Row, ...] = ()

    @property
    def id(self) -> str:
        """As in every table."""
        return str(self.row["id"])

    @property
    def moves(self) -> list[Row]:
        """The events that changed their state, in order."""
        return [event for event in self.events if event["state"] and event["kind"] != "enter"]

    def answers(self, kind: str) -> list[Row]:
        """The accepted answers of a kind, in order."""
        return [e for e in self.events if e["source"] == "protocol" and e["kind"] == kind]

    def first(self, kind: str) -> Row:
        """The payload of the first answer of a kind; empty where there is none."""
        return next((event["payload"] for event in self.answers(kind)), {})


def participants(connection: sqlite3.Connection, kind: type[S]) -> list[ParticipantRow[S]]:
    """Everybody who was not erased, in the order in which they came."""
    rows = connection.execute("SELECT * FROM seen WHERE NOT erased ORDER BY number").fetchall()
    events: dict[str, list[Row]] = {row["id"]: [] for row in rows}
    for event in connection.execute("SELECT * FROM event ORDER BY participant, sequence"):
        if event["participant"] in events:
            read = dict(event) | {"payload": json.loads(event["payload"])}
            events[event["participant"]].append(read)
    return [
        ParticipantRow(dict(row), kind.from_text(row["state"]), tuple(events[row["id"]]))
        for row in rows
    ]


def described(name: str, rows: Iterable[Row], codebook: Mapping[str, Any]) -> pd.DataFrame:
    """A table of rows with the columns of its codebook, in that order; those that one entry stands
    for (:data:`OTHERS`) come last, in their own.

    Raises:
        ValueError: a row has a column that the codebook does not describe, or lacks one that it
            does: an export would lose it, or leave it unexplained.
    """
    import pandas as pd

    rows = list(rows)
    fixed = [column for column in codebook if not column.endswith(OTHERS)]
    beginnings = tuple(column[: -len(OTHERS)] for column in codebook if column.endswith(OTHERS))
    others = [column for column in (rows[0] if rows else {}) if column not in codebook]
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


def seconds(first: Row, last: Row) -> tuple[float | None, str]:
    """From an event to a later one, and by which of the server's clocks: the monotonic one, or the
    wall clock where the machine was restarted in between. None where it cannot be, because the
    wall clock was set back."""
    clock = "monotonic" if first["boot"] == last["boot"] else "wall"
    took = last[clock] - first[clock]
    return (took, clock) if took >= 0 else (None, "impossible")


def write(
    database: Path,
    folder: Path,
    plan: type[Plan],
    state: type[S],
    tables: Callable[[Plan, list[ParticipantRow[S]]], Mapping[str, Iterable[Row]]],
    codebook: Codebook,
) -> tuple[str, Plan, list[ParticipantRow[S]]]:
    """Writes the tables of a database (better: of a snapshot) into a folder, with the events of
    everybody who is in them, the codebook and the plan; and SHA-256 of the file of events, to be
    published with a preregistration.

    Args:
        database: of a flow.
        folder: to write into.
        plan, state: classes of its plan and of its states.
        tables: rows of every table by name, of the plan, the participants and the steps.
            codebook: of these tables.

    Returns:
        The hash, the plan, and the participants.

    Raises:
        InputError: it is no such flow's database.
    """
    book = {**codebook, **CODEBOOK}
    with reading(database) as connection:
        own, people = plan_of(connection, plan), participants(connection, state)
        rows = dict(tables(own, people))
        (stored,) = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    rows["codebook"] = explained(book)
    folder.mkdir(parents=True, exist_ok=True)
    for name in rows:
        table = described(name, rows[name], book[name])
        table.map(defused).to_csv(folder / f"{name}.csv", index=False)
        table.to_parquet(folder / f"{name}.parquet", index=False)
    text = json.dumps(json.loads(stored), indent=1, ensure_ascii=False)
    (folder / "plan.json").write_text(f"{text}\n", encoding="utf-8")
    digest = hashlib.sha256((folder / "events.csv").read_bytes()).hexdigest()
    (folder / "SHA256SUMS").write_text(f"{digest}  events.csv\n", encoding="ascii")
    return digest, own, people


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


def events_of(people: Iterable[ParticipantRow[Any]]) -> list[Row]:
    """Rows of the table of events."""
    return [
        event | {"payload": json.dumps(event["payload"], sort_keys=True)}
        for one in people
        for event in one.events
    ]
