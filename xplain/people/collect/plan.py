"""The plan of a collection: everything that participants may see. It is fixed before the first
participant enters."""

from dataclasses import dataclass
from typing import Annotated

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError, Positive, Range, Whole, checks, whole_number
from xplain.people.plan import StoredPlan
from xplain.questions.designs import Adaptive


@checks("rules")
@dataclass(frozen=True, kw_only=True)
class CollectRules:
    """Settings of the protocol.

    Attributes:
        people: planned number of people, shown on the researcher's page; more people may take part.
        points: number of labels of each person, without labels for consistency and attention.
        timeout_minutes: minutes without activity after which a participant is paused.
        repeats: number of questions that are asked a second time, for consistency.
        attention: True if an obvious step is among the questions.
        listening: number of lasting messages at the end. A lasting message stays valid on later
            pages; other messages are valid on one page only. A question about the same step is
            asked three times: on the page that gives the message, on a later page that does not
            repeat it, and on a page that gives it again.
    """

    people: Annotated[int, Range(2)]
    points: int
    timeout_minutes: Positive
    repeats: Whole
    attention: bool
    listening: Whole = 0

    def __post_init__(self) -> None:
        """Raises InputError if there are no points, or too many repeats."""
        most = whole_number("points", self.points, 1) // 4
        if self.repeats > most:
            raise InputError("rules.repeats", self.repeats, f"at most a quarter of points: {most}")


@dataclass(frozen=True)
class CollectRole:
    """People who believe certain facts incorrectly. Each simulated person has a role. A briefing
    can give real people the knowledge of a role, to test if their answers reveal the role.

    Attributes:
        name: name of the user type.
        held: bitmask of the facts that the type believes incorrectly.
        briefing: one sentence for each fact, as this type believes it.
    """

    name: str
    held: int
    briefing: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class CollectPlan(StoredPlan):
    """A collection about T transitions and n facts.

    Attributes:
        rules: settings of the protocol.
        roles: roles of simulated people.
        assigned: True if each participant gets the briefing of a role.
        hypotheses: sets of facts that people may believe incorrectly, and the labels of the T
            transitions, with phrases.
        whole: hypotheses for all transitions of the task, from which types are learned; None if the
            T transitions are all of them. The T transitions do not include transitions that have
            the same features but different labels.
        subject: subject of the phrases; "" if phrases are whole sentences.
        questions: the list of questions for all people, as (transition, message set); empty if each
            question depends on earlier answers.
        design: settings of adaptive questions. The posterior of a participant uses these settings
            even if all people get one list of questions.
        shown: [T] the transitions.
        attention: the obvious step that does not make sense.
    """

    OF = "a collection of labels"

    rules: CollectRules
    roles: tuple[CollectRole, ...]
    assigned: bool
    hypotheses: Hypotheses
    whole: Hypotheses | None
    subject: str
    questions: tuple[tuple[int, int], ...]
    design: Adaptive
    attention: str
