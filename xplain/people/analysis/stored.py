"""The database, read only: for exports, replays, and the next start of its server."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from xplain.errors import InputError, one_of
from xplain.people.plan import StoredPlan

Plan = TypeVar("Plan", bound=StoredPlan)
STREAMS = ("person", "pilot", "bot")
"""Whose data it is; fixed by the invitation, and never mixed in an analysis."""


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """A read-only connection to a study's database.

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
    """A read-only connection to a study's database that no server has open.

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
    for path, mode in ((file, 0o600), (Path(f"{file}.key"), 0o600)):
        if path != file:
            path.write_bytes(key.read_bytes())
        path.chmod(mode)


def plan_of(connection: sqlite3.Connection, kind: type[Plan]) -> Plan:
    """The plan that the data was collected under.

    Raises:
        InputError: there is none yet, or it is one of another kind or version.
    """
    row = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    (_, _, path) = connection.execute("PRAGMA database_list").fetchone()
    if row is None:
        raise InputError("database", path, f"a database in which {kind.OF} was started")
    try:
        return kind.from_text(row[0])
    except InputError as error:
        raise InputError("database", path, error.allowed) from None


def rows_of(
    path: Path, stream: str, kind: type[Plan], query: str
) -> tuple[Plan, list[sqlite3.Row]]:
    """The plan, and what a query finds of the people of a stream.

    Args:
        path: of a database that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.
        kind: class of the plan.
        query: with one place, for the stream.

    Raises:
        InputError: it is no such flow's database, or there is no such stream.
    """
    one_of("stream", stream, STREAMS)
    with reading(path) as connection:
        return plan_of(connection, kind), connection.execute(query, (stream,)).fetchall()


def read_plan(path: Path, kind: type[Plan]) -> Plan | None:
    """The plan in a database; None where there is none yet.

    Raises:
        InputError: the file is no such database.
    """
    if not path.exists() or not path.stat().st_size:
        return None
    with opened(path) as connection:
        started = connection.execute("SELECT 1 FROM meta WHERE key = 'plan'").fetchone()
        return plan_of(connection, kind) if started else None
