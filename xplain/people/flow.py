"""A flow: the stages that lead a participant from the consent to the end, as a pure state machine.

``flow.advance(state, kind, payload)`` is the whole of it. No clock, no storage, no web; what comes
from elsewhere (a slot, a number, the orders of questions) is in the consent event. The same events
give the same states, which is what the replay checks. A stage has one page: :meth:`Stage.view` is
what it shows, :meth:`Stage.read` what it sends, :meth:`Stage.advance` what that leads to.

From anywhere a participant may get to an end: declined, withdrawn, timed_out, and a flow's own.
From timed_out they may return to where they were.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeVar

from xplain.errors import Refused
from xplain.people.plan import LabQuestion, StoredPlan, Way
from xplain.storage import decode

Form = Any
"""What a browser sent: a ``FormData`` of texts. Nothing in it is trusted."""
Fields = list[tuple[str, str]]
"""Names and values of a form."""


@dataclass(frozen=True)
class State:
    """Where a participant is. The first value is the start.

    Attributes:
        ENDS: the stages that nothing follows, beside "done" and "erased".
        stage: of the flow.
        accepted: answers accepted so far, which is the number of the page that is open. Events of
            the server (a time-out, a return) have no number.
        part: which half of the practice.
        wrong: whether the last answer of a practice or a test was wrong.
        left: the stage at which somebody was timed out.
        cell: the number of the cell (:attr:`Flow.cells`) that a preview shows; None for people.
    """

    ENDS: ClassVar[tuple[str, ...]] = ("declined", "withdrawn", "timed_out")

    stage: str = "consent"
    accepted: int = 0
    part: int = 0
    wrong: bool = False
    left: str | None = None
    cell: int | None = None

    @property
    def over(self) -> bool:
        """Whether nothing more can happen."""
        return self.stage in ("done", "erased", *self.ENDS)

    @property
    def paused(self) -> bool:
        """Whether they were silent for too long; they may go on where they were."""
        return self.stage == "timed_out"

    @property
    def text(self) -> str:
        """The state as JSON, for the store."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    @lru_cache(maxsize=1024)  # a page asks for its state several times
    def from_text(cls, text: str) -> Self:
        """The state that :attr:`text` was made from, equal to the last bit."""
        return decode(cls, json.loads(text))

    def to(self, **changes: Any) -> Self:
        """The state after one more accepted event."""
        return replace(self, accepted=self.accepted + 1, **changes)


S = TypeVar("S", bound=State)


class Conflict(Refused):
    """An answer to a page that is not open, or another answer to one that was answered."""


class Full(Refused):
    """No place is free now."""


STREAMS = ("person", "pilot", "bot")
"""Whose data it is; fixed by the invitation, and never mixed in an analysis."""


class Event(NamedTuple):
    """A row of the log; what its columns mean is in the codebook."""

    participant: str
    sequence: int
    source: str
    source_sequence: int
    kind: str
    wall: float
    monotonic: float
    boot: str
    browser: float | None
    payload: dict[str, Any]
    state: str | None
    number: int


NOTHING = Event("", 0, "", 0, "", 0.0, 0.0, "", None, {}, None, 0)


@dataclass(frozen=True)
class Participant(Generic[S]):
    """A participant, as their events so far have them.

    Attributes:
        id: as in every table.
        number: 1, 2, … in the order in which people came.
        kind: class of the state.
        text: the state as JSON.
        about: what is known since they came: ``stream`` and ``entry``.
        identity: what they came with, and what they are paid by: the keyed hashes ``key`` and
            ``session``, ``code``, and ``kept``, outside ids in clear. No export has it.
        entered: by the server's wall clock.
        latest: their last event.
        shown: number of the last page that was rendered.
        reported: how many events their pages reported.
        erased: whether their data was erased.
        events: in order, where they were asked for.
    """

    id: str
    number: int
    kind: type[S]
    text: str = "{}"
    about: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    entered: float = 0.0
    latest: Event = NOTHING
    shown: int = -1
    reported: int = 0
    erased: bool = False
    events: tuple[Event, ...] = ()

    def after(self, event: Event) -> Self:
        """The participant with one more event."""
        changes: dict[str, Any] = {
            "latest": event,
            "erased": self.erased or event.kind == "erase",
        }
        if event.state:
            changes["text"] = event.state
        if event.sequence == 0:
            changes |= {"about": event.payload, "entered": event.wall}
        elif event.source == "identity":
            changes["identity"] = {**self.identity, **event.payload}
        elif event.source == "shown":
            changes["shown"] = max(self.shown, event.source_sequence)
        elif event.source.startswith("tab:"):
            changes["reported"] = self.reported + 1
        return replace(self, **changes)

    @property
    def state(self) -> S:
        """The participant's current state."""
        return self.kind.from_text(self.text)

    @property
    def stream(self) -> str:
        """Whose data it is: person, pilot or bot."""
        return str(self.about["stream"])

    def answers(self, kind: str) -> list[Event]:
        """The accepted answers of a kind, in order."""
        return [e for e in self.events if e.source == "protocol" and e.kind == kind]

    def first(self, kind: str) -> Mapping[str, Any]:
        """The payload of the first answer of a kind; empty where there is none."""
        return next((event.payload for event in self.answers(kind)), {})


