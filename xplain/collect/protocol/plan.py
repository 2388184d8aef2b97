"""The plan of a collection: everything a participant may meet, fixed before the first one comes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any, ClassVar

from xplain.domains.base import Scene
from xplain.errors import InputError, number, whole_number
from xplain.participants.protocol.plan import Asked, Fact, StoredPlan, Texts
from xplain.questions.designs import Adaptive
from xplain.questions.hypotheses import Hypotheses
from xplain.questions.questionnaire import Questionnaire

QUESTIONNAIRES = 512
"""Kept at a time: more than people answer at once."""


@dataclass(frozen=True)
class Example:
    """The practice: an action that does not occur later, once under each of two messages.

    Attributes:
        action: what the robot does.
        against: a sentence under which the action makes no sense.
        speaks_for: one under which it does.
    """

    action: str
    against: str
    speaks_for: str


@dataclass(frozen=True)
class Rules:
    """Numbers of the protocol.

    Attributes:
        people: wanted; the page stays open when more come.
        points: labels a person, those for consistency and attention not counted.
        repeats: questions asked a second time, for consistency.
        attention: whether an obvious step is among them.
        timeout_minutes: without a sign of life after which a participant's part ends.
    """

    people: int
    points: int
    repeats: int
    attention: bool
    timeout_minutes: float

    def __post_init__(self) -> None:
        """Raises InputError: a number out of its range."""
        whole_number("rules.people", self.people, 2)
        whole_number("points", self.points, 1)
        most = self.points // 4
        if whole_number("rules.repeats", self.repeats, 0) > most:
            raise InputError("rules.repeats", self.repeats, f"at most a quarter of points: {most}")
        if not number("rules.timeout_minutes", self.timeout_minutes) > 0:
            raise InputError("rules.timeout_minutes", self.timeout_minutes, "a number above 0")


@dataclass(frozen=True)
class Role:
    """Somebody who holds certain facts wrong: simulated people are one of several, and with
    assigned briefings real ones are told what one knows, to see whether it is found again.

    Attributes:
        name: of the user type.
        held: bitmask of the facts that it holds wrong.
        briefing: one sentence a fact, as this type knows it.
    """

    name: str
    held: int
    briefing: tuple[str, ...]


@dataclass(frozen=True)
class Picture:
    """An image of a transition: its media type, and its bytes in base 64."""

    media: str
    content: str


@dataclass(frozen=True)
class CollectPlan(StoredPlan):
    """A collection about T transitions and n facts.

    Attributes:
        seed: of the questions' choice and order.
        domain: name of the task.
        texts, example, rules, asked: see their types.
        facts: [n], as people meet them.
        roles: of simulated people.
        assigned: whether each participant is told what one of the roles knows.
        hypotheses: what people might hold wrong, with phrases.
        whole: the same of all transitions, also those that nobody is asked about because others
            have the same features: what types are learned with. None where these are all.
        subject: who does what the phrases say; "" where they are whole sentences.
        questions: the list that everybody is asked, as (transition, message set); empty where
            each question depends on the answers before.
        design: of these adaptive questions; of a list, how its answers are weighed.
        situations: [T] what is so when the transition begins, as sentences; or none.
        gone: [T] names of the items that are on the map no more when it begins; or none.
        paths: [T] (cell before, cell after) on the map; or none.
        changes: [T] what each transition changes, for domains without a map; or none.
        scene: the map, or None.
        icons: {name of an item on the map: path of its icon in a box of 24}; may lack some.
        pictures: [T] of own transitions, None where one has no image; or none.
        attention: the obvious step that does not make sense.
        expectation: what simulated observers let one expect, by figure.
        probes: what is asked of simulated people, to notice changed code.
        config: the configuration that it was made from, for the record.
    """

    VERSION: ClassVar[int | str] = "collect 2"
    OF: ClassVar[str] = "a collection of labels"
    COMMAND: ClassVar[str] = "collect"

    seed: int
    domain: str
    texts: Texts
    example: Example
    rules: Rules
    asked: tuple[Asked, ...]
    facts: tuple[Fact, ...]
    roles: tuple[Role, ...]
    assigned: bool
    hypotheses: Hypotheses
    whole: Hypotheses | None
    subject: str
    questions: tuple[tuple[int, int], ...]
    design: Adaptive
    situations: tuple[tuple[str, ...], ...]
    gone: tuple[tuple[str, ...], ...]
    paths: tuple[tuple[tuple[int, int], tuple[int, int]], ...]
    changes: tuple[tuple[str, ...], ...]
    scene: Scene | None
    icons: Mapping[str, str]
    pictures: tuple[Picture | None, ...]
    attention: str
    expectation: Mapping[str, float]
    probes: tuple[str, ...]
    config: Mapping[str, Any]


class Latest:
    """The latest questionnaires that were kept, by key; threads may share it.

    Args:
        count: of them; the oldest goes where there are more.
    """

    def __init__(self, count: int) -> None:
        self._count, self._lock = count, Lock()
        self._kept: OrderedDict[Hashable, Questionnaire] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable) -> Questionnaire | None:
        """None where it is not among the latest."""
        return self._kept.get(key)

    def keep(self, key: Hashable, questionnaire: Questionnaire) -> None:
        """As the latest of all."""
        with self._lock:
            self._kept[key] = questionnaire
            if len(self._kept) > self._count:
                self._kept.popitem(last=False)

    def clear(self) -> None:
        """Keeps nothing of what was kept."""
        with self._lock:
            self._kept.clear()


@dataclass(frozen=True)
class Collection:
    """A plan with its questionnaire at work; what the protocol needs to go on.

    Attributes:
        plan: of the collection.
        kept: the latest questionnaires by participant and answers, so that an answer is added to
            those before and not all of them are taken anew. Nothing that is computed depends on it.
    """

    plan: CollectPlan
    kept: Latest = field(default_factory=lambda: Latest(QUESTIONNAIRES), repr=False, compare=False)

    @cached_property
    def blank(self) -> Questionnaire:
        """The questionnaire before anybody was asked."""
        design = self.plan.design
        return Questionnaire(
            self.plan.hypotheses,
            design.error,
            None,
            design.clip,
            none=design.none,
            misread=design.misread,
        )
