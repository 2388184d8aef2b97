"""The log of a study, a collection or the service: events in one SQLite file.

Only events are stored. Each event has the decision that was made with it, and the state after it;
everything else is computed from events. One process has the file open for writing. Acknowledged
events are on the disk (WAL, ``synchronous=FULL``), and a repeated event is stored once.
"""

import json
import os
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

from filelock import FileLock, Timeout

from xplain.errors import InputError
from xplain.people.flow import Event, Participant, S
from xplain.people.plan import StoredPlan

Plan = TypeVar("Plan", bound=StoredPlan)
RELEASE = 30
"""Seconds that a killed server may take to release the file."""
LETTERS = "BCDFGHJKLMNPQRSTVWXZ"
"""Alphabet of ids, invitations and completion codes. Texts without vowels are no words, and texts
without digits are no numbers."""
FIXED = """CREATE TRIGGER event_fixed BEFORE UPDATE ON event
BEGIN SELECT RAISE(ABORT, 'events are never changed'); END"""
"""A trigger that forbids changes of events. It is dropped only within the transaction that erases a
participant's data."""
SCHEMA = f"""BEGIN IMMEDIATE;
CREATE TABLE event (
    participant TEXT NOT NULL,          -- random id; "" for events of the server itself
    sequence INTEGER NOT NULL,          -- order of arrival of this participant's, 0 …
    source TEXT NOT NULL,               -- protocol, server, shown, identity, or tab:… (of a page)
    source_sequence INTEGER NOT NULL,   -- order at the source; repeated deliveries are dropped
    kind TEXT NOT NULL,
    wall REAL NOT NULL,                 -- server wall clock, seconds since 1970
    monotonic REAL NOT NULL,            -- server monotonic clock, seconds; comparable within boot
    boot TEXT NOT NULL,
    browser REAL,                       -- the page's performance.now, milliseconds
    payload TEXT NOT NULL,              -- JSON
    state TEXT,                         -- JSON: where the participant is after it; NULL: as before
    number INTEGER PRIMARY KEY,         -- order of arrival of all events, 1 …
    UNIQUE (participant, sequence),
    UNIQUE (participant, source, source_sequence)
) STRICT;
CREATE INDEX event_state ON event (participant) WHERE state IS NOT NULL;
CREATE INDEX event_key ON event (payload ->> 'key') WHERE source = 'identity';
{FIXED};
CREATE TRIGGER event_kept BEFORE DELETE ON event
BEGIN SELECT RAISE(ABORT, 'events are never deleted'); END;
COMMIT;"""
BRIEF = """number IN (SELECT min(number) FROM event GROUP BY participant
UNION SELECT max(number) FROM event GROUP BY participant
UNION SELECT max(number) FROM event WHERE state IS NOT NULL GROUP BY participant
UNION SELECT number FROM event WHERE source = 'identity')"""
"""The first and the latest event of each participant, the latest with a state, and identifiers."""
OVERWRITTEN = "source = 'erased', source_sequence = sequence, browser = NULL, payload = '{}'"
NO_TIME = "wall = 0, monotonic = 0, boot = ''"
NO_KIND = "state = iif(kind = 'erase', state, NULL), kind = iif(kind = 'erase', kind, 'erased')"
PRAGMAS = (
    *("journal_mode=WAL", "synchronous=FULL"),
    "secure_delete=ON",  # erases bytes
)


def letters(count: int) -> str:
    """Draws a random text of LETTERS, which no mail program splits."""
    return "".join(secrets.choice(LETTERS) for _ in range(count))


@dataclass(frozen=True)
class Clock:
    """The server's two clocks, in seconds.

    Attributes:
        wall: seconds since 1970.
        monotonic: seconds that are comparable within one start of the server.
        boot: id of this start.
    """

    wall: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    boot: str = field(default_factory=lambda: secrets.token_hex(8))


class Unknown(Exception):
    """The participant, the talk, the invitation or the key does not exist."""


