"""A collection's database, read only: for exports, replays, and the next start of its server."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from xplain.collect.protocol.plan import CollectPlan
from xplain.errors import InputError
from xplain.study.stored import opened


def plan_of(connection: sqlite3.Connection) -> CollectPlan:
    """The plan that the labels were collected under.

    Raises:
        InputError: there is none yet, or it is another version's or a study's.
    """
    row = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    if row is None:
        raise InputError("database", "its plan", "a database in which a collection was started")
    return CollectPlan.from_text(row[0])


def read_plan(path: Path) -> CollectPlan | None:
    """The plan in a database; None where there is none yet.

    Raises:
        InputError: the file is no such database.
    """
    if not path.exists() or not path.stat().st_size:
        return None
    with opened(path) as connection:
        started = connection.execute("SELECT 1 FROM meta WHERE key = 'plan'").fetchone()
        return plan_of(connection) if started else None
