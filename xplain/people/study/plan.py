"""The plan of a study: everything a participant may meet, fixed before the first one comes.

A plan is a value: texts, trace, label probabilities, the participants' types, which solver serves
which condition.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, Whole, checks
from xplain.explanation.asking import Questions
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.people.plan import Clip, LabQuestion, StoredPlan, Told, Way

PERSONALIZED, CONFORMANT, ASKING = "personalized", "conformant", "asking"
"""Conditions that the code knows by name. The policy of the last may ask questions."""


@dataclass(frozen=True)
class Known:
    """What everybody is told and believes: a true sentence, and a false one."""

    right: str
    wrong: str


@dataclass(frozen=True)
class QuizQuestion:
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
class StudyRole:
    """What participants of one user type are told and asked.

    Attributes:
        name: of the user type.
        wrong: positions of the facts that this type believes incorrectly.
        briefing: one sentence a fact, as this type knows it; none for people as they are.
        eligibility: one question a fact, answered as this type knows it; or none.
        quiz: the statements of the last test, true ones first.
    """

    name: str
    wrong: tuple[int, ...]
    briefing: tuple[str, ...]
    eligibility: tuple[QuizQuestion, ...]
    quiz: tuple[Statement, ...]


@dataclass(frozen=True)
class Training:
    """The example that shows what a message does: an action added for illustration."""

    belief: str
    action: str
    message: str


@checks("rules")
@dataclass(frozen=True, kw_only=True)
class StudyRules:
    """Numbers of the protocol.

    Attributes:
        per_cell: completed participants wanted for each type under each condition.
        timeout_minutes: without a sign of life, after which a place goes to somebody else.
        max_attempts: how often the eligibility test may be taken.
        recall: whether the briefing can be opened again during the evaluation.
        min_width: of the window, in CSS pixels, to take part; 0 lets phones in.
    """

    per_cell: Count
    timeout_minutes: Positive
    max_attempts: Count
    recall: bool
    min_width: Whole = 0


@dataclass(frozen=True, kw_only=True)
class StudyPlan(StoredPlan):
    """A study of N types, a trace of m transitions, n facts (and messages).

    Attributes:
        training, rules: see their types.
        known: what everybody is told.
        before: questions before the briefing.
        roles: [N].
        kinds: [M] facts that each kind of simulated people believes incorrectly, where participants
        come as
            they are: then there is one role, which nobody is briefed for. None otherwise.
        shown: [m + Q] the trace, then what the condition ASKING may ask about.
        taken: [m + 1] names of the items that are off the map after each number of steps; or none.
        problem: label probabilities and costs behind the policies; with the questions that the
            condition ASKING may ask.
        clip_labels: of the M kinds as in ``true_labels``, what they would answer; None for none.
        true_labels: [M, m, 2^n] uint8, what a faultless participant would answer: of the M = N
            roles, or of the kinds.
        conditions: {condition: configuration of its solver}.
        belief: configuration of the belief update.
    """

    OF = "a study"

    training: Training
    rules: StudyRules
    known: tuple[Known, ...] = ()
    before: tuple[LabQuestion, ...] = ()
    roles: tuple[StudyRole, ...]
    kinds: tuple[tuple[int, ...], ...] = ()
    taken: Told = ()
    problem: Problem
    clip_labels: LabelTable | None = None
    true_labels: NDArray[np.uint8]
    conditions: Mapping[str, Mapping[str, Any]]
    belief: Mapping[str, Any]

    @property
    def trace(self) -> tuple[str, ...]:
        """[m] what the robot does, as phrases."""
        return tuple(clip.phrase for clip in self.shown[: self.n_steps])

    @property
    def clips(self) -> tuple[Clip, ...]:
        """[Q] what the questions show."""
        return self.shown[self.n_steps :]

    @property
    def path(self) -> Way | None:
        """[m] on the map, or None without a map."""
        way = tuple(move for clip in self.shown[: self.n_steps] for move in clip.way)
        return way if len(way) == self.n_steps else None

    @property
    def shows_way(self) -> bool:
        """Whether the trace is shown on a map."""
        return self.path is not None

    @property
    def lab_questions(self) -> tuple[LabQuestion, ...]:
        """Also includes the questions before the briefing."""
        return (*self.before, *self.asked)

    def problem_of(self, condition: str) -> Problem:
        """What the policy of a condition plans for: only one of them may ask."""
        return self.problem if condition == ASKING else replace(self.problem, questions=Questions())

    @property
    def n_steps(self) -> int:
        """m, the number of transitions of the trace."""
        return int(self.true_labels.shape[1])

    @property
    def wrong(self) -> tuple[tuple[int, ...], ...]:
        """[M] positions of the facts that people of each role, or kind, believe incorrectly."""
        return self.kinds or tuple(role.wrong for role in self.roles)

    @property
    def cells(self) -> tuple[tuple[int, str], ...]:
        """Every (type, condition): what the slots are balanced over."""
        return tuple((t, c) for t in range(len(self.roles)) for c in self.conditions)
