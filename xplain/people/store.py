"""The server's memory of its participants: a log of events in one file, opened by one process.

Every change is one event, with the state that it leads to. An event that comes twice is stored
once, and what is acknowledged is on the disk (WAL, ``synchronous=FULL``).
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
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

from xplain.errors import InputError, Refused, XplainError, one_of
from xplain.people.export import STREAMS, participants, replayed
from xplain.people.flow import Conflict, Flow, Participant, People, State

Do = Callable[..., sqlite3.Cursor]
"""Executes a statement within a transaction."""
RELEASE = 30
"""Seconds in which a server that was just killed lets go: its worker looks for it every few."""
MAX_TAB_EVENTS = 5000
"""Events of a participant's pages that are kept; a study page makes a few dozen."""
LATEST = 8
"""Participants whose events are taken once more at a start: enough to notice changed code."""
LETTERS = "BCDFGHJKLMNPQRSTVWXZ"
"""Of ids, invitations and completion codes: no vowels, so no words, and no digits,
which look like a number."""
DURABLE = ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON")
ERASED = ("recursive_triggers=ON", "secure_delete=ON")
"""Deletions that REPLACE makes meet the triggers, and what is erased is gone."""
OVERWRITTEN = "source = 'erased', source_sequence = sequence, browser = NULL, payload = '{}'"


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


def _letters(count: int) -> str:
    """A random text that nothing reads as a word or a number, and no mail program cuts."""
    return "".join(secrets.choice(LETTERS) for _ in range(count))


