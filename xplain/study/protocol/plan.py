"""The plan of a study: everything a participant may meet, fixed before the first one comes.

A plan is a value: texts, trace, label probabilities, the participants' types, which solver serves
which condition.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Scene
from xplain.errors import InputError
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.problem import Problem
from xplain.participants.protocol.plan import Asked, Fact, StoredPlan, Texts
from xplain.solvers.base import Policy


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
        briefing: one sentence a fact, as this type knows it; none for people as they are.
        eligibility: one question a fact, answered as this type knows it; or none.
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
class StudyPlan(StoredPlan):
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
        true_labels: [M, m, 2^n] uint8, what a faultless participant would answer: of the M = N
            roles, or of the kinds.
        conditions: {condition: configuration of its solver}.
        belief: configuration of the belief update.
        probes: {condition: decisions for random labels}, to notice changed code.
        icons: {name of an item on the map: path of its icon in a box of 24}; may lack some.
        config: the configuration that it was made from, for the record.
        changes: [m] what each transition changes, for domains without a map; or none.
        known: what everybody is told.
        kinds: [M] facts that each kind of simulated people holds wrong, where participants come as
            they are: then there is one role, which nobody is briefed for. None otherwise.
        taken: [m + 1] names of the items that are off the map after each number of steps; or none.
    """

    VERSION: ClassVar[int | str] = 3
    OF: ClassVar[str] = "a study"
    COMMAND: ClassVar[str] = "study"

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
    kinds: tuple[tuple[int, ...], ...] = ()

    @property
    def n_steps(self) -> int:
        """m, the number of transitions of the trace."""
        return len(self.trace)

    @property
    def wrong(self) -> tuple[tuple[int, ...], ...]:
        """[M] positions of the facts that people of each role, or kind, hold wrong."""
        return self.kinds or tuple(role.wrong for role in self.roles)

    @property
    def cells(self) -> tuple[tuple[int, str], ...]:
        """Every (type, condition): what the slots are balanced over."""
        return tuple((t, c) for t in range(len(self.roles)) for c in self.conditions)


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
