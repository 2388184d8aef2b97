"""The server logic of a study or a collection: how participants enter and continue."""

from __future__ import annotations

import hashlib
import hmac
import math
import re
import secrets
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from xplain.errors import InputError, Refused, XplainError, one_of
from xplain.people.export import find_differences
from xplain.people.flow import STREAMS, Conflict, Flow, Participant, People, State
from xplain.people.log import OVERWRITTEN, Clock, Log, letters

MAX_TAB_EVENTS = 5000
"""Maximum number of stored page events of a participant; a study page makes a few dozen."""
LATEST = 8
"""Number of participants whose events are replayed at a start: enough to detect changed code."""


class Unknown(Exception):
    """No such participant, invitation or key."""


class Gone(Exception):
    """The data of this participant was erased."""


class Store(Log[Any]):
    """A running flow. Safe to call from several threads."""

    def __init__(
        self, path: Path, flow: Flow[Any, Any] | None = None, clock: Clock | None = None
    ) -> None:
        """Opens or creates the database of a flow. Without a flow, data can only be erased.

        Raises:
            XplainError: another process has it open, it belongs to another plan, or it is broken.
        """
        super().__init__(path, flow.STATE if flow else State, clock)
        self.flow: Any = flow
        self._signs: dict[str, float] = {}
        with ExitStack() as on_error:
            on_error.callback(self.close)
            self.secret = self._secret()
            if flow:
                self._check(flow)
            on_error.pop_all()

    def _check(self, flow: Flow[Any, Any]) -> None:
        """Stores the plan of a flow, or compares it with the stored one."""
        if not self.plan:
            with self.changes():
                self.append("", "server", "plan", {"plan": flow.plan.text})
        if self.plan != flow.plan.text:
            raise InputError("database", str(self.path), "another one: it belongs to another plan")
        if differences := find_differences(flow, self.everybody()[-LATEST:]):
            raise XplainError(
                "database: this version of xplain decides differently from the one that started "
                f"{flow.plan.OF} in it; go on and replay with that version, or start again in "
                f"another database ({differences[0]})"
            )

    def _secret(self) -> bytes:
        """The server's secret, in a separate file beside the database that only its owner can read.

        Raises:
            InputError: the database has data, and its secret is lost.
        """
        file = self.path.with_name(self.path.name + ".key")
        if not file.exists() or not file.stat().st_size:
            if self.plan:
                wanted = f"a database with its key beside it: {file.name} is missing, restore it"
                raise InputError("database", str(self.path), wanted)
            file.touch(0o600)
            file.write_bytes(secrets.token_bytes(32))
        return file.read_bytes()

    def reference(self, who: str) -> str:
        """The participant's reference for the erasure of their data. It cannot be computed from the
        id, which published data contain."""
        return self.hash_texts("reference", who)[:16]

    def hash_texts(self, *parts: str) -> str:
        """Computes a keyed hash of texts that are only compared (invitations, outside ids). Nobody
        can make or reverse it without the server's secret."""
        message = "\x1f".join(parts).encode(errors="replace")
        return hmac.new(self.secret, message, hashlib.sha256).hexdigest()

    def erase_by(self, reference: str) -> None:
        """Erases the data of one participant.

        Args:
            reference: the participant's reference; characters that are no hexadecimal digits are
                ignored.

        Raises:
            InputError: no such participant, or the data is already erased.
        """
        given = "".join(re.findall(r"[0-9a-f]", reference.lower()))
        who = next((one.id for one in self.present() if self.reference(one.id) == given), None)
        if who is None:
            raise InputError("reference", reference, "the reference of a participant")
        self.erase(who)
        if self.flow:
            self.flow.forget()

    # Entry -------------------------------------------------------------------------------------

    def invite(self, count: int, stream: str) -> list[str]:
        """Creates invitation tokens. They are shown once; only their keyed hashes are stored."""
        one_of("stream", stream, STREAMS)
        tokens = [letters(18) for _ in range(count)]
        with self.changes():
            hashed = [self.hash_texts("token", token) for token in tokens]
            self.append("", "server", stream, {"tokens": hashed})
        return tokens

    def enter_invited(self, token: str) -> str:
        """Returns the participant of an invitation; its first use creates the participant.

        Raises:
            Unknown: no such token.
            Gone: their data was erased.
        """
        key = self.hash_texts("token", token)
        with self.changes():
            if key not in self.invited:
                raise Unknown
            who = self.keys.get(key)
            return self._resume(who) if who else self._enter(self.invited[key], "invitation", key)

    def enter_from_platform(self, ids: Mapping[str, str], keep: bool) -> str:
        """Returns the participant with a recruiting platform's ids; their first use creates the
        participant. A person is one participant, even if links name different studies or sessions.

        Args:
            ids: ids of the person, the study and the session, by name; the last two are optional.
            keep: True stores them in clear.

        Raises:
            Unknown: this person consented earlier, in another session.
            Gone: their data was erased.
        """
        person, _, session = (*ids.values(), "", "")[:3]
        key, hashed = self.hash_texts("platform", person), self.hash_texts("session", session)
        with self.changes():
            if (who := self.keys.get(key)) is None:
                more: dict[str, Any] = {"session": hashed, "kept": {**ids} if keep else {}}
                return self._enter("person", "platform", key, **more)
            one = self.people[who]
            if not one.erased and one.identity["session"] != hashed:
                if one.state.stage != "consent":
                    raise Unknown
                self.append(who, "identity", "session", {"session": hashed})
            return self._resume(who)

    def enter_as_pilot(self, cell: int | None = None) -> str:
        """Creates a pilot without an invitation.

        Args:
            cell: cell of the plan that the researcher chose for a preview; None chooses at random.

        Raises:
            Refused: the flow has no such cell.
        """
        if cell is not None and not 0 <= cell < len(self.flow.cells):
            raise Refused("not_understood")
        with self.changes():
            return self._enter("pilot", "open" if cell is None else "preview", cell=cell)

    def _enter(
        self, stream: str, entry: str, key: str = "", cell: int | None = None, **more: Any
    ) -> str:
        who, first = letters(14).lower(), self.flow.STATE(cell=cell).text
        self.append(who, "server", "enter", {"entry": entry, "stream": stream}, state=first)
        identity = {"code": letters(8), **({"key": key} if key else {}), **more}
        self.append(who, "identity", "identity", identity)
        return who

    def _resume(self, who: str) -> str:
        if self.people[who].erased:
            raise Gone
        self.append(who, "server", "resume", {})
        return who

    def pause(self, on: bool) -> None:
        """Closes or opens the study for new participants. People who have begun continue."""
        with self.changes():
            self.append("", "server", "pause", {"paused": on})

    # The participant's way ---------------------------------------------------------------------

    def present(self) -> list[Participant[Any]]:
        """All participants except erased ones, in order of arrival."""
        with self._lock:
            return [one for one in self.people.values() if not one.erased]

    def participant(self, who: str) -> Participant[Any]:
        """The participant with this id. The call counts as activity.

        Raises:
            Unknown: no such participant.
        """
        with self._lock:
            one = self.people.get(who)
        if one is None or one.erased:
            raise Unknown
        self._signs[who] = self.clock.monotonic()
        return one

    def show(self, one: Participant[Any], state: State) -> None:
        """Records the first rendering of the page of a participant's state."""
        if one.shown < state.accepted:  # most repetitions are reloads
            with self.changes():
                self.append(one.id, "shown", "shown", {"stage": state.stage}, state.accepted)

    def report(
        self, who: str, tab: str, items: Sequence[tuple[int, str, float, dict[str, Any]]]
    ) -> None:
        """Stores a page's own events (number, kind, ms, payload), without repetitions.

        Raises:
            Unknown: there is no such participant.
            Refused: the pages sent too many events.
        """
        with self.changes():
            if self.participant(who).reported + len(items) > MAX_TAB_EVENTS:
                raise Refused("too_much")
            for number, kind, browser, payload in items:
                self.append(who, f"tab:{tab}", kind, payload, number, browser)

    def submit(
        self,
        who: str,
        sequence: int,
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None = None,
    ) -> State:
        """Accepts an answer once.

        Args:
            who: the participant.
            sequence: number of the answer: ``state.accepted`` of its page. An answer that was
                already accepted under this number is acknowledged again. Withdrawal is accepted
                from any page.
            kind, payload: the flow's event. The answer of a timed-out participant brings them back
                if a place is free.
            browser: the page's ``performance.now``, ms.

        Returns:
            The state after the answer. The answer is then on the disk.

        Raises:
            Unknown, Refused.
            Conflict: another answer was accepted under this number, or no page had it.
        """
        with self.changes():
            one = self.participant(who)
            state: State = one.state
            if kind == "withdraw" and (not state.over or state.paused):
                return self._accept(one, kind, payload, browser)
            left = kind == "withdraw" and state.stage == "withdrawn"
            if left or (kind == "return" and not state.paused):
                return state
            if sequence < state.accepted:
                which = "participant = ? AND source = 'protocol' AND source_sequence = ?"
                (before,) = self.events(which, who, sequence)
                if before.kind != kind or not payload.items() <= before.payload.items():
                    raise Conflict("other_answer")
                return state
            if sequence > state.accepted or (state.over and not state.paused):
                raise Conflict("other_page")
            if state.paused:
                state = self._accept(one, "return", self.flow.readmit(one, self._current()))
                if kind == "return":
                    return state
                one = self.people[who]
            if kind == "consent" and payload.get("agree"):
                if one.stream == "person" and self.paused:
                    raise Refused("paused")
                payload = {**payload, **self.flow.admit(one, self._current())}
            return self._accept(one, kind, payload, browser)

    def find_state(self, found: Participant[Any], sequence: int) -> State:
        """The state of a participant whose page had this number; the current state if none had."""
        here: State = self.flow.asking(found.state)
        if not 0 <= sequence < here.accepted:
            return here
        own = self.events("participant = ? AND state IS NOT NULL", found.id)
        states = (self.flow.STATE.from_text(event.state) for event in own)
        return next(one for one in states if one.accepted == sequence)

    def _accept(
        self,
        one: Participant[Any],
        kind: str,
        payload: Mapping[str, Any],
        browser: float | None = None,
    ) -> State:
        after: State = self.flow.advance(one.state, kind, payload)
        numbered = after.accepted > one.state.accepted
        source, number = ("protocol", one.state.accepted) if numbered else ("server", None)
        self.append(one.id, source, kind, payload, number, browser, after.text)
        if after.stage == "declined":
            # Only their arrival and refusal are kept, with times.
            shown = "(source = 'shown' OR source LIKE 'tab:%')"
            self.overwrite(one.id, f"{OVERWRITTEN}, kind = 'erased'", shown)
            outside = ["width", "session", "kept"] + ["key"] * (one.about["entry"] == "platform")
            gone = ", ".join(f"'$.{name}'" for name in outside)
            self.overwrite(one.id, f"payload = json_remove(payload, {gone})", "TRUE")
        return after

    def time_out_stale(self) -> int:
        """Times out participants who were inactive for too long, so that others can have their
        places. Returns their number. They may return while places are free. Participants are timed
        out only after consent."""
        with self.changes():
            stale = [
                one
                for one in self.present()
                if not one.state.over
                and one.state.stage != "consent"
                and self._silent(one) > 60 * self.flow.plan.rules.timeout_minutes
            ]
            for one in stale:
                self._accept(one, "time_out", {})
        return len(stale)

    def _current(self) -> People:
        """All participants, after inactive ones are timed out."""
        self.time_out_stale()
        return self.present()

    def _silent(self, one: Participant[Any]) -> float:
        """Seconds without activity."""
        latest = one.latest
        # A change of the wall clock times nobody out: it is used only across restarts.
        clock = "monotonic" if latest.boot == self.clock.boot else "wall"
        silent: float = getattr(self.clock, clock)() - getattr(latest, clock)
        return min(silent, self.clock.monotonic() - self._signs.get(one.id, -math.inf))
