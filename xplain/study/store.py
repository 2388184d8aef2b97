"""The study's memory: one SQLite file, one process, one locked connection.

What is acknowledged is on the disk (WAL, ``synchronous=FULL``). Every change happens in one
transaction: the event, the participant's state, the slot, the policy's step. An event that comes
twice is stored once.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from xplain.errors import InputError, XplainError
from xplain.randomness import stream
from xplain.study import protocol
from xplain.study.plan import Study, StudyPlan
from xplain.study.protocol import Refused, State

STREAMS = ("person", "pilot", "bot")
MAX_TAB_EVENTS = 5000
"""Events of a participant's pages that are kept; a study page makes a few dozen."""


class Full(Refused):
    """No slot is free now."""


class Unknown(Exception):
    """No such participant, invitation or key."""


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


@dataclass(frozen=True)
class Participant:
    """A participant as the pages need it."""

    id: str
    stream: str
    state: State
    code: str


def read_plan(path: Path) -> StudyPlan | None:
    """The plan in a database; None where there is none yet.

    Raises:
        InputError: the file is no study's database.
    """
    if not path.exists() or not path.stat().st_size:
        return None
    try:
        with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as connection:
            row = connection.execute("SELECT value FROM meta WHERE key = 'plan'").fetchone()
    except sqlite3.DatabaseError as error:
        raise InputError("database", str(path), f"not a study's database ({error})") from None
    return row and StudyPlan.from_text(row[0])


