"""The classes that all plans use, and the stored form of plans.

A plan is a value. The first start stores the plan in the database, and every later start reads it
there. So neither a restart nor a change of code or configuration changes a running study.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

import pydantic

from xplain.domains.base import Parameter, Scene
from xplain.errors import InputError, Refused
from xplain.storage import decode, encode

T = TypeVar("T")
Told = tuple[tuple[str, ...], ...]
"""The sentences of each transition or state; or an empty tuple."""
Way = tuple[tuple[tuple[int, int], tuple[int, int]], ...]
"""The cells before and after each transition."""


@dataclass(frozen=True)
class Picture:
    """An image of a transition: its media type, its bytes in base 64, and a text version for screen
    readers."""

    media: str
    content: str
    alt: str = ""


@dataclass(frozen=True)
class Clip:
    """A transition, as pages show it.

    Attributes:
        phrase: the robot's action.
        way: the cells before and after the transition on the map; or none.
        situation: sentences about the state before the transition.
        gone: names of the items that are no longer on the map before the transition.
        changes: effects of the transition, for domains without a map.
        picture: an image, for a lab's own transitions.
    """

    phrase: str
    way: Way = ()
    situation: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()
    picture: Picture | None = None

    def reword(self, in_words: Callable[[str], str]) -> Clip:
        """Returns the clip with all texts passed through ``in_words``."""
        situation, gone, changes = (
            tuple(map(in_words, told)) for told in (self.situation, self.gone, self.changes)
        )
        return Clip(in_words(self.phrase), self.way, situation, gone, changes, self.picture)


@dataclass(frozen=True)
class Ahead:
    """A practice step that looks wrong, but is right because of later steps.

    Attributes:
        steps: the step and the following steps up to the reason, as sentences.
        way: the cells of these steps on the map.
    """

    steps: tuple[str, ...]
    way: Way


@dataclass(frozen=True)
class Example:
    """The practice: an action that is not part of the task.

    Attributes:
        belief: a sentence under which the action makes no sense.
        action: the robot's action, as a sentence.
        message: a sentence under which the action makes sense.
    """

    belief: str
    action: str
    message: str


EDIT = "[EDIT"
"""Start of a text that a lab has to fill in."""
_NUMBER = re.compile(r"([+-]?\d{1,9})([.]0*)?")
"""A whole number in the digits of any script."""


@pydantic.dataclasses.dataclass(frozen=True, config={"strict": True, "extra": "forbid"})
class LabQuestion:
    """A question from the lab to the participant.

    This class alone defines the kinds of answers: the browser checks :attr:`attributes`, and the
    server uses :meth:`read`.

    Attributes:
        name: the column in the data.
        label: the text of the question.
        kind: kind of the answer.
        choices: the answers of a choice.
        low, high: bounds of a number, ends of a scale.
        max_length: maximum length of a text, in characters as browsers count them (UTF-16 units).
        ends: meanings of the two ends of a scale; or none.
        required: True if an answer is needed.
        right: the answer that shows that a person read the question. Before the briefing, any other
            answer ends the study. "" means that there is no right answer.
    """

    name: str
    label: str
    kind: Literal["number", "choice", "text", "scale"] = "text"
    choices: tuple[str, ...] = ()
    low: int = 0
    high: int = 120
    max_length: Annotated[int, pydantic.Field(ge=1, le=20_000)] = 500
    ends: tuple[str, ...] = ()
    required: bool = False
    right: str = ""

    def __post_init__(self) -> None:
        """Raises InputError if a value is missing that this kind of question needs."""
        high, right, options = self.high, self.right, self.options
        # key: value, True if the value is not allowed, what is allowed
        rules: list[tuple[str, object, bool, str]] = [
            ("choices", [], self.kind == "choice" and not self.choices, "at least one choice"),
            ("high", high, self.kind == "scale" and not 1 <= high - self.low <= 10, "at most 10 "
             "above low"),
            ("ends", [*self.ends], len(self.ends) not in (0, 2), "two words, for low and high"),
            ("right", right, right not in ("", *(options or (right,))), ", ".join(options)),
        ]  # fmt: skip
        for key, value, wrong, allowed in rules:
            if wrong:
                raise InputError(f"questions.{self.name}.{key}", value, allowed)

    @property
    def options(self) -> tuple[str, ...]:
        """The possible answers of a choice or a scale."""
        points = map(str, range(self.low, self.high + 1))
        return tuple(points) if self.kind == "scale" else self.choices

    @property
    def needed(self) -> bool:
        """True if an answer is needed."""
        return self.required or bool(self.right)

    @property
    def field(self) -> str:
        """Name of the question's field, which differs from all other names in a form or page."""
        return f"answer_{self.name}"

    @property
    def attributes(self) -> dict[str, str | int]:
        """HTML attributes of the question's field."""
        own: dict[str, dict[str, str | int]] = {
            "number": {"type": "number", "min": self.low, "max": self.high},
            "text": {"maxlength": self.max_length},
        }
        return ({"required": "required"} if self.needed else {}) | own.get(self.kind, {})

    def read(self, text: str, words: Mapping[str, str]) -> str:
        """Reads an answer: no surrounding blanks, lines end in a line feed, whole numbers have no
        ".0".

        Raises:
            Refused: the answer is not allowed; participants read the error.
        """
        text = text.replace("\r\n", "\n").translate(_NO_TEXT).strip()
        whole = _NUMBER.fullmatch(text.replace("\N{MINUS SIGN}", "-"))
        if self.kind == "number" and whole:
            text = str(int(whole[1]))
        allowed = whole is not None and self.low <= int(whole[1]) <= self.high
        # word that says what is wrong: True if it is wrong
        rules = {
            "too_long": len(text.encode("utf-16-le", "replace")) // 2 > self.max_length,
            "answer_this": self.needed and not text,
            "choose_one": bool(text and self.options) and text not in self.options,
            "whole_number": bool(text) and self.kind == "number" and not allowed,
        }
        about = {"label": self.label, "most": self.max_length, "low": self.low, "high": self.high}
        for key, wrong in rules.items():
            if wrong:
                raise Refused(words[key].format(**about))
        return text