class Store:
    """Everything the server knows. Safe to call from several threads."""

    def __init__(
        self, path: Path, flow: Flow[Any, Any] | None = None, clock: Clock | None = None
    ) -> None:
        """Opens or creates the database, to run a flow in it; None only to erase somebody.

        Raises:
            XplainError: another process has it open, it belongs to another plan, or it is broken.
        """
        self.path, self.clock = path, clock or Clock()
        self._flow, self._signs = flow, dict[str, float]()
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
                for pragma in (*DURABLE, *ERASED):
                    self._connection.execute(f"PRAGMA {pragma}")
                self._check()
            except sqlite3.DatabaseError as error:
                raise InputError("database", str(path), f"cannot be used ({error})") from None
            opened.pop_all()  # it can be used: all stays open until it is closed

    def _check(self) -> None:
        (verdict,) = self._connection.execute("PRAGMA integrity_check").fetchone()
        if verdict != "ok":
            raise InputError("database", str(self.path), f"damaged: {verdict}; restore a backup")
        if not self.query("SELECT 1 FROM sqlite_master"):
            schema = files("xplain.people").joinpath("schema.sql").read_text(encoding="utf-8")
            # One script, one transaction: a database exists whole or not at all.
            self._connection.executescript(f"BEGIN IMMEDIATE;\n{schema}\nCOMMIT;")
        stored = self.query("SELECT value FROM meta WHERE key = 'plan'")
        self.secret = _secret(self.path, bool(stored))
        if self._flow is None:
            return
        if not stored:
            with self.transaction() as do:
                do("INSERT INTO meta VALUES ('plan', ?)", (self.flow.plan.text,))
        elif stored[0]["value"] != self.flow.plan.text:
            raise InputError("database", str(self.path), "another one: it belongs to another plan")
        latest = participants(self._connection, self.flow.STATE)[-LATEST:]
        if differences := replayed(self.flow, latest):
            raise XplainError(
                "database: this version of xplain decides differently from the one that started "
                f"{self.flow.plan.OF} in it; go on and replay with that version, or start anew in "
                f"another database ({differences[0]})"
            )

    @property
    def flow(self) -> Flow[Any, Any]:
        """That runs in it."""
        assert self._flow is not None, "opened only to erase somebody"
        return self._flow

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

    def people(self, where: str = "1", *parameters: Any) -> list[Participant[Any]]:
        """Participants with their present states, in the order in which they came."""
        rows = self.query(f"SELECT * FROM seen WHERE {where} ORDER BY number", parameters)
        return [Participant(row, self.flow.STATE.from_text(row["state"])) for row in rows]

    def snapshot(self, path: Path) -> None:
        """A consistent copy of everything, for exports; ``path`` must not exist."""
        with self._lock:
            self._connection.execute("VACUUM INTO ?", (str(path),))

    # Erasing -----------------------------------------------------------------------------------

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
            self.record(do, who, "server", None, "erase", {}, state='{"stage": "erased"}')
            self._overwrite(
                do,
                who,
                f"{OVERWRITTEN}, wall = 0, monotonic = 0, boot = '', "
                "state = iif(kind = 'erase', state, NULL), "
                "kind = iif(kind = 'erase', kind, 'erased')",
                "TRUE",
            )
            gone = "session = NULL, kept = '{}', code = '', erased = 1"
            do(f"UPDATE participant SET {gone} WHERE id = ?", (who,))
        with self._lock:
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self._connection.execute("VACUUM")
        if self._flow:
            self._flow.forget()

    def _forget_visit(self, do: Do, who: str) -> None:
        """Keeps of somebody who declined that they came and declined, and when: no outside id, and
        nothing that their page reported."""
        reported = "(source = 'shown' OR source LIKE 'tab:%')"
        self._overwrite(do, who, f"{OVERWRITTEN}, kind = 'erased'", reported)
        kept = "payload = json_remove(payload, '$.width')"
        self._overwrite(do, who, kept, "source != 'erased'")
        gone = "external = NULL, session = NULL, kept = '{}'"
        do(f"UPDATE participant SET {gone} WHERE id = ?", (who,))

    def _overwrite(self, do: Do, who: str, what: str, which: str) -> None:
        """Changes some of a participant's events, which the schema allows only here."""
        do("INSERT INTO meta VALUES ('erasing', ?)", (who,))
        do(f"UPDATE event SET {what} WHERE participant = ? AND {which}", (who,))
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
        self.participant(who)
        with self.transaction() as do:
            count = "SELECT count(*) FROM event WHERE participant = ? AND source LIKE 'tab:%'"
            (kept,) = do(count, (who,)).fetchone()
            if kept + len(items) > MAX_TAB_EVENTS:
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
        next_one = "SELECT coalesce(max(sequence) + 1, 0) FROM event WHERE participant = ?"
        (sequence,) = do(next_one, (who,)).fetchone()
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

    # Entry -------------------------------------------------------------------------------------

    def invite(self, count: int, stream_name: str) -> list[str]:
        """New invitation tokens, shown once: only their keyed hashes are stored."""
        one_of("stream", stream_name, STREAMS)
        tokens = [_letters(18) for _ in range(count)]
        with self.transaction() as do:
            for token in tokens:
                row = (self.keyed("token", token), stream_name)
                do("INSERT INTO invitation VALUES (?, ?, NULL)", row)
        return tokens

    def enter_invited(self, token: str) -> str:
        """The participant of an invitation, made at its first use.

        Raises:
            Unknown: no such token.
            Gone: their data was erased.
        """
        hashed = self.keyed("token", token)
        with self.transaction() as do:
            row = do("SELECT * FROM invitation WHERE token = ?", (hashed,)).fetchone()
            if row is None:
                raise Unknown
            if who := row["participant"]:
                return self._resume(do, who)
            who = self._enter(do, row["stream"], "invitation")
            do("UPDATE invitation SET participant = ? WHERE token = ?", (who, hashed))
            return who

    def enter_from_platform(self, ids: Mapping[str, str], keep: bool) -> str:
        """The participant of a recruiting platform's ids, made at their first use. A person is one
        participant, whatever study or session the link names.

        Args:
            ids: of a person, of a study and of a session, by their names; the last two may lack.
            keep: whether they are stored in clear.

        Raises:
            Unknown: this person consented before, in another session.
            Gone: their data was erased.
        """
        person, _, session = (*ids.values(), "", "")[:3]
        external, hashed = self.keyed("platform", person), self.keyed("session", session)
        with self.transaction() as do:
            known = self.people("external = ?", external)
            if not known:
                return self._enter(do, "person", "platform", external, hashed, ids if keep else {})
            (one,) = known
            if one.row["session"] != hashed and not one.row["erased"]:
                if one.state.stage != "consent":
                    raise Unknown
                do("UPDATE participant SET session = ? WHERE id = ?", (hashed, one.id))
            return self._resume(do, one.id)

    def enter_preview(self, cell: int) -> str:
        """A pilot whose part of the plan the researcher chose, not chance.

        Raises:
            Refused: the flow has no such cell.
        """
        if not 0 <= cell < len(self.flow.cells):
            raise Refused("not_understood")
        with self.transaction() as do:
            return self._enter(do, "pilot", "preview", cell=cell)

    def enter_open(self) -> str:
        """A new participant without an invitation, where the config allows it."""
        with self.transaction() as do:
            return self._enter(do, "pilot", "open")

    def _enter(
        self,
        do: Do,
        stream_name: str,
        entry: str,
        external: str | None = None,
        session: str | None = None,
        kept: Mapping[str, str] | None = None,
        cell: int | None = None,
    ) -> str:
        who, ids, code = _letters(14).lower(), json.dumps(kept or {}), _letters(8)
        row = (who, stream_name, entry, external, session, ids, code)
        do("INSERT INTO participant VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, 0)", row)
        about = {"entry": entry, "stream": stream_name}
        first = self.flow.STATE(cell=cell).text
        self.record(do, who, "server", None, "enter", about, state=first)
        return who

    def _resume(self, do: Do, who: str) -> str:
        if do("SELECT erased FROM participant WHERE id = ?", (who,)).fetchone()["erased"]:
            raise Gone
        self.record(do, who, "server", None, "resume", {})
        return who

    @property
    def paused(self) -> bool:
        """Whether nobody new is let in."""
        return bool(self.query("SELECT 1 FROM meta WHERE key = 'paused'"))

    def pause(self, on: bool) -> None:
        """Lets nobody new in, or lets them in again. Who has begun goes on."""
        insert = "INSERT INTO meta VALUES ('paused', '1') ON CONFLICT DO NOTHING"
        with self.transaction() as do:
            do(insert if on else "DELETE FROM meta WHERE key = 'paused'")

    # The participant's way ---------------------------------------------------------------------

    def participant(self, who: str) -> Participant[Any]:
        """The participant with this id. Asking is a sign of life.

        Raises:
            Unknown: there is none.
        """
        self._signs[who] = self.clock.monotonic()
        for one in self.people("id = ? AND NOT erased", who):
            return one
        raise Unknown

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
            sequence: of the answer, ``state.accepted`` of the page that it was given on. What was
                accepted before under this number is acknowledged again. Leaving is accepted from
                any page.
            kind, payload: for the flow. An answer of somebody who was timed out brings them
                back, where a place is free.
            browser: the page's ``performance.now``, ms.

        Returns:
            The state to go on with. This content is on the disk when this returns.

        Raises:
            Unknown, Refused.
            Conflict: another answer was accepted under this number, or no page had it.
        """
        with self.transaction() as do:
            one = self.participant(who)
            state: State = one.state
            if kind == "withdraw" and (not state.over or state.paused):
                return self._accept(do, one, kind, payload, browser)
            left = kind == "withdraw" and state.stage == "withdrawn"
            if left or (kind == "return" and not state.paused):
                return state
            if sequence < state.accepted:
                return self._acknowledge(do, one, sequence, kind, payload)
            if sequence > state.accepted or (state.over and not state.paused):
                raise Conflict("other_page")
            if state.paused:
                back = self.flow.readmit(one, self._present(do))
                after = self._accept(do, one, "return", back)
                if kind == "return":
                    return after
                one = Participant(one.row, after)
            if kind == "consent" and payload.get("agree"):
                if one.row["stream"] == "person" and self.paused:
                    raise Refused("paused")
                payload = {**payload, **self.flow.admit(one, self._present(do))}
            return self._accept(do, one, kind, payload, browser)

    def _acknowledge(
        self,
        do: Do,
        one: Participant[Any],
        sequence: int,
        kind: str,
        payload: Mapping[str, Any],
    ) -> State:
        """The state, if this is what was accepted under a number."""
        sql = "SELECT kind, payload FROM event WHERE participant = ? AND source_sequence = ? "
        row = do(sql + "AND source = 'protocol'", (one.id, sequence)).fetchone()
        if row["kind"] != kind or not payload.items() <= json.loads(row["payload"]).items():
            raise Conflict("other_answer")
        return one.state

    def asked(self, found: Participant[Any], sequence: int) -> State:
        """The state of a participant whose page had this number; the present one if none had."""
        here: State = self.flow.asking(found.state)
        if not 0 <= sequence < here.accepted:
            return here
        texts = [event["state"] for event in self.log(found.id) if event["state"]]
        states = map(self.flow.STATE.from_text, texts)
        return next(one for one in states if one.accepted == sequence)

    def _accept(
        self,
        do: Do,
        one: Participant[Any],
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None = None,
    ) -> State:
        after: State = self.flow.advance(one.state, kind, payload)
        numbered = after.accepted > one.state.accepted
        source, number = ("protocol", one.state.accepted) if numbered else ("server", None)
        self.record(do, one.id, source, number, kind, payload, browser, after.text)
        if after.stage == "declined":
            self._forget_visit(do, one.id)
        return after

    def time_out_stale(self) -> int:
        """Gives the places of everybody silent for too long to others; returns how many. They may
        come back while places are free. Nobody's time runs before they have agreed to take part."""
        with self.transaction() as do:
            return self._time_out_stale(do)

    def _present(self, do: Do) -> People:
        """Everybody, after those who are silent for too long gave their places back."""
        self._time_out_stale(do)
        return self.people()

    def _time_out_stale(self, do: Do) -> int:
        stale = [
            one
            for one in self.people()
            if not one.state.over
            and one.state.stage != "consent"
            and self._silent(one) > 60 * self.flow.plan.rules.timeout_minutes
        ]
        for one in stale:
            self._accept(do, one, "time_out", {})
        return len(stale)

    def _silent(self, one: Participant[Any]) -> float:
        """Seconds without a sign of life."""
        # Who sets the wall clock times nobody out: it is asked across restarts alone.
        clock = "monotonic" if one.row["boot"] == self.clock.boot else "wall"
        silent: float = getattr(self.clock, clock)() - one.row[clock]
        return min(silent, self.clock.monotonic() - self._signs.get(one.id, -math.inf))


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