class Log(Generic[S]):
    """The events of one file. Nothing else is stored, on the disk or in memory. Safe to call from
    several threads."""

    def __init__(
        self, path: Path, kind: type[S], clock: Clock | None = None, patience: float = RELEASE
    ) -> None:
        """Opens or creates the file.

        Args:
            path: path of the file.
            kind: class of the participants' states.
            clock: clock of the events.
            patience: seconds to wait for another process that has the file open.

        Raises:
            XplainError: another process has the file open, or the file is damaged.
        """
        self.path, self.kind, self.clock = path, kind, clock or Clock()
        self._lock = threading.RLock()
        path.parent.mkdir(parents=True, exist_ok=True)
        with ExitStack() as opened:
            file_lock = FileLock(f"{path}.lock", thread_local=False)
            try:
                opened.enter_context(file_lock.acquire(timeout=patience))
            except Timeout:
                wanted = "a free file: another process is using it; a server offers a snapshot"
                raise InputError("database", str(path), wanted) from None
            try:
                self._connection = opened.enter_context(
                    closing(sqlite3.connect(path, isolation_level=None, check_same_thread=False))
                )
                os.chmod(path, 0o600)
                for pragma in PRAGMAS:
                    self._connection.execute(f"PRAGMA {pragma}")
                (verdict,) = self._connection.execute("PRAGMA integrity_check").fetchone()
                if verdict != "ok":
                    raise sqlite3.DatabaseError(f"damaged: {verdict}; restore a backup")
                if not self._connection.execute("SELECT 1 FROM sqlite_master").fetchone():
                    self._connection.executescript(SCHEMA)
                self._connection.execute("SELECT number FROM event LIMIT 1")
            except sqlite3.DatabaseError as error:
                raise InputError("database", str(path), f"cannot be used ({error})") from None
            self._opened = opened.pop_all()

    def close(self) -> None:
        """Closes the file."""
        with self._lock:
            self._opened.close()

    @contextmanager
    def changes(self) -> Iterator[None]:
        """Makes the block a transaction: either all its changes are stored or none. All changes are
        on the disk when the block ends without an error."""
        with self._lock:
            if self._connection.in_transaction:  # part of an open transaction
                yield
                return
            self._connection.execute("BEGIN IMMEDIATE")
            with self._connection:
                yield

    def append(
        self,
        who: str,
        source: str,
        kind: str,
        payload: Mapping[str, Any],
        number: int | None = None,
        browser: float | None = None,
        state: str | None = None,
    ) -> None:
        """Appends an event and the state after it. Appends nothing if the log already has an event
        of this participant and source with this number.

        Args:
            who: id of the participant; "" for events of the server itself.
            source: source of the event, such as "server".
            kind: kind of the event.
            payload: data of the event.
            number: number of the event at its source; None takes the participant's next number.
            browser: time in the browser, in milliseconds.
            state: the state after the event, as JSON; None if the event does not change it.
        """
        sql = "SELECT coalesce(max(sequence) + 1, 0) FROM event WHERE participant = ?"
        (sequence,) = self._connection.execute(sql, (who,)).fetchone()
        text = json.dumps(payload, sort_keys=True, allow_nan=False)
        number = sequence if number is None else number
        now = self.clock.wall(), self.clock.monotonic(), self.clock.boot
        row = (who, sequence, source, number, kind, *now, browser, text, state, None)
        sql = f"INSERT INTO event VALUES ({', '.join('?' * len(row))}) ON CONFLICT DO NOTHING"
        self._connection.execute(sql, row)

    def events(self, where: str = "TRUE", *values: Any) -> Iterator[Event]:
        """Yields events in order of arrival, with decoded payloads."""
        sql = f"SELECT {', '.join(Event._fields)} FROM event WHERE {where} ORDER BY number"
        with self._lock:
            rows = self._connection.execute(sql, values).fetchall()
        for event in map(Event._make, rows):
            yield event._replace(payload=json.loads(str(event.payload)))

    def group_events(self, where: str = "TRUE", *values: Any) -> dict[str, list[Event]]:
        """Returns events by participant, in order, without events of the server itself."""
        own: dict[str, list[Event]] = {}
        for event in self.events(f"participant > '' AND {where}", *values):
            own.setdefault(event.participant, []).append(event)
        return own

    def everybody(self, which: str = "TRUE") -> list[Participant[S]]:
        """Returns all participants whose data is not erased, with their events, in order of
        arrival.

        Args:
            which: the events to read, at least those of :data:`BRIEF`.
        """
        own = self.group_events(which).items()
        return [Participant(i, self.kind, (*e,)) for i, e in own if e[-1].kind != "erase"]

    def find_owner(self, key: str) -> str:
        """Returns the id of the participant with a key among their identifiers, or ""."""
        found = self.events("source = 'identity' AND payload ->> 'key' = ?", key)
        return next((event.participant for event in found), "")

    def snapshot(self, path: Path) -> None:
        """Writes a consistent copy of everything, for exports; ``path`` must not exist."""
        with self._lock:
            self._connection.execute("VACUUM INTO ?", (str(path),))

    def overwrite(self, who: str, what: str, which: str) -> None:
        """Overwrites some of a participant's events permanently."""
        self._connection.execute("DROP TRIGGER event_fixed")
        sql = f"UPDATE event SET {what} WHERE participant = ? AND {which}"
        self._connection.execute(sql, (who,))
        self._connection.execute(FIXED)

    def erase(self, who: str, keep_key: bool = True) -> None:
        """Erases one participant's answers and platform ids.

        The erasure is an event too. The random id and the number of events stay. The keyed hash of
        the invitation or platform id stays too, so that the link creates no new participant.
        """
        with self.changes():
            self.append(who, "server", "erase", {}, state='{"stage": "erased"}')
            self.overwrite(who, f"{NO_TIME}, {NO_KIND}, {OVERWRITTEN}", "source != 'identity'")
            kept = "json_patch('{}', json_object('key', payload ->> 'key'))" if keep_key else "'{}'"
            self.overwrite(who, f"{NO_TIME}, payload = {kept}", "source = 'identity'")
        with self._lock:
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._connection.execute("VACUUM")