People = Sequence["Participant[Any]"]


F = TypeVar("F", bound="Flow[Any, Any]")
P = TypeVar("P")


@dataclass(frozen=True)
class Stage(Generic[F, S]):
    """A page, and what its answer leads to.

    Attributes:
        WITHIN: the stage that this one comes in the middle of; "" for one in the order of them all.
        name: of the stage, its template and its title.
        kind: of the event that it waits for.
    """

    WITHIN: ClassVar[str] = ""

    name: str
    kind: str

    def wanted(self, plan: Any) -> bool:
        """Whether a plan has this stage in its order."""
        return not self.WITHIN

    def enter(self, flow: F, state: S) -> S:
        """The state after the event that leads here."""
        return state.to(stage=self.name)

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """What the page shows, in plain values. What simulated people read as well: ``briefing``
        and ``told``, sentences; ``fields``, of each field its (value, text)."""
        return {}

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """The payload of what was sent; what is missing or malformed becomes None."""
        return {}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """The state after the page's event.

        Raises:
            Refused: the payload is not what the stage asks for.
        """
        return flow.after(state)


@dataclass(frozen=True)
class Flow(ABC, Generic[P, S]):
    """Stages in their order, with a plan, and what a server needs to run them: places, drawings,
    and the texts of the researcher's page. All of it follows from the plan and the participants'
    states.

    Attributes:
        PLAN: class of its plans.
        PACKAGE: name of the package that has its templates and tables.
        DATA: what an export holds, in words.
        STATE: the class of its states.
        STAGES: from the consent on.
        plan: the stored plan, with ``texts``.
    """

    PLAN: ClassVar[type[StoredPlan]]
    PACKAGE: ClassVar[str]
    DATA: ClassVar[str]
    STATE: ClassVar[type[Any]]
    STAGES: ClassVar[tuple[Stage[Any, Any], ...]]

    plan: P

    @classmethod
    @abstractmethod
    def of(cls, plan: P) -> Self:
        """Makes the flow of a plan."""

    # Places --------------------------------------------------------------------------------------

    @abstractmethod
    def admit(self, person: Participant[S], people: People) -> dict[str, Any]:
        """What the consent event must contain from outside the state, such as a place.

        Args:
            person: who consents.
            people: everybody, in the order in which they came.

        Raises:
            Full: nobody can be admitted now.
        """

    def readmit(self, person: Participant[S], people: People) -> dict[str, Any]:
        """What the return event of a participant who was silent for too long must contain."""
        return {}

    @abstractmethod
    def admitted(self, payload: Mapping[str, Any]) -> dict[str, Any]:
        """What a consent that agrees changes in the state.

        Raises:
            Refused: this participant cannot take part.
        """

    def forget(self) -> None:
        """Clears the caches, because somebody's data was erased."""
        State.from_text.cache_clear()

    # What a server shows -------------------------------------------------------------------------

    @property
    def cells(self) -> tuple[str, ...]:
        """Parts of the plan that a researcher may look at, as a participant meets them."""
        return ("a participant",)

    @abstractmethod
    def drawn(self, what: Any) -> tuple[Way | None, int, Sequence[str]]:
        """What :func:`xplain.people.map_svg.picture` draws for what a template asks for (hashable):
        the way, how much of it, and names of the items that are off the map."""

    @property
    def titles(self) -> dict[str, str]:
        """Titles of the stages' pages."""
        return {stage: self.words[stage] for stage in self.stages[:-1]}

    def about(self, state: S, blinded: bool) -> dict[str, str]:
        """What the researcher's page says of a participant, by column.

        Args:
            state: of the participant.
            blinded: whether that may tell who gets what.
        """
        step = self.step_of(state)
        return {"Stage": state.stage.replace("_", " ") + (f", {step}" if step else "")}

    @abstractmethod
    def step_of(self, state: S) -> str:
        """How far they are within a stage of several pages; empty elsewhere."""

    def announcement(self) -> str:
        """What a start of the server says of the plan."""
        return ""

    # Stages --------------------------------------------------------------------------------------

    @property
    def words(self) -> Mapping[str, str]:
        """The texts of the pages."""
        return self.plan.texts.words  # type: ignore[attr-defined]

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages that the plan has, in order; done is the last."""
        return (*(one.name for one in self.STAGES if one.wanted(self.plan)), "done")

    def stage(self, name: str) -> Stage[Any, S] | None:
        """The stage with a name; None for ends."""
        return next((one for one in self.STAGES if one.name == name), None)

    def part(self, name: str) -> str:
        """Which of the ordered stages a stage belongs to; an end to itself."""
        here = self.stage(name)
        return here.WITHIN or name if here else name

    def asking(self, state: S) -> S:
        """The state whose page an answer is to: of somebody who was timed out, the one before."""
        return replace(state, stage=str(state.left), left=None) if state.paused else state

    def waits_for(self, state: S) -> str:
        """The kind of event that goes on from here; "" from ends that nothing follows."""
        here = self.stage(state.stage)
        return here.kind if here else "return" if state.paused else ""

    def after(self, state: S, **changes: Any) -> S:
        """The next stage that the plan has."""
        names, state = [one.name for one in self.STAGES], replace(state, **changes)
        later = self.STAGES[names.index(state.stage) + 1 :]
        found = next((one for one in later if one.wanted(self.plan)), None)
        return found.enter(self, state) if found else state.to(stage="done")

    def advance(self, state: S, kind: str, payload: Mapping[str, Any]) -> S:
        """The state after an event.

        Raises:
            Refused: the event does not fit the stage, or its payload is not what the stage asks
                for.
        """
        here = self.stage(state.stage)
        if state.paused and kind == "return":
            return self.asking(state)
        if kind == "withdraw" and (here or state.paused):
            return state.to(stage="withdrawn", left=None)
        if here is None:
            raise Refused(self.words["ended"])
        if kind == "time_out":
            return replace(state, stage="timed_out", left=state.stage)
        if kind != here.kind:
            raise Refused(self.words["other_page"])
        return here.advance(self, state, payload)

    def view(self, state: S) -> dict[str, Any]:
        """What the participant sees now, in plain values. Nothing of the type, the condition, the
        belief or the right answers is in it."""
        here = self.stage(state.stage)
        view = {"stage": state.stage, "sequence": state.accepted, "wrong": state.wrong}
        return view | (here.view(self, state) if here else {})

    def read(self, state: S, kind: str, form: Form) -> dict[str, Any]:
        """The payload of an event from what a browser sent."""
        here = self.stage(state.stage)
        return here.read(self, state, form) if here and here.kind == kind else {}


CANNOT_TELL = 2
"""The answer of somebody who cannot tell whether a step makes sense: no evidence of anything."""
FACTS_AT_ONCE = 3
"""Facts on one screen of a briefing."""


class Consent(Stage[F, S]):
    """The consent, which is to the current text."""

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """Whether they agree, and the hash of the text that they read."""
        return {"agree": small(form.get("agree")), "text": form.get("text", "")[:64]}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Moves to the next stage, or to a polite end."""
        agreed = choice(payload.get("agree"), 2, flow.words["consent_missing"])
        if payload.get("text") != flow.plan.texts.consent_hash:
            raise Refused(flow.words["consent_changed"])
        if not agreed:
            return state.to(stage="declined")
        return flow.after(state, **flow.admitted(payload))


