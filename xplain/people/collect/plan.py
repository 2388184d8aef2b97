"""The plan of a collection: everything a participant may meet, fixed before the first one comes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError, Positive, Range, Whole, checks, whole_number
from xplain.people.plan import StoredPlan
from xplain.questions.designs import Adaptive


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


@checks("rules")
@dataclass(frozen=True, kw_only=True)
class CollectRules:
    """Numbers of the protocol.

    Attributes:
        people: planned, which the researcher's page shows; the page stays open when more come.
        points: labels a person, those for consistency and attention not counted.
        timeout_minutes: without a sign of life, after which a participant's part pauses.
        repeats: questions asked a second time, for consistency.
        attention: whether an obvious step is among them.
        listening: messages told at the end that hold from then on: asked about at once, later
            with nothing said, and once more when they are said again.
    """

    people: Annotated[int, Range(2)]
    points: int
    timeout_minutes: Positive
    repeats: Whole
    attention: bool
    listening: Whole = 0

    def __post_init__(self) -> None:
        """Raises InputError: no points, or too many of them repeated."""
        most = whole_number("points", self.points, 1) // 4
        if self.repeats > most:
            raise InputError("rules.repeats", self.repeats, f"at most a quarter of points: {most}")


@dataclass(frozen=True)
class CollectRole:
    """Somebody who believes certain facts incorrectly: simulated people are one of several, and
    with assigned briefings real ones are told what one knows, to see whether it is found again.

    Attributes:
        name: of the user type.
        held: bitmask of the facts that it believes incorrectly.
        briefing: one sentence a fact, as this type knows it.
    """

    name: str
    held: int
    briefing: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class CollectPlan(StoredPlan):
    """A collection about T transitions and n facts.

    Attributes:
        example, rules: see their types.
        roles: of simulated people.
        assigned: whether each participant is told what one of the roles knows.
        hypotheses: what people might believe incorrectly, with phrases.
        whole: the same of all transitions, also those that nobody is asked about because others
            have the same features: what types are learned with. None where these are all.
        subject: who does what the phrases say; "" where they are whole sentences.
        questions: the list that everybody is asked, as (transition, message set); empty where
            each question depends on the answers before.
        design: of these adaptive questions; of a list, how its answers are weighed.
        shown: [T] the transitions.
        attention: the obvious step that does not make sense.
    """

    OF = "a collection of labels"

    example: Example
    rules: CollectRules
    roles: tuple[CollectRole, ...]
    assigned: bool
    hypotheses: Hypotheses
    whole: Hypotheses | None
    subject: str
    questions: tuple[tuple[int, int], ...]
    design: Adaptive
    attention: str