def backup(database: Path, file: Path) -> None:
    """Copies a database and its key. The server may have the database open.

    Raises:
        InputError: the database does not exist, its key is missing, or the target exists.
    """
    key = Path(f"{database}.key")
    if not database.is_file() or not key.is_file():
        raise InputError("database", str(database), f"a database with {key.name} beside it")
    if file.exists():
        raise InputError("file", str(file), "a new file")
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(file)) as copy:
        source.backup(copy)
    Path(f"{file}.key").write_bytes(key.read_bytes())
    for path in (file, Path(f"{file}.key")):
        path.chmod(0o600)


def read_plan(path: Path, kind: type[Plan]) -> Plan | None:
    """Reads the plan in a database, which its server may have open; None if there is no plan yet.

    Raises:
        InputError: the file is not a study's database.
    """
    if not path.exists() or not path.stat().st_size:
        return None
    try:
        with closing(
            sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
        ) as connection:
            found = connection.execute("SELECT payload FROM event WHERE kind = 'plan'").fetchone()
    except sqlite3.DatabaseError as error:
        raise InputError("database", str(path), f"not a study's database ({error})") from None
    return kind.from_text(json.loads(found[0])["plan"]) if found else None


def read(path: Path, plan: type[Plan], state: type[S]) -> tuple[Plan, list[Participant[S]]]:
    """Reads the plan, and all participants whose data is not erased, with their events, in order of
    arrival. The file must be a snapshot, or a database that no server has open.

    Raises:
        InputError: the file is not a database with a plan of this kind.
    """
    if not path.is_file() or (found := read_plan(path, plan)) is None:
        raise InputError("database", str(path), f"a database in which {plan.OF} was started")
    with closing(Log(path, state, patience=0)) as log:
        return found, log.everybody()