class Store:
    """Everything the server knows. Safe to call from several threads."""

    def __init__(self, path: Path, study: Study, clock: Clock | None = None) -> None:
        """Opens or creates the database.

        Raises:
            XplainError: another process has it open, it belongs to another plan, or it is broken.
        """
        self.path, self.study, self.clock = path, study, clock or Clock()
        path.parent.mkdir(parents=True, exist_ok=True)
        # A server that was just killed may take a moment to let go.
        self._file_lock = FileLock(f"{path}.lock", thread_local=False)
        try:
            self._file_lock.acquire(timeout=5)
        except Timeout:
            raise XplainError(f"database={path}: another process is using it") from None
        try:
            self._key = _key(path)
            self._lock = threading.RLock()
            self._connection = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            os.chmod(path, 0o600)
            self._connection.row_factory = sqlite3.Row
            for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
                self._connection.execute(f"PRAGMA {pragma}")
            self._open()
        except sqlite3.DatabaseError as error:
            self._file_lock.release()
            raise InputError("database", str(path), f"cannot be used ({error})") from None
        except BaseException:
            self._file_lock.release()
            raise

    def _open(self) -> None:
        (verdict,) = self._connection.execute("PRAGMA integrity_check").fetchone()
        if verdict != "ok":
            raise InputError("database", str(self.path), f"damaged: {verdict}; restore a backup")
        tables = self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if not tables:
            schema = files("xplain.study").joinpath("schema.sql").read_text(encoding="utf-8")
            # One script, one transaction: a database exists whole or not at all.
            self._connection.executescript(f"BEGIN IMMEDIATE;\n{schema}\nCOMMIT;")
        with self._transaction() as do:
            row = do("SELECT value FROM meta WHERE key = 'plan'").fetchone()
            if row is None:
                do("INSERT INTO meta VALUES ('plan', ?)", (self.study.plan.text,))
                do("INSERT INTO meta VALUES ('plan_hash', ?)", (self.study.plan.hash,))
                for block in range(self.study.plan.rules.per_cell):
                    self._add_block(do, "person", block)
            elif row[0] != self.study.plan.text:
                raise InputError("database", str(self.path), "belongs to another study plan")

    def close(self) -> None:
        """Lets go of the file."""
        with self._lock:
            self._connection.close()
        self._file_lock.release()

    @contextmanager
    def _transaction(self) -> Iterator[Callable[..., sqlite3.Cursor]]:
        with self._lock:
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._connection.execute
            except BaseException:
                self._connection.execute("ROLLBACK")
                raise
            self._connection.execute("COMMIT")

    # Entry and keys ----------------------------------------------------------------------------

    def keyed(self, *parts: str) -> str:
        """A keyed hash: nobody without the server's key can make or reverse it."""
        message = "\x1f".join(parts).encode()
        return hmac.new(self._key, message, hashlib.sha256).hexdigest()

    def invite(self, count: int, stream_name: str) -> list[str]:
        """New invitation tokens, shown once: only their keyed hashes are stored."""
        if stream_name not in STREAMS:
            raise InputError("stream", stream_name, ", ".join(STREAMS))
        tokens = [secrets.token_urlsafe(12) for _ in range(count)]
        with self._transaction() as do:
            for token in tokens:
                do(
                    "INSERT INTO invitation VALUES (?, ?, NULL)",
                    (self.keyed("token", token), stream_name),
                )
        return tokens

    def enter_invited(self, token: str) -> str:
        """The participant of an invitation, made at its first use.

        Raises:
            Unknown: no such token.
        """
        hashed = self.keyed("token", token)
        with self._transaction() as do:
            row = do("SELECT * FROM invitation WHERE token = ?", (hashed,)).fetchone()
            if row is None:
                raise Unknown
            if row["participant"]:
                return self._resume(do, row["participant"])
            who = self._enter(do, row["stream"], "invitation", None, None, {})
            do("UPDATE invitation SET participant = ? WHERE token = ?", (who, hashed))
            return who

    def enter_prolific(self, person: str, study: str, session: str, keep: bool) -> str:
        """The participant of a recruiting platform's ids, made at their first use.

        Raises:
            Unknown: this person came before, in another session.
        """
        external, hashed = (
            self.keyed("prolific", person, study),
            self.keyed("session", session),
        )
        with self._transaction() as do:
            row = do("SELECT * FROM participant WHERE external = ?", (external,)).fetchone()
            if row is None:
                ids = {"PROLIFIC_PID": person, "STUDY_ID": study, "SESSION_ID": session}
                return self._enter(do, "person", "prolific", external, hashed, ids if keep else {})
            if row["session"] != hashed:
                raise Unknown
            return self._resume(do, row["id"])

    def enter_open(self) -> str:
        """A new participant without an invitation, where the config allows it."""
        with self._transaction() as do:
            return self._enter(do, "pilot", "open", None, None, {})

    def _enter(
        self,
        do: Callable[..., sqlite3.Cursor],
        stream_name: str,
        entry: str,
        external: str | None,
        session: str | None,
        kept: Mapping[str, str],
    ) -> str:
        who, now = secrets.token_hex(8), self.clock.wall()
        code = secrets.token_hex(4).upper()
        do(
            "INSERT INTO participant VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?, 0, ?, ?)",
            (
                who,
                stream_name,
                entry,
                external,
                session,
                json.dumps(kept),
                now,
                now,
                State().text,
                code,
            ),
        )
        self._record(do, who, "server", None, "enter", {"entry": entry})
        return who

    def _resume(self, do: Callable[..., sqlite3.Cursor], who: str) -> str:
        self._record(do, who, "server", None, "resume", {})
        return who

    # The participant's way ---------------------------------------------------------------------

    def participant(self, who: str) -> Participant:
        """Raises Unknown."""
        with self._lock:
            row = self._connection.execute(
                "SELECT id, stream, state, code FROM participant WHERE id = ?", (who,)
            ).fetchone()
        if row is None:
            raise Unknown
        return Participant(row["id"], row["stream"], State.from_text(row["state"]), row["code"])

    def submit(
        self,
        who: str,
        sequence: int,
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None = None,
    ) -> State:
        """Accepts an answer, once.

        Args:
            who: the participant.
            sequence: of the answer, ``state.accepted`` of the page that it was given on. A
                smaller number was accepted before: nothing happens.
            kind, payload: for the protocol.
            browser: the page's ``performance.now``, ms.

        Returns:
            The state to go on with; on the disk when this returns.

        Raises:
            Unknown, Refused.
        """
        with self._transaction() as do:
            row = do("SELECT * FROM participant WHERE id = ?", (who,)).fetchone()
            if row is None:
                raise Unknown
            state = State.from_text(row["state"])
            if sequence < state.accepted:
                return state
            if sequence > state.accepted:
                raise Refused("This page is not yours to answer yet.")
            if state.over:
                return state
            if kind == "consent" and payload.get("agree"):
                self._time_out_stale(do)
                payload = {**payload, **self._reserve(do, row)}
            return self._accept(do, who, state, kind, payload, browser)

    def _accept(
        self,
        do: Callable[..., sqlite3.Cursor],
        who: str,
        state: State,
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None,
    ) -> State:
        outcome = protocol.advance(self.study, state, kind, payload)
        after = outcome.state
        self._record(do, who, "protocol", state.accepted, kind, payload, browser)
        if answer := outcome.answer:
            do(
                "UPDATE step SET labels = ?, belief_after = ? WHERE participant = ? AND k = ?",
                (json.dumps(answer.labels), json.dumps(answer.belief), who, answer.step),
            )
        if decision := outcome.decision:
            do(
                "INSERT INTO step VALUES (?, ?, ?, ?, ?, ?, NULL, NULL)",
                (
                    who,
                    decision.step,
                    json.dumps(decision.belief),
                    decision.given,
                    decision.messages,
                    json.dumps({str(mask): v for mask, v in decision.values.items()}),
                ),
            )
        do(
            "UPDATE participant SET state = ?, over = ? WHERE id = ?",
            (after.text, after.over, who),
        )
        if after.stage == "done":
            do("UPDATE slot SET used = 1 WHERE holder = ?", (who,))
        elif after.over:
            do("UPDATE slot SET holder = NULL WHERE holder = ?", (who,))
        return after

    def shown(self, who: str, sequence: int, stage: str) -> None:
        """Notes that a page was rendered for the first time."""
        with self._lock:
            # Most repeats are reloads; they need no transaction.
            known = self._connection.execute(
                "SELECT 1 FROM event WHERE participant = ? AND source = 'shown' "
                "AND source_sequence = ?",
                (who, sequence),
            ).fetchone()
            if not known:
                with self._transaction() as do:
                    self._record(do, who, "shown", sequence, "shown", {"stage": stage})

    def from_tab(
        self, who: str, tab: str, items: Sequence[tuple[int, str, float, dict[str, Any]]]
    ) -> None:
        """Keeps a page's own events (number, kind, ms, payload); repeats are dropped.

        Raises:
            Unknown, Refused: too many.
        """
        with self._transaction() as do:
            row = do(
                "SELECT count(*) AS c, (SELECT id FROM participant WHERE id = ?) AS id FROM event "
                "WHERE participant = ? AND source LIKE 'tab:%'",
                (who, who),
            ).fetchone()
            if row["id"] is None:
                raise Unknown
            if row["c"] + len(items) > MAX_TAB_EVENTS:
                raise Refused("Too many events from this page.")
            for number, kind, browser, payload in items:
                self._record(do, who, f"tab:{tab}", number, kind, payload, browser)

    def _record(
        self,
        do: Callable[..., sqlite3.Cursor],
        who: str,
        source: str,
        source_sequence: int | None,
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None = None,
    ) -> None:
        """Appends an event unless its source sent it before; ``None`` numbers it here."""
        (sequence,) = do(
            "SELECT coalesce(max(sequence) + 1, 0) FROM event WHERE participant = ?", (who,)
        ).fetchone()
        now = self.clock.wall()
        do(
            "INSERT INTO event VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?) "
            "ON CONFLICT (participant, source, source_sequence) DO NOTHING",
            (
                who,
                sequence,
                source,
                sequence if source_sequence is None else source_sequence,
                kind,
                now,
                self.clock.monotonic(),
                self.clock.boot,
                browser,
                json.dumps(payload, sort_keys=True),
            ),
        )
        do("UPDATE participant SET seen = ? WHERE id = ?", (now, who))

    # Slots -------------------------------------------------------------------------------------

    def _add_block(
        self, do: Callable[..., sqlite3.Cursor], stream_name: str, block: int
    ) -> None:
        """One more permuted block: every (type, condition) once, in a seeded order."""
        cells = self.study.plan.cells
        order = stream(self.study.plan.seed, "slots", stream_name, block).permutation(len(cells))
        for i, cell in enumerate(order):
            user_type, condition = cells[cell]
            do(
                "INSERT INTO slot VALUES (?, ?, ?, ?, NULL, 0)",
                (stream_name, block * len(cells) + i, user_type, condition),
            )

    def _reserve(self, do: Callable[..., sqlite3.Cursor], row: sqlite3.Row) -> dict[str, Any]:
        """Takes the first free slot; draws the orders of questions."""
        own, plan = row["stream"], self.study.plan
        free = (
            "SELECT * FROM slot WHERE stream = ? AND holder IS NULL AND used = 0 "
            "ORDER BY position LIMIT 1"
        )
        slot = do(free, (own,)).fetchone()
        if slot is None:
            if own == "person":
                raise Full("All places are taken at the moment.")
            (taken,) = do("SELECT count(*) FROM slot WHERE stream = ?", (own,)).fetchone()
            self._add_block(do, own, taken // len(plan.cells))
            slot = do(free, (own,)).fetchone()
        do(
            "UPDATE slot SET holder = ? WHERE stream = ? AND position = ?",
            (row["id"], own, slot["position"]),
        )
        role = plan.roles[slot["user_type"]]
        rng = stream(plan.seed, "orders", own, row["number"])
        orders = {
            name: rng.permutation(len(items)).tolist()
            for name, items in (("eligibility", role.eligibility), ("quiz", role.quiz))
        }
        return {
            "position": slot["position"],
            "user_type": slot["user_type"],
            "condition": slot["condition"],
            "orders": orders,
        }

    def time_out_stale(self) -> int:
        """Ends the part of everybody silent for too long; returns how many."""
        with self._transaction() as do:
            return self._time_out_stale(do)

    def _time_out_stale(self, do: Callable[..., sqlite3.Cursor]) -> int:
        limit = self.clock.wall() - 60 * self.study.plan.rules.timeout_minutes
        stale = do(
            "SELECT id, state FROM participant WHERE over = 0 AND seen < ?", (limit,)
        ).fetchall()
        for row in stale:
            self._accept(do, row["id"], State.from_text(row["state"]), "time_out", {}, None)
        return len(stale)

    # For the researcher ------------------------------------------------------------------------

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> list[dict[str, Any]]:
        """Rows of a reading query."""
        with self._lock:
            return [dict(row) for row in self._connection.execute(sql, parameters)]

    def snapshot(self, path: Path) -> None:
        """A consistent copy of everything, for exports; ``path`` must not exist."""
        with self._lock:
            self._connection.execute("VACUUM INTO ?", (str(path),))


def _key(path: Path) -> bytes:
    """The server's secret, in a file of its own beside the database, for its owner only."""
    file = path.with_name(path.name + ".key")
    try:
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return file.read_bytes()
    with os.fdopen(handle, "wb") as out:
        key = secrets.token_bytes(32)
        out.write(key)
        out.flush()
        os.fsync(out.fileno())
    return key
