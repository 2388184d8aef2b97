"""The server's memory of its participants.

Every change happens in one transaction: the event, the participant's state, the slot, the policy's
step. An event that comes twice is stored once.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from xplain.errors import InputError, Refused, one_of
from xplain.people.analysis.export import ParticipantRow
from xplain.people.analysis.stored import STREAMS
from xplain.people.flow import State
from xplain.people.server.database import Clock, Database, Do, Unknown
from xplain.people.server.site import Site

LETTERS = "BCDFGHJKLMNPQRSTVWXZ"
"""Of completion codes: no vowels, so no words, and no digits that look like a number."""
ANSWERED = """UPDATE step SET labels = :labels, belief_after = :belief_after
    WHERE participant = :participant AND k = :k"""
DECIDED = """INSERT INTO step VALUES (:participant, :k, :belief_before, :given, :messages,
    :action_values, :labels, :belief_after)"""
OTHER_PLAN = (
    "belongs to another study plan, or was begun by an earlier version: go on with that one, or "
    "take another database (export and replay read this one)"
)


class Store(Database):
    """Everything the server knows. Safe to call from several threads."""

    def __init__(self, path: Path, site: Site[Any], clock: Clock | None = None) -> None:
        """Opens or creates the database.

        Raises:
            XplainError: another process has it open, it belongs to another plan, or it is broken.
        """
        super().__init__(path, clock)
        self.site, plan = site, site.plan
        try:
            with self.transaction() as do:
                row = do("SELECT value FROM meta WHERE key = 'plan'").fetchone()
                if row is None:
                    do("INSERT INTO meta VALUES ('plan', ?)", (plan.text,))
                    do("INSERT INTO meta VALUES ('plan_hash', ?)", (plan.hash,))
                    do("INSERT INTO meta VALUES ('head', ?)", (plan.hash,))
                    self.site.found(do)
                elif row[0] != plan.text:
                    raise InputError("database", str(path), OTHER_PLAN)
        except BaseException:
            self.close()
            raise

    def erase(self, reference: str) -> None:
        """Also from what the protocol keeps in memory; see :meth:`Database.erase`."""
        super().erase(reference)
        self.site.forget()

    # Entry -------------------------------------------------------------------------------------

    def invite(self, count: int, stream_name: str) -> list[str]:
        """New invitation tokens, shown once: only their keyed hashes are stored."""
        one_of("stream", stream_name, STREAMS)
        tokens = [secrets.token_urlsafe(12) for _ in range(count)]
        with self.transaction() as do:
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
        with self.transaction() as do:
            row = do("SELECT * FROM invitation WHERE token = ?", (hashed,)).fetchone()
            if row is None:
                raise Unknown
            if row["participant"]:
                return self._resume(do, row["participant"])
            who = self._enter(do, row["stream"], "invitation")
            do("UPDATE invitation SET participant = ? WHERE token = ?", (who, hashed))
            return who

    def enter_from_platform(self, ids: Mapping[str, str], keep: bool) -> str:
        """The participant of a recruiting platform's ids, made at their first use.

        Args:
            ids: of a person, of a study and of a session, by their names; the last two may lack.
            keep: whether they are stored in clear.

        Raises:
            Unknown: this person came before, in another session.
        """
        person, study, session = (*ids.values(), "", "")[:3]
        external, hashed = self.keyed("platform", person, study), self.keyed("session", session)
        with self.transaction() as do:
            row = do("SELECT * FROM participant WHERE external = ?", (external,)).fetchone()
            if row is None:
                return self._enter(do, "person", "platform", external, hashed, ids if keep else {})
            if row["session"] != hashed:
                raise Unknown
            return self._resume(do, row["id"])

    def enter_preview(self, cell: int) -> str:
        """A pilot whose part of the plan the researcher chose, not chance.

        Raises:
            Refused: the protocol has no such cell.
        """
        with self.transaction() as do:
            who = self._enter(do, "pilot", "preview")
            self.site.pin(do, who, cell)
            return who

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
    ) -> str:
        who, ids = secrets.token_hex(8), json.dumps(kept or {})
        code = "".join(secrets.choice(LETTERS) for _ in range(8))
        do(
            "INSERT INTO participant VALUES (NULL, ?, ?, ?, ?, ?, ?, 0, ?, ?, ?, 0)",
            (
                *(who, stream_name, entry, external, session, ids),
                *(self.site.state().text, code, secrets.token_hex(16)),
            ),
        )
        about = {"entry": entry, "stream": stream_name, "code": code, "kept": ids}
        self.record(do, who, "server", None, "enter", about)
        return who

    def _resume(self, do: Do, who: str) -> str:
        self.record(do, who, "server", None, "resume", {})
        return who

    @property
    def paused(self) -> bool:
        """Whether nobody new is let in."""
        return bool(self.query("SELECT 1 FROM control WHERE key = 'paused'"))

    def pause(self, on: bool) -> None:
        """Lets nobody new in, or lets them in again. Who has begun goes on."""
        insert = "INSERT INTO control VALUES ('paused', '1') ON CONFLICT DO NOTHING"
        with self.transaction() as do:
            do(insert if on else "DELETE FROM control WHERE key = 'paused'")

    # The participant's way ---------------------------------------------------------------------

    def participant(self, who: str) -> ParticipantRow[Any]:
        """The participant with this id, with their present state, without their events.

        Raises:
            Unknown: there is none.
        """
        for row in self.query("SELECT * FROM participant WHERE id = ? AND NOT erased", (who,)):
            return ParticipantRow(row, self.site.state(row["state"]))
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
            sequence: of the answer, ``state.accepted`` of the page that it was given on. A
                smaller number was accepted before: nothing happens.
            kind, payload: for the protocol.
            browser: the page's ``performance.now``, ms.

        Returns:
            The state to go on with; on the disk when this returns.

        Raises:
            Unknown, Refused.
        """
        with self.transaction() as do:
            row = do("SELECT * FROM participant WHERE id = ?", (who,)).fetchone()
            if row is None:
                raise Unknown
            state: State = self.site.state(row["state"])
            if sequence < state.accepted:
                return state
            if sequence > state.accepted:
                raise Refused("not_yet")
            if state.over and kind != "return":
                return state
            if kind == "consent" and payload.get("agree"):
                if row["stream"] == "person" and self.paused:
                    raise Refused("paused")
                self._time_out_stale(do)
                payload = {**payload, **self.site.admit(do, row)}
            elif kind == "return":
                self._time_out_stale(do)
                payload = self.site.readmit(do, row, state)
            return self._accept(do, who, state, kind, payload, browser)

    def _accept(
        self,
        do: Do,
        who: str,
        state: State,
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None,
    ) -> State:
        outcome = self.site.flow.advance(state, kind, payload)
        after: State = outcome.state
        self.record(do, who, "protocol", state.accepted, kind, payload, browser)
        for k, row in outcome.rows.items():
            sql = DECIDED if "given" in row else ANSWERED
            do(sql, {"participant": who, "k": k, **row})
        do(
            "UPDATE participant SET state = ?, over = ? WHERE id = ?",
            (after.text, after.over, who),
        )
        if after.over and not state.over:
            self.site.settle(do, who, after.stage)
        return after

    def time_out_stale(self) -> int:
        """Gives the places of everybody silent for too long to others; returns how many. They may
        come back while places are free. Nobody's time runs before they have agreed to take part;
        how long it is hangs on how far they are."""
        with self.transaction() as do:
            return self._time_out_stale(do)

    def _time_out_stale(self, do: Do) -> int:
        here = "SELECT * FROM seen WHERE over = 0 AND json_extract(state, '$.stage') != 'consent'"
        count = 0
        for row in do(here).fetchall():
            state: State = self.site.state(row["state"])
            # Who sets the wall clock times nobody out: it is asked across restarts alone.
            same = row["boot"] == self.clock.boot
            silent = (
                self.clock.monotonic() - row["monotonic"]
                if same
                else self.clock.wall() - row["wall"]
            )
            if silent > 60 * self.site.plan.rules.patience(state.accepted):
                self._accept(do, row["id"], state, "time_out", {}, None)
                count += 1
        return count
