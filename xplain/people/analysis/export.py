"""What every export is made of: the participants with their events, tables whose columns are those
of a codebook, the plan, and the head of the log."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

from xplain.people.analysis.log import head_of
from xplain.people.flow import S

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
Codebook = Mapping[str, Mapping[str, str]]
"""What every column of every table means."""
OTHERS = "…"
"""Ends an entry of a codebook that stands for every column beginning with what is before it."""
_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
_KEPT = "participant WHERE NOT erased"


@dataclass(frozen=True)
class Participant(Generic[S]):
    """A row of the participant table, with its state and events in order, payloads decoded."""

    row: Row
    state: S
    events: tuple[Row, ...]

    @property
    def id(self) -> str:
        """As in every table."""
        return str(self.row["id"])

    def answers(self, kind: str) -> list[Row]:
        """The accepted answers of a kind, in order."""
        return [e for e in self.events if e["source"] == "protocol" and e["kind"] == kind]

    def first(self, kind: str) -> Row:
        """The payload of the first answer of a kind; empty where there is none."""
        found: Row = next((event["payload"] for event in self.answers(kind)), {})
        return found


def everybody(connection: sqlite3.Connection) -> list[tuple[Row, tuple[Row, ...]]]:
    """Rows and events of everybody who was not erased, in the order in which they came."""
    rows = connection.execute(f"SELECT * FROM {_KEPT} ORDER BY number").fetchall()
    of: dict[str, list[Row]] = {row["id"]: [] for row in rows}
    for event in events(connection):
        of[event["participant"]].append(event | {"payload": json.loads(event["payload"])})
    return [(dict(row), tuple(of[row["id"]])) for row in rows]


def events(connection: sqlite3.Connection) -> list[Row]:
    """All their events as they are stored, by participant and in order."""
    rows = connection.execute(
        f"SELECT * FROM event WHERE participant IN (SELECT id FROM {_KEPT}) "
        "ORDER BY participant, sequence"
    )
    return [dict(row) for row in rows]


def participants(connection: sqlite3.Connection, kind: type[S]) -> list[Participant[S]]:
    """The same with the states that are stored."""
    return [
        Participant(row, kind.from_text(row["state"]), own) for row, own in everybody(connection)
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
    """A text that a spreadsheet would run as a formula, with an apostrophe before it."""
    return f"'{cell}" if isinstance(cell, str) and cell[:1] in _FORMULAS else cell


def write(
    connection: sqlite3.Connection, tables: Mapping[str, pd.DataFrame], folder: Path, parquet: bool
) -> str:
    """Writes tables into a folder, the plan, and the head of the log: with it a replay can tell
    whether anything before was changed since.

    Returns:
        The head.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        table.map(defused).to_csv(folder / f"{name}.csv", index=False)
        if parquet:
            table.to_parquet(folder / f"{name}.parquet", index=False)
    (plan,) = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    text, head = json.dumps(json.loads(plan), indent=1, ensure_ascii=False), head_of(connection)
    (folder / "plan.json").write_text(f"{text}\n", encoding="utf-8")
    (folder / "head.txt").write_text(f"{head}\n", encoding="ascii")
    return head