class Briefing(Stage[F, S]):
    """Screens to read: the task, a few facts a screen, what participants are asked to do."""

    def facts(self, flow: F, state: S) -> Mapping[str, Sequence[str]]:
        """Key of a heading in the words: sentences below it."""
        return {}

    def screens(self, flow: F, state: S) -> list[tuple[str, tuple[str, ...]]]:
        """Key of the heading, and the sentences, of each screen."""
        facts = [
            (heading, tuple(sentences[first : first + FACTS_AT_ONCE]))
            for heading, sentences in self.facts(flow, state).items()
            for first in range(0, len(sentences), FACTS_AT_ONCE)
        ]
        return [("introduction", ()), *facts, ("asked_for", ())]

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """Shows the open screen."""
        screens = self.screens(flow, state)
        heading, sentences = screens[state.part]
        view = {"screen": heading, "sentences": sentences, "screen_number": state.part + 1}
        briefing = {"briefing": sentences} if heading == "told_to_you" else {}
        return view | {"screen_count": len(screens)} | briefing

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Moves to the next screen, or to the next stage."""
        if state.part + 1 < len(self.screens(flow, state)):
            return state.to(part=state.part + 1)
        return flow.after(state, part=0, wrong=False)


class OneLabel(Stage[F, S]):
    """A page with one step to label."""

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """Reads the label."""
        return {"label": small(form.get("label"))}

    def label(self, flow: F, payload: Mapping[str, Any]) -> int:
        """1, 0 or CANNOT_TELL.

        Raises:
            Refused: nothing was chosen.
        """
        return choice(payload.get("label"), CANNOT_TELL + 1, flow.words["label_missing"])


class Practice(OneLabel[F, S]):
    """One step twice: without the message that explains it (label 0), and with it (label 1)."""

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Moves on to the other half, or to the next stage; stays until the label is right."""
        right = self.label(flow, payload) == state.part
        if right and state.part:
            return flow.after(state, wrong=False)
        return state.to(part=int(right or state.part), wrong=not right)


