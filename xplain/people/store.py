"""The server logic of a study or a collection: how participants enter and continue."""

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
from xplain.people.log import BRIEF, OVERWRITTEN, Clock, Log, Unknown, letters

MAX_TAB_EVENTS = 5000
"""Maximum number of stored page events of a participant; a study page makes a few dozen."""
LATEST = 8
"""Number of participants whose events are replayed at a start: enough to detect changed code."""


class DataErased(Unknown):
    """The data of this participant was erased."""


class Store(Log[Any]):
    """A running flow. Safe to call from several threads."""

    def __init__(
        self, path: Path, flow: Flow[Any, Any] | None = None, clock: Clock | None = None
    ) -> None:
        """Opens or creates the database of a flow. Without a flow, data can only be erased.

        Raises:
            XplainError: another process has the database open, or the database belongs to another
                plan or is damaged.
        """
        super().__init__(path, flow.STATE if flow else State, clock)
        self.flow: Any = flow
        self._signs: dict[str, float] = {}
        plans = self.events("participant = '' AND kind = 'plan'")
        self.plan = next((event.payload["plan"] for event in plans), "")
        with ExitStack() as on_error:
            on_error.callback(self.close)
            self.secret = self._read_secret()
            if flow:
                self._check_plan(flow)
            on_error.pop_all()

    def _check_plan(self, flow: Flow[Any, Any]) -> None:
        """Stores the plan of a flow, or compares the plan with the stored plan."""
        if not self.plan:
            self.plan = flow.plan.text
            with self.changes():
                self.append("", "server", "plan", {"plan": self.plan})
        if self.plan != flow.plan.text:
            raise InputError(
                "database", str(self.path), "another file: this database has another plan"
            )
        if differences := find_differences(flow, self.everybody()[-LATEST:]):
            raise XplainError(
                "database: this version of xplain decides differently from the version that "
                f"started {flow.plan.OF} in it; continue and replay with that version, or start "
                f"again in another database ({differences[0]})"
            )

    def _read_secret(self) -> bytes:
        """Reads the server's secret, or makes a new secret. The secret is in a separate file beside
        the database. Only the owner of this file can read it.

        Raises:
            InputError: the database has data, and the secret is lost.
        """
        file = self.path.with_name(self.path.name + ".key")
        if not file.exists() or not file.stat().st_size:
            if self.plan:
                wanted = f"a database with its key: {file.name} is missing, restore this file"
                raise InputError("database", str(self.path), wanted)
            file.touch(0o600)
            file.write_bytes(secrets.token_bytes(32))
        return file.read_bytes()

    def reference(self, who: str) -> str:
        """Computes the participant's reference for the erasure of their data. Nobody can compute it
        from the id alone, which published data contain."""
        return self.hash_texts("reference", who)[:16]

    def hash_texts(self, *parts: str) -> str:
        """Computes a keyed hash of texts that are only compared (invitations, platform ids). Nobody
        can make or reverse the hash without the server's secret."""
        message = "\x1f".join(parts).encode(errors="replace")
        return hmac.new(self.secret, message, hashlib.sha256).hexdigest()

    @property
    def mark(self) -> str:
        """A short code that identifies this server in the name of its cookie and in its replies to
        answers."""
        return self.hash_texts("mark")[:12]

    @property
    def researcher_key(self) -> str:
        """The key for the researcher's page; the same at every start."""
        return self.hash_texts("researcher")[:32]

    def erase_by(self, reference: str) -> None:
        """Erases the data of one participant.

        Args:
            reference: the participant's reference; characters that are no hexadecimal digits are
                ignored.

        Raises:
            InputError: no participant has this reference, or the data is already erased.
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

    def enter_invited(self, token: str, persons: bool = True) -> str:
        """Returns the participant of an invitation; its first use creates the participant.

        Args:
            token: the token of the invitation.
            persons: False admits only pilots and bots.

        Raises:
            Unknown: the token does not exist, or is not for a participant of this kind.
            DataErased: the participant's data was erased.
        """
        key = self.hash_texts("token", token)
        with self.changes():
            made = self.events("participant = '' AND kind IN (?, ?, ?)", *STREAMS)
            stream = next((one.kind for one in made if key in one.payload["tokens"]), None)
            if stream is None or (stream == "person" and not persons):
                raise Unknown
            return self._enter(stream, "invitation", key)

    def enter_from_platform(self, ids: Mapping[str, str], keep: bool) -> str:
        """Returns the participant with a recruiting platform's ids; the first use of the ids
        creates the participant. A person is one participant, even if links name different studies
        or sessions.

        Args:
            ids: ids of the person, the study and the session, by name; the last two are optional.
            keep: True stores the ids themselves, not only their keyed hash.

        Raises:
            Unknown: this person consented earlier, in another session.
            DataErased: the person's data was erased.
        """
        person, _, session = (*ids.values(), "", "")[:3]
        key, hashed = self.hash_texts("platform", person), self.hash_texts("session", session)
        own: dict[str, Any] = {"session": hashed, "kept": {**ids} if keep else {}}
        with self.changes():
            one = self.participant(self._enter("person", "platform", key, **own))
            if one.identity["session"] != hashed:
                if one.state.stage != "consent":
                    raise Unknown
                self.append(one.id, "identity", "session", {"session": hashed})
            return one.id

    def enter_as_pilot(self, cell: int | None = None) -> str:
        """Creates a pilot (a test participant) without an invitation.

        Args:
            cell: index, in the flow's ``cells``, of the type and condition that a researcher wants
                to preview; None assigns them as for other participants.
        """
        with self.changes():
            return self._enter("pilot", "open" if cell is None else "preview", cell=cell)

    def _enter(
        self, stream: str, entry: str, key: str = "", cell: int | None = None, **more: Any
    ) -> str:
        """Returns the id of the participant with a key, or of a new participant."""
        if key and (who := self.find_owner(key)):
            self.participant(who)
            self.append(who, "server", "resume", {})
            return who
        who, first = letters(14).lower(), self.flow.STATE(cell=cell).text
        sql = "SELECT count(*) + 1 FROM event WHERE participant > '' AND sequence = 0"
        (number,) = self._connection.execute(sql).fetchone()
        arrival = {"entry": entry, "stream": stream, "number": number}
        self.append(who, "server", "enter", arrival, state=first)
        identity = {"code": letters(8), **({"key": key} if key else {}), **more}
        self.append(who, "identity", "identity", identity)
        return who

    def pause(self, on: bool) -> None:
        """Closes or opens the study for new participants. People who have begun continue."""
        with self.changes():
            self.append("", "server", "pause", {"paused": on})

    # The participant's way ---------------------------------------------------------------------

    def present(self) -> list[Participant[Any]]:
        """Returns all participants whose data is not erased, in order of arrival."""
        return self.everybody(BRIEF)

    @property
    def paused(self) -> bool:
        """True if no new participants are admitted."""
        pauses = self.events("participant = '' AND kind = 'pause'")
        return [False, *(event.payload["paused"] for event in pauses)][-1]

    def participant(self, who: str) -> Participant[Any]:
        """Returns the participant with this id. The call counts as activity.

        Raises:
            Unknown: the participant does not exist.
            DataErased: the participant's data was erased.
        """
        events = tuple(
            self.events("participant > '' AND participant = ? AND source NOT LIKE 'tab:%'", who)
        )
        if not events:
            raise Unknown
        if events[-1].kind == "erase":
            raise DataErased
        self._signs[who] = self.clock.monotonic()
        return Participant(who, self.flow.STATE, events)

    def show(self, one: Participant[Any], state: State) -> None:
        """Records the first rendering of the page of a participant's state."""
        if one.shown < state.accepted:  # a reload is not recorded
            with self.changes():
                self.append(one.id, "shown", "shown", {"stage": state.stage}, state.accepted)

    def report(
        self, who: str, tab: str, items: Sequence[tuple[int, str, float, dict[str, Any]]]
    ) -> None:
        """Stores the events that a page itself reports, such as "hidden"; a repeated event is
        stored once.

        Args:
            who: the participant.
            tab: id of the page.
            items: (number on the page, kind, time by the page's clock in ms, payload) of each
                event.

        Raises:
            Unknown: the participant does not exist.
            Refused: the pages sent too many events.
        """
        sql = "SELECT count(*) FROM event WHERE participant = ? AND source LIKE 'tab:%'"
        self.participant(who)
        with self.changes():
            (reported,) = self._connection.execute(sql, (who,)).fetchone()
            if reported + len(items) > MAX_TAB_EVENTS:
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
            sequence: number of answers accepted when the page was rendered (``state.accepted``). It
                identifies the answer: the same answer with the same number is acknowledged again,
                not stored again. Withdrawal is accepted with any number.
            kind, payload: kind and content of the flow's event. A timed-out participant who answers
                returns to the study if a place is free.
            browser: the page's ``performance.now``, ms.

        Returns:
            The state after the answer. The answer is then on the disk.

        Raises:
            Unknown: the participant does not exist.
            Refused: the answer is not valid.
            Conflict: another answer was accepted under this number, or no page had this number.
        """
        with self.changes():
            one = self.participant(who)
            state: State = one.state
            if kind == "withdraw" and (not state.over or state.paused):
                return self._accept_answer(one, kind, payload, browser)
            left = kind == "withdraw" and state.stage == "withdrawn"
            if left or (kind == "return" and not state.paused):
                return state
            if sequence < state.accepted:
                answers = (e for e in one.events if e.source == "protocol")
                before = next(e for e in answers if e.source_sequence == sequence)
                if before.kind != kind or not payload.items() <= before.payload.items():
                    raise Conflict("other_answer")
                return state
            if sequence > state.accepted or (state.over and not state.paused):
                raise Conflict("other_page")
            if state.paused:
                state = self._accept_answer(
                    one, "return", self.flow.readmit(one, self._list_current())
                )
                if kind == "return":
                    return state
                one = self.participant(who)
            if kind == "consent" and payload.get("agree"):
                if one.stream == "person" and self.paused:
                    raise Refused("paused")
                payload = {**payload, **self.flow.admit(one, self._list_current())}
            return self._accept_answer(one, kind, payload, browser)

    def find_state(self, found: Participant[Any], sequence: int) -> State:
        """Returns the state in which a participant saw an earlier page.

        Args:
            found: the participant.
            sequence: the page's number, which is the number of answers accepted before the page.

        Returns:
            The state of that page; the current state if no earlier page had this number.
        """
        here: State = self.flow.asking(found.state)
        if not 0 <= sequence < here.accepted:
            return here
        states = (self.flow.STATE.from_text(e.state) for e in found.events if e.state)
        return next(one for one in states if one.accepted == sequence)

    def _accept_answer(
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
            # Only the arrival and the refusal are kept, with times.
            shown = "(source = 'shown' OR source LIKE 'tab:%')"
            self.overwrite(one.id, f"{OVERWRITTEN}, kind = 'erased'", shown)
            outside = ["width", "session", "kept"] + ["key"] * (one.about["entry"] == "platform")
            gone = ", ".join(f"'$.{name}'" for name in outside)
            self.overwrite(one.id, f"payload = json_remove(payload, {gone})", "TRUE")
        return after

    def time_out_stale(self) -> int:
        """Times out participants who were inactive for too long after their consent, so that others
        can have their places. Returns the number of these participants, who may return while places
        are free."""
        with self.changes():
            stale = [
                one
                for one in self.present()
                if not one.state.over
                and one.state.stage != "consent"
                and self._measure_silence(one) > 60 * self.flow.plan.rules.timeout_minutes
            ]
            for one in stale:
                self._accept_answer(one, "time_out", {})
        return len(stale)

    def _list_current(self) -> People:
        """Times out inactive participants, then lists all participants whose data is not erased."""
        self.time_out_stale()
        return self.present()

    def _measure_silence(self, one: Participant[Any]) -> float:
        """Measures the seconds without activity."""
        latest = one.events[-1]
        # The wall clock is used only across restarts, so a change of it times nobody out.
        clock = "monotonic" if latest.boot == self.clock.boot else "wall"
        silent: float = getattr(self.clock, clock)() - getattr(latest, clock)
        return min(silent, self.clock.monotonic() - self._signs.get(one.id, -math.inf))
