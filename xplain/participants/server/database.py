"""The study's database file: opened by one process, through one locked connection.

What is acknowledged is on the disk (WAL, ``synchronous=FULL``).
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from xplain.errors import InputError, XplainError

Do = Callable[..., sqlite3.Cursor]
"""Executes a statement within a transaction."""


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


class Database:
    """The open file. Safe to use from several threads."""

    def __init__(self, path: Path) -> None:
        """Opens or creates it.

        Raises:
            XplainError: another process has it open, or it is broken.
        """
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        # A server that was just killed may take a moment to let go.
        self._file_lock = FileLock(f"{path}.lock", thread_local=False)
        try:
            self._file_lock.acquire(timeout=5)
        except Timeout:
            raise XplainError(f"database={path}: another process is using it") from None
        try:
            self.secret = _secret(path)
            self._lock = threading.RLock()
            self._connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            os.chmod(path, 0o600)
            self._connection.row_factory = sqlite3.Row
            for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
                self._connection.execute(f"PRAGMA {pragma}")
            self._check()
        except sqlite3.DatabaseError as error:
            self._file_lock.release()
            raise InputError("database", str(path), f"cannot be used ({error})") from None
        except BaseException:
            self._file_lock.release()
            raise

    def _check(self) -> None:
        (verdict,) = self._connection.execute("PRAGMA integrity_check").fetchone()
        if verdict != "ok":
            raise InputError("database", str(self.path), f"damaged: {verdict}; restore a backup")
        if not self.query("SELECT 1 FROM sqlite_master"):
            schema = (
                files("xplain.participants.server")
                .joinpath("schema.sql")
                .read_text(encoding="utf-8")
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

    def keyed(self, *parts: str) -> str:
        """A hash of texts that are only ever looked up (invitations, outside ids): nobody without
        the server's secret can make or reverse it."""
        message = "\x1f".join(parts).encode(errors="replace")
        return hmac.new(self.secret, message, hashlib.sha256).hexdigest()


def _secret(path: Path) -> bytes:
    """The server's secret, in a file of its own beside the database, for its owner only."""
    file = path.with_name(path.name + ".key")
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