class LookingAhead(OneLabel[F, S]):
    """A step that looks odd and is right because of later steps. The later steps are shown after
    any answer except 1."""

    def wanted(self, plan: Any) -> bool:
        """Whether the task has such a step."""
        return plan.ahead is not None

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """Shows the step, and after a wrong answer the later steps too."""
        steps = flow.plan.ahead.steps
        return {"action": steps[0], "later": steps[1:] if state.wrong else ()}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Moves on once the step makes sense to the participant."""
        if self.label(flow, payload) == 1:
            return flow.after(state, wrong=False)
        return state.to(wrong=True)


@dataclass(frozen=True)
class QuestionStage(Stage[F, S]):
    """The lab's own questions.

    Attributes:
        of: the plan's field that has them.
        missed: the end for participants who answer wrongly; "" lets them continue.
    """

    of: str = "asked"
    missed: str = ""

    def wanted(self, plan: Any) -> bool:
        """Whether the plan has such questions."""
        return bool(getattr(plan, self.of))

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """Shows the questions."""
        return {"asked": getattr(flow.plan, self.of)}

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """Reads the answers by name."""
        asked = getattr(flow.plan, self.of)
        return {one.name: one.read(form.get(one.name, "")) for one in asked}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Checks that each question allows its answer, and moves on."""
        asked: Sequence[LabQuestion] = getattr(flow.plan, self.of)
        for one in asked:
            if problem := one.problem(payload.get(one.name, ""), flow.words):
                raise Refused(problem)
        if payload.keys() - {one.name for one in asked}:
            raise Refused(flow.words["not_understood"])
        if self.missed and any(q.right and payload.get(q.name) != q.right for q in asked):
            return state.to(stage=self.missed)
        return flow.after(state)


# Answers ----------------------------------------------------------------------------------------


def small(text: object) -> int | None:
    """A whole number 0 … 999 in plain digits, else None."""
    if isinstance(text, str) and 0 < len(text) <= 3 and text.isascii() and text.isdigit():
        return int(text)
    return None


def choice(value: object, count: int, otherwise: str) -> int:
    """An integer 0 … count − 1 (true booleans count as what they are).

    Raises:
        Refused: anything else, with the words ``otherwise``.
    """
    if not isinstance(value, int) or not 0 <= value < count:
        raise Refused(otherwise)
    return int(value)


def choices(values: object, counts: Sequence[int], otherwise: str) -> tuple[int, ...]:
    """One choice a place, each from 0 … its count − 1.

    Raises:
        Refused: as :func:`choice`, or another number of them.
    """
    if not isinstance(values, list) or len(values) != len(counts):
        raise Refused(otherwise)
    pairs = zip(values, counts, strict=True)
    return tuple(choice(value, count, otherwise) for value, count in pairs)