_NO_TEXT = dict.fromkeys({*range(32)} - {*map(ord, "\t\n")})
"""Control characters such as NUL, at which some programs cut a text; they are removed."""


def make_typed(kind: type[T], key: str, given: Mapping[str, Any]) -> T:
    """Makes a value of a class whose fields pydantic checks strictly.

    Raises:
        InputError: a key is unknown, or a value has another type; ``yes`` in YAML, for example, is
            a boolean and not a text.
    """
    try:
        text = json.dumps(given, allow_nan=False, default=str)
        return pydantic.TypeAdapter(kind).validate_json(text)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        reason = first.get("ctx", {}).get("error")
        if isinstance(reason, InputError):
            raise reason from None
        wanted = first["msg"].removeprefix("Input should be ")
        if "string" in first["type"]:
            wanted = f'a text in quotation marks, such as "{first["input"]}"'
        where = ".".join(map(str, (key, *first["loc"])))
        raise InputError(where, first["input"], wanted) from None


def lab_questions(*given: Sequence[Mapping[str, Any]]) -> list[tuple[LabQuestion, ...]]:
    """Makes the lab's own questions from their configuration: one tuple for each page.

    Raises:
        InputError: a question is invalid, or two questions have one name (an answer would be lost).
    """
    pages = [
        tuple(make_typed(LabQuestion, f"questions.{one.get('name')}", one) for one in page)
        for page in given
    ]
    names = [question.name for page in pages for question in page]
    for name in names:
        if names.count(name) > 1:
            raise InputError("questions.name", name, "one name for each question, over all pages")
    return pages


@dataclass(frozen=True)
class Texts:
    """The texts of the pages, from the configuration; paragraphs are tuples.

    Attributes:
        title, contact, consent, introduction, task: the text of the page or section of this name.
        debriefing: shown at every end.
        words: all other texts, by key.
    """

    title: str
    consent: tuple[str, ...]
    introduction: tuple[str, ...]
    task: tuple[str, ...]
    debriefing: tuple[str, ...]
    contact: str
    words: Mapping[str, str]

    @property
    def consent_hash(self) -> str:
        """SHA-256 of the consent text, to prove the text to which a participant agreed."""
        return hashlib.sha256("\n".join(self.consent).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class StoredPlan:
    """The fields of all plans. A plan is stored as JSON, with exact floats.

    Attributes:
        OF: kind of the plan, in words.
        seed: seed of every draw.
        domain: name of the task.
        texts: texts of the pages.
        example: the practice.
        before: the lab's own questions before a briefing.
        asked: the lab's own questions at the end.
        facts: [n] facts, as people read them.
        scene: the map, or None.
        icons: {name of an item on the map: SVG path of its icon, in a box of 24 × 24}; may be
            incomplete.
        shown: the transitions that pages show.
        ahead: the practice step that looks wrong, but is right because of later steps; None if the
            texts have no such step.
        config: the configuration that made the plan, as a record.
    """

    OF: ClassVar[str]

    seed: int
    domain: str
    texts: Texts
    example: Example
    before: tuple[LabQuestion, ...] = ()
    asked: tuple[LabQuestion, ...]
    facts: tuple[Parameter, ...]
    scene: Scene | None
    icons: Mapping[str, str]
    shown: tuple[Clip, ...]
    ahead: Ahead | None = None
    config: Mapping[str, Any]

    @property
    def unedited(self) -> bool:
        """True if the consent or the introduction still has parts that a lab has to fill in."""
        return any(EDIT in text for text in (*self.texts.consent, *self.texts.introduction))

    @cached_property
    def text(self) -> str:
        """The plan as canonical JSON."""
        value = encode(self) | {"of": self.OF}
        return json.dumps(value, sort_keys=True, ensure_ascii=False, separators=(",", ":"))

    @cached_property
    def hash(self) -> str:
        """SHA-256 of :attr:`text`; identifies the plan in the data."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Reads a plan from its :attr:`text`.

        Raises:
            InputError: the plan is of another kind.
        """
        value = json.loads(text)
        if value.pop("of", None) != cls.OF:
            raise InputError("database", "its plan", f"the plan of {cls.OF}")
        return decode(cls, value)
