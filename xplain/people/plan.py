"""Parts of any plan, and its stored form.

A plan is a value: it is stored in the database at the first start and read from there ever after,
so that neither a restart nor a change of code or configuration changes what is running.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

from xplain.domains.base import Parameter, Scene
from xplain.errors import InputError, one_of, sentence
from xplain.storage import decode, encode

Told = tuple[tuple[str, ...], ...]
"""Sentences of each of several transitions or states; or none."""
Way = tuple[tuple[tuple[int, int], tuple[int, int]], ...]
"""Of each transition the cells before and after it."""


@dataclass(frozen=True)
class Fact:
    """A parameter of the domain, as people meet it.

    Attributes:
        name: of the parameter and of its message.
        message: the sentence that tells the robot's value.
        belief: the sentence of someone who holds it wrong.
    """

    name: str
    message: str
    belief: str


def facts_of(parameters: Sequence[Parameter]) -> tuple[Fact, ...]:
    """The parameters' sentences.

    Raises:
        InputError: a parameter lacks the sentence of those who hold it wrong.
    """
    wanted = "a sentence that a user who holds it wrong would say; the pages need it"
    for parameter in parameters:
        sentence(f"domain.values.{parameter.name}.belief", parameter.belief, wanted)
    return tuple(Fact(p.name, p.message, p.belief) for p in parameters)


@dataclass(frozen=True)
class Picture:
    """An image of a transition: its media type, its bytes in base 64, and what it shows, in words
    for those who do not see it."""

    media: str
    content: str
    alt: str = ""


Pictures = tuple[Picture | None, ...]
"""Of several transitions; None where one has no image."""


@dataclass(frozen=True)
class Ahead:
    """A step for the practice that looks odd and is right because of what comes later.

    Attributes:
        steps: the step, and those that follow until the reason is seen, as sentences.
        way: of these on the map.
    """

    steps: tuple[str, ...]
    way: Way


@dataclass(frozen=True, kw_only=True)
class Task:
    """What people are shown of a task; phrases not yet in a lab's words.

    Attributes:
        name: of the task.
        facts: [n] of the domain, or of a lab's own: only their sentences tell.
        scene, changes, pictures: see :class:`StoredPlan`.
    """

    name: str
    facts: tuple[Parameter, ...]
    scene: Scene | None = None
    changes: Told = ()
    pictures: tuple[Picture | None, ...] = ()


FORM = ("token", "sequence", "kind", "ms", "action", "method", "elements", "submit")
"""Names that forms and their own fields have."""


@dataclass(frozen=True)
class LabQuestion:
    """One question of the lab's own to the participant.

    Attributes:
        name: the column in the data.
        label: what the participant reads.
        kind: "number", "choice", "text" or "scale".
        choices: of a choice.
        low, high: bounds of a number, ends of a scale.
        max_length: of a text, in characters.
        ends: what the two ends of a scale mean; or none.
        required: whether it has to be answered.
        right: the one answer of those who read; others end here, if it is asked before. "" is none.
    """

    name: str
    label: str
    kind: str = "text"
    choices: tuple[str, ...] = ()
    low: int = 0
    high: int = 120
    max_length: int = 500
    ends: tuple[str, ...] = ()
    required: bool = False
    right: str = ""

    def __post_init__(self) -> None:
        """Raises InputError: an unknown kind, or what the kind needs is not there."""
        key = f"questions.{self.name}"
        one_of(f"{key}.kind", self.kind, ("number", "choice", "text", "scale"))
        if self.kind == "choice" and not self.choices:
            raise InputError(f"{key}.choices", [], "at least one choice")
        if self.kind == "scale" and not 1 <= self.high - self.low <= 10:
            raise InputError(f"{key}.high", self.high, "at most 10 above low")
        if len(self.ends) not in (0, 2):
            raise InputError(f"{key}.ends", list(self.ends), "two words, for low and high")
        if self.right and self.options and self.right not in self.options:
            raise InputError(f"{key}.right", self.right, ", ".join(self.options))

    @classmethod
    def of(cls, question: Mapping[str, Any]) -> LabQuestion:
        """A question as the configuration has it.

        Raises:
            InputError: a choice that YAML takes for no text, or a name that a form has already.
        """
        key, name = f"questions.{question.get('name')}", str(question.get("name"))
        for one in (*question.get("choices", ()), *question.get("ends", ())):
            if not isinstance(one, str):
                wanted = f'texts in quotation marks, such as "{one}"'
                raise InputError(f"{key}.choices", one, wanted)
        if name in FORM:
            raise InputError("questions.name", name, f"another name; forms have {', '.join(FORM)}")
        lists = {key: tuple(question.get(key, ())) for key in ("choices", "ends")}
        return cls(**{**question, **lists})

    @property
    def options(self) -> tuple[str, ...]:
        """What can be chosen, of a choice or a scale."""
        if self.kind == "scale":
            return tuple(str(point) for point in range(self.low, self.high + 1))
        return self.choices

    @property
    def needed(self) -> bool:
        """Whether it has to be answered."""
        return self.required or bool(self.right)


@dataclass(frozen=True)
class Texts:
    """What the pages say, from config; paragraphs as tuples.

    Attributes:
        title, contact, consent, introduction, task: as their names say.
        debriefing: shown wherever a part ends.
        words: everything else, by key.
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
        """SHA-256 of the consent text: what exactly was agreed to."""
        return hashlib.sha256("\n".join(self.consent).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class StoredPlan:
    """What any plan has. It is stored as JSON, in which floats survive to the last bit.

    Attributes:
        VERSION: of the stored form; a database of another version is refused.
        OF: what it is the plan of.
        seed: of all that is drawn.
        domain: name of the task.
        texts: what the pages say.
        asked: the lab's own questions at the end.
        facts: [n], as people meet them.
        scene: the map, or None.
        icons: {name of an item on the map: path of its icon in a box of 24}; may lack some.
        changes: [m] what each transition changes, for domains without a map; or none.
        pictures: of own transitions, None where one has no image; or none.
        ahead: of the practice; None where the texts have no such step.
        config: the configuration that it was made from, for the record.
    """

    VERSION: ClassVar[int | str]
    OF: ClassVar[str]

    seed: int
    domain: str
    texts: Texts
    asked: tuple[LabQuestion, ...]
    facts: tuple[Fact, ...]
    scene: Scene | None
    icons: Mapping[str, str]
    changes: Told = ()
    pictures: tuple[Picture | None, ...] = ()
    ahead: Ahead | None = None
    config: Mapping[str, Any]

    @cached_property
    def text(self) -> str:
        """The plan as canonical JSON."""
        value = encode(self) | {"version": self.VERSION}
        return json.dumps(value, sort_keys=True, ensure_ascii=False, separators=(",", ":"))

    @cached_property
    def hash(self) -> str:
        """SHA-256 of :attr:`text`; names the plan in the data."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @classmethod
    def from_text(cls, text: str) -> Self:
        """Reads what :attr:`text` wrote.

        Raises:
            InputError: another version of the stored form, or the plan of something else.
        """
        value = json.loads(text)
        if value.pop("version", None) != cls.VERSION:
            allowed = (
                f"that of {cls.OF} in the form {cls.VERSION}, which this version of xplain stores; "
                "one of an earlier form goes on, is exported and replayed with the version that "
                "began it"
            )
            raise InputError("database", "its plan", allowed)
        return decode(cls, value)
