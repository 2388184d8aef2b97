"""The database file, and the log of events in it: opened by one process, through one locked
connection.

What is acknowledged is on the disk (WAL, ``synchronous=FULL``).
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import re
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from xplain.errors import InputError, Refused, XplainError

Do = Callable[..., sqlite3.Cursor]
"""Executes a statement within a transaction."""
RELEASE = 30
"""Seconds in which a server that was just killed lets go: its worker looks for it every few."""
MAX_TAB_EVENTS = 5000
"""Events of a participant's pages that are kept; a study page makes a few dozen."""


def boot_id() -> str:
    """Within one of these the monotonic clock can be compared."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return f"process-{os.getpid()}-{secrets.token_hex(4)}"


@dataclass(frozen=True)
class Clock:
    """The server's two clocks, in seconds."""

    wall: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    boot: str = field(default_factory=boot_id)


class Unknown(Exception):
    """No such participant, invitation or key."""


class Gone(Exception):
    """The data of this participant was erased."""


class Database:
    """The open file. Safe to use from several threads."""

    def __init__(self, path: Path, clock: Clock | None = None) -> None:
        """Opens or creates it.

        Raises:
            XplainError: another process has it open, or it is broken.
        """
        self.path, self.clock = path, clock or Clock()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file_lock = FileLock(f"{path}.lock", thread_local=False)
        try:
            self._file_lock.acquire(timeout=RELEASE)
        except Timeout:
            raise XplainError(f"database={path}: another process is using it") from None
        with ExitStack() as opened:
            opened.callback(self._file_lock.release)
            self._lock = threading.RLock()
            try:
                self._connection = opened.enter_context(
                    closing(sqlite3.connect(path, isolation_level=None, check_same_thread=False))
                )
                os.chmod(path, 0o600)
                self._connection.row_factory = sqlite3.Row
                for pragma in (
                    *("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"),
                    # Deletions that REPLACE makes meet the triggers, and what is erased is gone.
                    *("recursive_triggers=ON", "secure_delete=ON"),
                ):
                    self._connection.execute(f"PRAGMA {pragma}")
                self._check()
                started = bool(self.query("SELECT 1 FROM meta WHERE key = 'plan'"))
                self.secret = _secret(path, started)
            except sqlite3.DatabaseError as error:
                raise InputError("database", str(path), f"cannot be used ({error})") from None
            opened.pop_all()  # it can be used: all stays open until it is closed

    def _check(self) -> None:
        (verdict,) = self._connection.execute("PRAGMA integrity_check").fetchone()
        if verdict != "ok":
            raise InputError("database", str(self.path), f"damaged: {verdict}; restore a backup")
        if not self.query("SELECT 1 FROM sqlite_master"):
            schema = (
                files("xplain.people.server").joinpath("schema.sql").read_text(encoding="utf-8")
            )
            # One script, one transaction: a database exists whole or not at all.
            self._connection.executescript(f"BEGIN IMMEDIATE;\n{schema}\nCOMMIT;")

    def close(self) -> None:
        """Lets go of the file."""
        with self._lock:
            self._connection.close()
        self._file_lock.release()

    @contextmanager
    def transaction(self) -> Iterator[Do]:
        """All or nothing; on the disk when it is left without an error."""
        with self._lock:
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection.execute
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> list[dict[str, Any]]:
        """Rows of a reading query."""
        with self._lock:
            return [dict(row) for row in self._connection.execute(sql, parameters)]

    def snapshot(self, path: Path) -> None:
        """A consistent copy of everything, for exports; ``path`` must not exist."""
        with self._lock:
            self._connection.execute("VACUUM INTO ?", (str(path),))

    def erase(self, reference: str) -> None:
        """Erases everything that one participant did or said, and their outside ids.

        The random id and the number of their events stay. The keyed hash of their outside id stays,
        so that their link makes nobody new. The erasure is an event of its own.

        Args:
            reference: as the participant was given it; what is no hexadecimal digit is left out.

        Raises:
            InputError: no such participant, or erased before.
        """
        given = "".join(re.findall(r"[0-9a-f]", reference.lower()))
        ids = [row["id"] for row in self.query("SELECT id FROM participant WHERE NOT erased")]
        who = next((one for one in ids if self.reference(one) == given), None)
        if who is None:
            raise InputError("reference", reference, "the reference of a participant")
        with self.transaction() as do:
            do("INSERT INTO meta VALUES ('erasing', ?)", (who,))
            self.record(do, who, "server", None, "erase", {}, state='{"stage": "erased"}')
            do(
                "UPDATE event SET kind = iif(kind = 'erase', kind, 'erased'), source = 'erased', "
                "source_sequence = sequence, wall = 0, monotonic = 0, boot = '', browser = NULL, "
                "payload = '{}', state = iif(kind = 'erase', state, NULL) WHERE participant = ?",
                (who,),
            )
            do(
                "UPDATE participant SET session = NULL, kept = '{}', code = '', erased = 1 "
                "WHERE id = ?",
                (who,),
            )
            do("DELETE FROM meta WHERE key = 'erasing'")
        with self._lock:
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._connection.execute("VACUUM")

    def forget_visit(self, do: Do, who: str) -> None:
        """Keeps of somebody who declined that they came and declined, and when: no outside id, and
        nothing that their page reported."""
        do("INSERT INTO meta VALUES ('erasing', ?)", (who,))
        do(
            "UPDATE event SET kind = 'erased', source = 'erased', source_sequence = sequence, "
            "browser = NULL, payload = '{}' WHERE participant = ? "
            "AND (source = 'shown' OR source LIKE 'tab:%')",
            (who,),
        )
        do(
            "UPDATE event SET payload = json_remove(payload, '$.width') WHERE participant = ? "
            "AND source != 'erased'",
            (who,),
        )
        gone = "external = NULL, session = NULL, kept = '{}'"
        do(f"UPDATE participant SET {gone} WHERE id = ?", (who,))
        do("DELETE FROM meta WHERE key = 'erasing'")

    # The log of events -------------------------------------------------------------------------

    def log(self, who: str) -> list[dict[str, Any]]:
        """A participant's events in order, payloads decoded."""
        sql = "SELECT * FROM event WHERE participant = ? ORDER BY sequence"
        return [row | {"payload": json.loads(row["payload"])} for row in self.query(sql, (who,))]

    def was_shown(self, who: str, sequence: int) -> bool:
        """Whether the page with this number was rendered."""
        query = "SELECT 1 FROM event WHERE participant = ? AND source = 'shown' AND"
        return bool(self.query(f"{query} source_sequence = ?", (who, sequence)))

    def shown(self, who: str, sequence: int, stage: str) -> None:
        """Notes that a page was rendered for the first time."""
        # Most repeats are reloads; they need no transaction.
        if not self.was_shown(who, sequence):
            with self.transaction() as do:
                self.record(do, who, "shown", sequence, "shown", {"stage": stage})

    def from_tab(
        self, who: str, tab: str, items: Sequence[tuple[int, str, float, dict[str, Any]]]
    ) -> None:
        """Keeps a page's own events (number, kind, ms, payload); repeats are dropped.

        Raises:
            Unknown, Refused: too many.
        """
        with self.transaction() as do:
            row = do(
                "SELECT count(*) AS c, (SELECT id FROM participant WHERE id = ?) AS id FROM event "
                "WHERE participant = ? AND source LIKE 'tab:%'",
                (who, who),
            ).fetchone()
            if row["id"] is None:
                raise Unknown
            if row["c"] + len(items) > MAX_TAB_EVENTS:
                raise Refused("too_much")
            for number, kind, browser, payload in items:
                self.record(do, who, f"tab:{tab}", number, kind, payload, browser)

    def record(
        self,
        do: Do,
        who: str,
        source: str,
        source_sequence: int | None,
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None = None,
        state: str | None = None,
    ) -> None:
        """Appends an event, with the state that it leads to, unless its source sent it before;
        ``None`` numbers it here."""
        (sequence,) = do(
            "SELECT coalesce(max(sequence) + 1, 0) FROM event WHERE participant = ?", (who,)
        ).fetchone()
        number = sequence if source_sequence is None else source_sequence
        now = self.clock.wall(), self.clock.monotonic(), self.clock.boot
        text = json.dumps(payload, sort_keys=True)
        event = (who, sequence, source, number, kind, *now, browser, text, state)
        do(
            f"INSERT INTO event VALUES (NULL, {', '.join('?' * len(event))}) "
            "ON CONFLICT (participant, source, source_sequence) DO NOTHING",
            event,
        )

    def reference(self, who: str) -> str:
        """What a participant is given to have their data erased: nobody can make it from the id,
        which published data have."""
        return self.keyed("reference", who)[:16]

    def keyed(self, *parts: str) -> str:
        """A hash of texts that are only ever looked up (invitations, outside ids): nobody without
        the server's secret can make or reverse it."""
        message = "\x1f".join(parts).encode(errors="replace")
        return hmac.new(self.secret, message, hashlib.sha256).hexdigest()


def _secret(path: Path, started: bool) -> bytes:
    """The server's secret, in a file of its own beside the database, for its owner only.

    Raises:
        InputError: something was started in the database, and its secret is lost.
    """
    file = path.with_name(path.name + ".key")
    if started and not file.exists():
        wanted = f"a database with its key beside it: {file.name} is missing, restore it"
        raise InputError("database", str(path), wanted)
    try:
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return file.read_bytes()
    with os.fdopen(handle, "wb") as out:
        secret = secrets.token_bytes(32)
        out.write(secret)
        out.flush()
        os.fsync(out.fileno())
    return secret
