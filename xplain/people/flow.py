"""A flow: the stages that lead a participant from the consent to the end, as a pure state machine.

``flow.advance(state, kind, payload)`` is the only change of a state. It uses no clock, no storage
and no HTTP; values from outside (a slot, a number, the orders of questions) are in the consent
event. The same events give the same states, and the replay checks this. A stage has one page:
:meth:`Stage.view` makes its content, :meth:`Stage.read` reads its form, and :meth:`Stage.advance`
gives the next state.

From every stage a participant may come to an end: declined, withdrawn, timed_out, or an end of this
flow. After timed_out the participant may return to the earlier stage.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, ClassVar, Generic, NamedTuple, Self, TypeVar

from xplain.errors import Refused
from xplain.people.plan import LabQuestion, StoredPlan, Way
from xplain.storage import decode

Form = Any
"""A browser's form: a ``FormData`` of texts. It is not trusted."""
Fields = list[tuple[str, str]]
"""Names and values of a form."""


@dataclass(frozen=True)
class State:
    """The state of a participant. The default values are the start.

    Attributes:
        ENDS: final stages besides "done" and "erased".
        stage: stage of the flow.
        accepted: number of accepted answers, which is also the number of the open page. Events of
            the server (a time-out, a return) are not counted.
        part: index of the open page within a stage of several pages: a screen of the briefing, or
            the first or second half of the practice.
        wrong: True if the last answer of a practice or a test was wrong.
        left: the stage in which the participant was timed out.
        cell: index of the cell (:attr:`Flow.cells`) that a preview shows; None for people.
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
        """True if no event can follow."""
        return self.stage in ("done", "erased", *self.ENDS)

    @property
    def paused(self) -> bool:
        """True if the participant was timed out and may return to the earlier stage."""
        return self.stage == "timed_out"

    @property
    def text(self) -> str:
        """The state as JSON, for the store."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Reads a state from its :attr:`text`, exactly."""
        return decode(cls, json.loads(text))

    def to(self, **changes: Any) -> Self:
        """Returns the changed state after one more accepted event."""
        return replace(self, accepted=self.accepted + 1, **changes)


S = TypeVar("S", bound=State)


class Conflict(Refused):
    """The answer is to a page or question that is not open, or is a second, different answer."""


class Full(Refused):
    """The study is full now: as many people take part as the plan allows."""


STREAMS = ("person", "pilot", "bot")
"""Kinds of participants. The way of entry decides the kind; an analysis never mixes kinds."""


class Event(NamedTuple):
    """A row of the log. The codebook explains its columns."""

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


@dataclass(frozen=True)
class Participant(Generic[S]):
    """A participant, as their events describe them.

    Attributes:
        id: the id in every table.
        kind: class of the state.
        events: the events in order, from the arrival to the latest; a reader may leave out others.
    """

    id: str
    kind: type[S]
    events: tuple[Event, ...]

    @cached_property
    def state(self) -> S:
        """The participant's current state."""
        return self.kind.from_text(next(e.state for e in reversed(self.events) if e.state))

    @property
    def about(self) -> Mapping[str, Any]:
        """The payload of the arrival event: ``number``, 1, 2, … in order of arrival; ``stream``;
        and ``entry``, which is how the participant entered, such as "platform"."""
        return self.events[0].payload

    @property
    def number(self) -> int:
        """1, 2, … in order of arrival."""
        return int(self.about["number"])

    @property
    def stream(self) -> str:
        """The participant's stream: person, pilot or bot."""
        return str(self.about["stream"])

    @property
    def identity(self) -> dict[str, Any]:
        """Identifiers, which no export contains: the keyed hashes ``key`` and ``session``, the
        completion ``code``, and ``kept``, the platform's ids without a hash."""
        own = (e.payload for e in self.events if e.source == "identity")
        return {key: value for payload in own for key, value in payload.items()}

    @property
    def shown(self) -> int:
        """The number of the last page that was rendered; −1 before the first page."""
        return max((e.source_sequence for e in self.events if e.source == "shown"), default=-1)

    def answers(self, kind: str) -> list[Event]:
        """Returns the accepted answers of a kind, in order."""
        return [e for e in self.events if e.source == "protocol" and e.kind == kind]

    def first(self, kind: str) -> Mapping[str, Any]:
        """Returns the payload of the first answer of this kind; empty if there is none."""
        return next((event.payload for event in self.answers(kind)), {})


People = Sequence["Participant[Any]"]


F = TypeVar("F", bound="Flow[Any, Any]")
P = TypeVar("P")


