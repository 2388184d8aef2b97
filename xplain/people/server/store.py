"""The server's memory of its participants.

Every change is one event, with the state that it leads to. An event that comes twice is stored
once.
"""

from __future__ import annotations

import json
import math
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from xplain.errors import InputError, Refused, one_of
from xplain.people.analysis.export import ParticipantRow
from xplain.people.analysis.stored import STREAMS
from xplain.people.flow import Conflict, State
from xplain.people.server.database import Clock, Database, Do, Gone, Unknown
from xplain.people.server.site import Site

LETTERS = "BCDFGHJKLMNPQRSTVWXZ"
"""Of ids, invitations and completion codes: no vowels, so no words, and no digits,
which look like a number."""
OTHER_PLAN = (
    "belongs to another study plan, or was begun by an earlier version: go on with that one, or "
    "take another database (export and replay read this one)"
)


def _letters(count: int) -> str:
    """A random text that nothing reads as a word or a number, and no mail program cuts."""
    return "".join(secrets.choice(LETTERS) for _ in range(count))


class Store(Database):
    """Everything the server knows. Safe to call from several threads."""

    def __init__(self, path: Path, site: Site[Any], clock: Clock | None = None) -> None:
        """Opens or creates the database.

        Raises:
            XplainError: another process has it open, it belongs to another plan, or it is broken.
        """
        super().__init__(path, clock)
        self.site, plan = site, site.plan
        self._signs: dict[str, float] = {}
        try:
            with self.transaction() as do:
                row = do("SELECT value FROM meta WHERE key = 'plan'").fetchone()
                if row is None:
                    do("INSERT INTO meta VALUES ('plan', ?)", (plan.text,))
                    do("INSERT INTO meta VALUES ('plan_hash', ?)", (plan.hash,))
                elif row[0] != plan.text:
                    raise InputError("database", str(path), OTHER_PLAN)
            site.check(self._connection)
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
        tokens = [_letters(18) for _ in range(count)]
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
            Gone: their data was erased.
        """
        hashed = self.keyed("token", token)
        with self.transaction() as do:
            row = do("SELECT * FROM invitation WHERE token = ?", (hashed,)).fetchone()
            if row is None:
                raise Unknown
            if row["participant"]:
                (erased,) = do(
                    "SELECT erased FROM participant WHERE id = ?", (row["participant"],)
                ).fetchone()
                if erased:
                    raise Gone
                return self._resume(do, row["participant"])
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
            row = do("SELECT * FROM seen WHERE external = ?", (external,)).fetchone()
            if row is None:
                return self._enter(do, "person", "platform", external, hashed, ids if keep else {})
            if row["erased"]:
                raise Gone
            if row["session"] != hashed:
                if self.site.state(row["state"]).stage != "consent":
                    raise Unknown
                do("UPDATE participant SET session = ? WHERE id = ?", (hashed, row["id"]))
            return self._resume(do, row["id"])

    def enter_preview(self, cell: int) -> str:
        """A pilot whose part of the plan the researcher chose, not chance.

        Raises:
            Refused: the protocol has no such cell.
        """
        self.site.check_cell(cell)
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
        **more: int,
    ) -> str:
        who, ids, code = _letters(14).lower(), json.dumps(kept or {}), _letters(8)
        do(
            "INSERT INTO participant VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, 0)",
            (who, stream_name, entry, external, session, ids, code),
        )
        about = {"entry": entry, "stream": stream_name, **more}
        self.record(do, who, "server", None, "enter", about, state=self.site.state().text)
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
        """The participant with this id, with their present state, without their events. Asking is
        a sign of life.

        Raises:
            Unknown: there is none.
        """
        self._signs[who] = self.clock.monotonic()
        for row in self.query("SELECT * FROM seen WHERE id = ? AND NOT erased", (who,)):
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
            sequence: of the answer, ``state.accepted`` of the page that it was given on. What was
                accepted before under this number is acknowledged again. Leaving is accepted from
                any page.
            kind, payload: for the protocol. An answer of somebody who was timed out brings them
                back, where a place is free.
            browser: the page's ``performance.now``, ms.

        Returns:
            The state to go on with. This content is on the disk when this returns.

        Raises:
            Unknown, Refused.
            Conflict: another answer was accepted under this number, or no page had it.
        """
        with self.transaction() as do:
            row = do("SELECT * FROM seen WHERE id = ?", (who,)).fetchone()
            if row is None:
                raise Unknown
            state: State = self.site.state(row["state"])
            left = kind == "withdraw" and state.stage == "withdrawn"
            if left or (kind == "return" and not state.paused):
                return state
            if kind == "withdraw" and (not state.over or state.paused):
                return self._accept(do, who, state, kind, payload, browser)
            if sequence < state.accepted:
                return self._acknowledge(do, who, state, sequence, kind, payload)
            if sequence > state.accepted or (state.over and not state.paused):
                raise Conflict("other_page")
            if state.paused:
                self._time_out_stale(do)
                back = self.site.readmit(do, row, state)
                state = self._accept(do, who, state, "return", back, None)
                if kind == "return":
                    return state
            if kind == "consent" and payload.get("agree"):
                if row["stream"] == "person" and self.paused:
                    raise Refused("paused")
                self._time_out_stale(do)
                payload = {**payload, **self.site.admit(do, row)}
            return self._accept(do, who, state, kind, payload, browser)

    def _acknowledge(
        self,
        do: Do,
        who: str,
        state: State,
        sequence: int,
        kind: str,
        payload: Mapping[str, Any],
    ) -> State:
        """The state, if this is what was accepted under a number."""
        sql = "SELECT kind, payload FROM event WHERE participant = ? AND source_sequence = ? "
        row = do(sql + "AND source = 'protocol'", (who, sequence)).fetchone()
        if row["kind"] != kind or not payload.items() <= json.loads(row["payload"]).items():
            raise Conflict("other_answer")
        return state

    def asked(self, found: ParticipantRow[Any], sequence: int) -> State:
        """The state of a participant whose page had this number; the present one if none had."""
        here: State = self.site.flow.asking(found.state)
        if not 0 <= sequence < here.accepted:
            return here
        states = [self.site.state(event["state"]) for event in self.log(found.id) if event["state"]]
        return next(one for one in states if one.accepted == sequence)

    def _accept(
        self,
        do: Do,
        who: str,
        state: State,
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None,
    ) -> State:
        after: State = self.site.flow.advance(state, kind, payload)
        numbered = after.accepted > state.accepted
        source, number = ("protocol", state.accepted) if numbered else ("server", None)
        self.record(do, who, source, number, kind, payload, browser, after.text)
        if after.stage == "declined":
            self.forget_visit(do, who)
        return after

    def time_out_stale(self) -> int:
        """Gives the places of everybody silent for too long to others; returns how many. They may
        come back while places are free. Nobody's time runs before they have agreed to take part."""
        with self.transaction() as do:
            return self._time_out_stale(do)

    def _time_out_stale(self, do: Do) -> int:
        count = 0
        for row in do("SELECT * FROM seen").fetchall():
            state: State = self.site.state(row["state"])
            if state.over or state.stage == "consent":
                continue
            # Who sets the wall clock times nobody out: it is asked across restarts alone.
            same = row["boot"] == self.clock.boot
            silent = (
                self.clock.monotonic() - row["monotonic"]
                if same
                else self.clock.wall() - row["wall"]
            )
            sign = self._signs.get(row["id"], -math.inf)
            silent = min(silent, self.clock.monotonic() - sign)
            if silent > 60 * self.site.plan.rules.timeout_minutes:
                self._accept(do, row["id"], state, "time_out", {}, None)
                count += 1
        return count
