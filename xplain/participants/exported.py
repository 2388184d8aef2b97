"""What every export is made of: the participants with their events, tables whose columns are those
of a codebook, the plan, and the head of the log."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.participants.protocol.plan import StoredPlan

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
OTHERS = "…"
"""Ends an entry of a codebook that stands for every column beginning with what is before it."""
_FORMULAS = ("=", "+", "-", "@", "\t", "\r")
_KEPT = "participant WHERE NOT erased"


def participants(connection: sqlite3.Connection) -> list[Row]:
    """Everybody who was not erased, in the order in which they came."""
    return [dict(row) for row in connection.execute(f"SELECT * FROM {_KEPT} ORDER BY number")]


def events(connection: sqlite3.Connection) -> list[Row]:
    """All their events, by participant and in order."""
    rows = connection.execute(
        f"SELECT * FROM event WHERE participant IN (SELECT id FROM {_KEPT}) "
        "ORDER BY participant, sequence"
    )
    return [dict(row) for row in rows]


def by_participant(people: Iterable[Row], events: Iterable[Row]) -> dict[str, list[Row]]:
    """Each one's events, their payloads decoded."""
    of: dict[str, list[Row]] = {person["id"]: [] for person in people}
    for event in events:
        of[event["participant"]].append(event | {"payload": json.loads(event["payload"])})
    return of


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


def write_origin(folder: Path, plan: StoredPlan, head: str) -> None:
    """Writes the plan, and the head of the log: with it a replay can tell whether anything before
    was changed since."""
    text = json.dumps(json.loads(plan.text), indent=1, ensure_ascii=False)
    (folder / "plan.json").write_text(f"{text}\n", encoding="utf-8")
    (folder / "head.txt").write_text(f"{head}\n", encoding="ascii")