@dataclass(frozen=True)
class Stage(Generic[F, S]):
    """A page, and the change of state that its answer makes.

    Attributes:
        name: name of the stage, its template and its title.
        kind: kind of the event that the stage waits for.
        needs: returns what a plan has for this stage, such as questions; a plan without it has no
            such stage.
        within: the stage that contains this stage; "" for a stage of the main order.
    """

    name: str
    kind: str
    needs: Callable[[Any], Any] = bool
    within: str = ""

    def enter(self, flow: F, state: S) -> S:
        """Returns the state after the stage is entered."""
        return state.to(stage=self.name)

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """Makes the content of the page, in plain values."""
        return {}

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """Reads the payload of the page's event from a form.

        Raises:
            Refused: a value is missing or not allowed.
        """
        return {}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Returns the state after the page's event, with a payload of :meth:`read`."""
        return flow.after(state)


@dataclass(frozen=True)
class Flow(ABC, Generic[P, S]):
    """Stages in order, with a plan. A flow also assigns each participant (to a type and condition,
    or to a role), and makes the drawings and the texts of the researcher's page. Everything follows
    from the plan and the states.

    Attributes:
        PLAN: class of its plans.
        PACKAGE: name of the package with its templates and tables.
        STATE: class of its states.
        STAGES: stages after the consent, in order.
        plan: the stored plan, with ``texts``.
    """

    PLAN: ClassVar[type[StoredPlan]]
    PACKAGE: ClassVar[str]
    STATE: ClassVar[type[Any]]
    STAGES: ClassVar[tuple[Stage[Any, Any], ...]]

    plan: P

    @classmethod
    def of(cls, plan: P) -> Self:
        """Makes the flow of a plan."""
        return cls(plan)

    # Places --------------------------------------------------------------------------------------

    @abstractmethod
    def admit(self, person: Participant[S], people: People) -> dict[str, Any]:
        """Returns values for the consent event that do not follow from the state, such as a type
        and a condition. Values with the name of a field of the state become part of the state.

        Args:
            person: the participant who consents.
            people: all participants, in order of arrival.

        Raises:
            Full: the study is full now.
        """

    def readmit(self, person: Participant[S], people: People) -> dict[str, Any]:
        """Returns the payload of the event "return", which is stored when a timed-out participant
        comes back: the fields of the state that change, such as a place.

        Args:
            person: the participant who comes back.
            people: all participants, in order of arrival.
        """
        return {}

    def forget(self) -> None:
        """Clears the caches after an erasure."""

    # What a server shows -------------------------------------------------------------------------

    @property
    def cells(self) -> tuple[str, ...]:
        """Names of the cells (each a type with a condition) that a researcher can preview."""
        return ("a participant",)

    @abstractmethod
    def find_drawing(self, what: Any) -> tuple[Way | None, int, Sequence[str]]:
        """Finds what to draw on the map for a template's argument ``what`` (hashable).

        Returns:
            The arguments of :func:`xplain.people.map_svg.picture`: the cells before and after each
            transition, the number of transitions to draw, and the names of items that are no longer
            on the map.
        """

    def about(self, state: S) -> dict[str, str]:
        """Returns the columns of the researcher's page about a participant that blinded researchers
        must not see, such as a type."""
        return {}

    def announcement(self) -> str:
        """Describes the plan at the start of the server."""
        return ""

    # Stages --------------------------------------------------------------------------------------

    @property
    def words(self) -> Mapping[str, str]:
        """The texts of the pages."""
        return self.plan.texts.words  # type: ignore[attr-defined]

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the plan's stages, in order; "done" is the last."""
        return (
            *(one.name for one in self.STAGES if not one.within and one.needs(self.plan)),
            "done",
        )

    def stage(self, name: str) -> Stage[Any, S] | None:
        """Finds the stage with a name; None for ends."""
        return next((one for one in self.STAGES if one.name == name), None)

    def part(self, name: str) -> str:
        """Names the main stage that contains a stage; an end contains itself."""
        here = self.stage(name)
        return here.within or name if here else name

    def asking(self, state: S) -> S:
        """Returns the state that an answer refers to: the earlier state if the participant was
        timed out."""
        return replace(state, stage=str(state.left), left=None) if state.paused else state

    def waits_for(self, state: S) -> str:
        """Returns the kind of the next event; "" at final ends."""
        here = self.stage(state.stage)
        return here.kind if here else "return" if state.paused else ""

    def after(self, state: S, **changes: Any) -> S:
        """Moves to the plan's next stage."""
        names, state = self.stages, replace(state, **changes)
        found = self.stage(names[names.index(state.stage) + 1])
        return found.enter(self, state) if found else state.to(stage="done")

    def advance(self, state: S, kind: str, payload: Mapping[str, Any]) -> S:
        """Returns the state after an event.

        Raises:
            Refused: the event does not fit the stage.
        """
        here = self.stage(state.stage)
        if state.paused and kind == "return":
            return replace(self.asking(state), **payload)
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
        """Makes the content of the participant's page, in plain values, without the type, the
        condition, the belief and the right answers."""
        here = self.stage(state.stage)
        view = {"stage": state.stage, "sequence": state.accepted, "wrong": state.wrong}
        return view | (here.view(self, state) if here else {})

    def read(self, state: S, kind: str, form: Form) -> dict[str, Any]:
        """Reads the payload of an event from a browser's form.

        Raises:
            Refused: the page refuses a value.
        """
        here = self.stage(state.stage)
        return here.read(self, state, form) if here and here.kind == kind else {}


