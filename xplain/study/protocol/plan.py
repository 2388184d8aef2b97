"""The plan of a study: everything a participant may meet, fixed before the first one comes.

A plan is a value: texts, trace, label probabilities, the participants' types, which solver serves
which condition. It is stored in the study's database at the first start and read from there ever
after, so that neither a restart nor a change of code or configuration changes a running study.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Scene
from xplain.errors import InputError
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy
from xplain.storage import decode, encode

VERSION = 2
"""Of the stored form; a database of another version is refused."""


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


@dataclass(frozen=True)
class Known:
    """What everybody is told and nobody holds wrong: a sentence, and what would be wrong."""

    right: str
    wrong: str


@dataclass(frozen=True)
class Question:
    """One question with its possible answers; ``answer`` is the index of the right one."""

    text: str
    options: tuple[str, ...]
    answer: int


@dataclass(frozen=True)
class Statement:
    """One statement of the quiz, true or not of the robot."""

    fact: str
    text: str
    true: bool


@dataclass(frozen=True)
class Role:
    """What participants of one user type are told and asked.

    Attributes:
        name: of the user type.
        wrong: positions of the facts that this type holds wrong.
        briefing: one sentence a fact, as this type knows it.
        eligibility: one question a fact, answered as this type knows it.
        quiz: the statements of the last test, true ones first.
    """

    name: str
    wrong: tuple[int, ...]
    briefing: tuple[str, ...]
    eligibility: tuple[Question, ...]
    quiz: tuple[Statement, ...]


@dataclass(frozen=True)
class Training:
    """The example that shows what a message does: an action added for illustration."""

    belief: str
    action: str
    message: str


@dataclass(frozen=True)
class Asked:
    """One question to the participant, before the briefing or after the quiz.

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
        if self.kind not in ("number", "choice", "text", "scale"):
            raise InputError(f"{key}.kind", self.kind, "number, choice, text or scale")
        if self.kind == "choice" and not self.choices:
            raise InputError(f"{key}.choices", [], "at least one choice")
        if self.kind == "scale" and not 1 <= self.high - self.low <= 10:
            raise InputError(f"{key}.high", self.high, "at most 10 above low")
        if len(self.ends) not in (0, 2):
            raise InputError(f"{key}.ends", list(self.ends), "two words, for low and high")
        if self.right and self.options and self.right not in self.options:
            raise InputError(f"{key}.right", self.right, ", ".join(self.options))

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


@dataclass(frozen=True)
class Rules:
    """Numbers of the protocol.

    Attributes:
        per_cell: completed participants wanted for each type under each condition.
        max_attempts: how often the eligibility test may be taken.
        timeout_minutes: without a sign of life after which a participant's slot is freed.
        recall: whether the briefing can be opened again during the evaluation.
        min_width: of the window, in CSS pixels, to take part; 0 lets phones in.
    """

    per_cell: int
    max_attempts: int
    timeout_minutes: float
    recall: bool
    min_width: int = 0

    def __post_init__(self) -> None:
        """Raises InputError: a number that is not positive."""
        for key in ("per_cell", "max_attempts", "timeout_minutes"):
            if not getattr(self, key) > 0:
                raise InputError(f"rules.{key}", getattr(self, key), "a number above 0")


@dataclass(frozen=True)
class StudyPlan:
    """A study of N types, a trace of m transitions, n facts (and messages).

    Attributes:
        seed: of assignment and the orders of questions.
        domain: its name.
        texts, training, rules: see their types.
        before, asked: questions before the briefing and after the quiz.
        facts: [n].
        roles: [N].
        trace: [m] what the robot does, as phrases.
        path: [m] (cell before, cell after) on the map, or None without a map.
        scene: the map, or None.
        problem: label probabilities and costs behind the policies.
        true_labels: [N, m, 2^n] uint8, what a faultless participant would answer.
        conditions: {condition: configuration of its solver}.
        belief: configuration of the belief update.
        probes: {condition: decisions for random labels}, to notice changed code.
        icons: {name of an item on the map: path of its icon in a box of 24}; may lack some.
        config: the configuration that it was made from, for the record.
        changes: [m] what each transition changes, for domains without a map; or none.
        known: what everybody is told.
        taken: [m + 1] names of the items that are off the map after each number of steps; or none.
    """

    seed: int
    domain: str
    texts: Texts
    training: Training
    rules: Rules
    asked: tuple[Asked, ...]
    facts: tuple[Fact, ...]
    roles: tuple[Role, ...]
    trace: tuple[str, ...]
    path: tuple[tuple[tuple[int, int], tuple[int, int]], ...] | None
    scene: Scene | None
    problem: Problem
    true_labels: NDArray[np.uint8]
    conditions: Mapping[str, Mapping[str, Any]]
    belief: Mapping[str, Any]
    probes: Mapping[str, tuple[str, ...]]
    icons: Mapping[str, str]
    config: Mapping[str, Any]
    changes: tuple[tuple[str, ...], ...] = ()
    known: tuple[Known, ...] = ()
    taken: tuple[tuple[str, ...], ...] = ()
    before: tuple[Asked, ...] = ()

    @property
    def n_steps(self) -> int:
        """m, the number of transitions of the trace."""
        return len(self.trace)

    @property
    def cells(self) -> tuple[tuple[int, str], ...]:
        """Every (type, condition): what the slots are balanced over."""
        return tuple((t, c) for t in range(len(self.roles)) for c in self.conditions)

    @cached_property
    def text(self) -> str:
        """The plan as canonical JSON; floats survive to the last bit."""
        value = encode(self) | {"version": VERSION}
        return json.dumps(value, sort_keys=True, ensure_ascii=False, separators=(",", ":"))

    @property
    def hash(self) -> str:
        """SHA-256 of :attr:`text`; names the plan in the data."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @classmethod
    def from_text(cls, text: str) -> StudyPlan:
        """Reads what :attr:`text` wrote.

        Raises:
            InputError: another version of the stored form.
        """
        value = json.loads(text)
        if value.pop("version", None) != VERSION:
            raise InputError("database", "its plan", f"made by another version (not {VERSION})")
        plan: StudyPlan = decode(cls, value)
        return plan


@dataclass(frozen=True)
class Study:
    """A plan with its policies at work; what the protocol needs to go on.

    Attributes:
        plan: the value everything follows from.
        policies: {condition: policy for ``plan.problem``}.
        belief: which labels are evidence.
    """

    plan: StudyPlan
    policies: Mapping[str, Policy]
    belief: BeliefUpdate
