"""The plan of a study: everything that participants may see. It is fixed before the first
participant enters.

A plan is a value: texts, trace, label probabilities, the participants' types, and the solver of
each condition.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Parameter
from xplain.errors import Count, Positive, checks
from xplain.explanation.asking import Questions
from xplain.explanation.label_table import LabelTable
from xplain.explanation.problem import Problem
from xplain.people.plan import Clip, StoredPlan, Told, Way

PERSONALIZED, CONFORMANT, ASKING = "personalized", "conformant", "asking"
"""Conditions that the code knows by name. The policy of ASKING may ask questions."""


@dataclass(frozen=True)
class QuizQuestion:
    """One question with its possible answers; ``answer`` is the index of the right answer."""

    text: str
    options: tuple[str, ...]
    answer: int


@dataclass(frozen=True)
class Statement:
    """A true or false statement of the quiz about the robot."""

    fact: str
    text: str
    true: bool


@dataclass(frozen=True)
class StudyRole:
    """The briefing and the tests of one user type.

    Attributes:
        name: name of the user type.
        wrong: positions, in the plan's facts, of the facts that this type believes incorrectly.
        briefing: one sentence for each fact, as this type believes it; empty in a study without a
            briefing.
        eligibility: one question for each fact, with the answer that is right for this type; empty
            in a study without a briefing.
        quiz: the statements of the quiz, true statements first.
    """

    name: str
    wrong: tuple[int, ...]
    briefing: tuple[str, ...]
    eligibility: tuple[QuizQuestion, ...]
    quiz: tuple[Statement, ...]


@checks("rules")
@dataclass(frozen=True, kw_only=True)
class StudyRules:
    """Rules and limits of the study.

    Attributes:
        per_cell: required number of completed participants for each type under each condition.
        timeout_minutes: minutes without activity after which another participant can have the
            place.
        max_attempts: maximum number of eligibility tests.
    """

    per_cell: Count
    timeout_minutes: Positive
    max_attempts: Count


@dataclass(frozen=True, kw_only=True)
class StudyPlan(StoredPlan):
    """The plan of a study. Its trace has m transitions, and each of its n facts has a message.

    A study with a briefing has N user types, and the briefing of each type is a role. A study
    without a briefing has one role (N = 1); its simulated participants are of M kinds, which differ
    in the facts that they believe incorrectly. With a briefing the M kinds are the N types.

    Attributes:
        rules: numbers of the protocol.
        known: facts that everybody is told and believes; each also has a false sentence, for the
            quiz.
        roles: [N] the roles.
        kinds: [M] positions of the facts that each kind believes incorrectly; empty in a study with
            a briefing.
        shown: [m + Q] the trace's transitions, then the Q transitions that the policy of the
            condition ASKING may ask about.
        taken: [m + 1] names of the items that are no longer on the map after 0 … m steps; empty
            without items.
        problem: the problem of explaining the trace, with the Q questions.
        clip_labels: labels that a faultless participant of each kind gives to the Q transitions;
            None without questions.
        true_labels: [M, m, 2^n] uint8, labels that a faultless participant of each kind gives to
            the trace's transitions, by message set.
        conditions: {condition: configuration of its solver}.
        belief: configuration of the belief update.
    """

    OF = "a study"

    rules: StudyRules
    known: tuple[Parameter, ...] = ()
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
        """[m] the robot's action in each transition of the trace, as a phrase."""
        return tuple(clip.phrase for clip in self.shown[: self.n_steps])

    @property
    def clips(self) -> tuple[Clip, ...]:
        """[Q] the transitions that the condition ASKING may ask about."""
        return self.shown[self.n_steps :]

    @property
    def path(self) -> Way | None:
        """[m] the cells before and after each transition of the trace; None without a map."""
        way = tuple(move for clip in self.shown[: self.n_steps] for move in clip.way)
        return way if len(way) == self.n_steps else None

    def problem_of(self, condition: str) -> Problem:
        """Returns the problem that a condition's policy solves. Only the problem of the
        condition ASKING has questions."""
        return self.problem if condition == ASKING else replace(self.problem, questions=Questions())

    @property
    def n_steps(self) -> int:
        """m, the number of transitions of the trace."""
        return int(self.true_labels.shape[1])

    @property
    def wrong(self) -> tuple[tuple[int, ...], ...]:
        """[M] positions of the facts that each kind of people believes incorrectly; with a
        briefing, the kinds are the user types."""
        return self.kinds or tuple(role.wrong for role in self.roles)

    @property
    def cells(self) -> tuple[tuple[int, str], ...]:
        """All pairs (index of a role, condition). The study needs equally many participants for
        each pair."""
        return tuple((t, c) for t in range(len(self.roles)) for c in self.conditions)