CANNOT_TELL = 2
"""The answer "I cannot tell whether the step makes sense". It is no evidence."""
FACTS_AT_ONCE = 3
"""Maximum number of facts on one screen of a briefing."""


class Consent(Stage[F, S]):
    """The consent to the current text."""

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """Reads the decision (``agree``: 1 or 0), and the hash of the text that was shown
        (``text``)."""
        agreed = pick(form.get("agree"), 2, flow.words["consent_missing"])
        return {"agree": agreed, "text": form.get("text", "")[:64]}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Moves to the next stage, or to the end "declined"."""
        if payload.get("text") != flow.plan.texts.consent_hash:
            raise Refused(flow.words["consent_changed"])
        if not payload["agree"]:
            return state.to(stage="declined")
        assigned = payload.keys() & {one.name for one in fields(state)}
        return flow.after(state, **{key: payload[key] for key in assigned})


class Briefing(Stage[F, S]):
    """Screens to read: the task, a few facts on each screen, and the participants' job."""

    def facts(self, flow: F, state: S) -> Mapping[str, Sequence[str]]:
        """Returns the sentences of the briefing: {key of a heading: the sentences below this
        heading}."""
        return {}

    def screens(self, flow: F, state: S) -> list[tuple[str, tuple[str, ...]]]:
        """Lists the screens: each has the key of its heading, and its sentences."""
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
        """Reads the label: 1, 0 or CANNOT_TELL."""
        return {"label": pick(form.get("label"), CANNOT_TELL + 1, flow.words["label_missing"])}


class Practice(OneLabel[F, S]):
    """The same step twice: without the message that explains it (label 0), and with it (label
    1)."""

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """Shows the example; ``part`` is 1 if the message is given."""
        return {"part": state.part, "example": flow.plan.example}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Moves to the other half or the next stage after a right label; stays after a wrong
        label."""
        right = payload["label"] == state.part
        if right and state.part:
            return flow.after(state, wrong=False)
        return state.to(part=int(right or state.part), wrong=not right)


class LookingAhead(Practice[F, S]):
    """A step that looks wrong, but is right because of later steps. It follows the second half of
    the practice, so the right label is 1, too. The later steps are shown after another label."""

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """Shows the step, and after a wrong answer the later steps too."""
        steps = flow.plan.ahead.steps
        return {"action": steps[0], "later": steps[1:] if state.wrong else ()}


@dataclass(frozen=True)
class QuestionStage(Stage[F, S]):
    """The lab's own questions.

    Attributes:
        needs: returns the plan's questions.
        missed: the end that follows a wrong answer; "" lets the participant continue.
    """

    needs: Callable[[Any], Sequence[LabQuestion]] = attrgetter("asked")
    missed: str = ""

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """Shows the questions."""
        return {"asked": self.needs(flow.plan)}

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """Reads the answers by name."""
        asked = self.needs(flow.plan)
        return {one.name: one.read(form.get(one.field, ""), flow.words) for one in asked}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Moves on, or to the end after a wrong answer."""
        asked = self.needs(flow.plan) if self.missed else ()
        if any(one.right and payload[one.name] != one.right for one in asked):
            return state.to(stage=self.missed)
        return flow.after(state)


# Answers ----------------------------------------------------------------------------------------


def pick(text: str | None, count: int, otherwise: str) -> int:
    """Reads a choice, a whole number 0 … count − 1 in plain digits, from a field.

    Raises:
        Refused: any other text; the error has the text ``otherwise``.
    """
    digits = text or ""
    if not (digits.isascii() and digits.isdigit() and len(digits) <= 3 and int(digits) < count):
        raise Refused(otherwise)
    return int(digits)
