"""A flow as the server runs it, such as the study's or that of a collection of labels.

The flow is pure; a site is what belongs to it outside: places, drawings, the researcher's page,
tables. The store keeps its states and events, the pages show what it says; neither knows which
flow it is.
"""

from __future__ import annotations

import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

from markupsafe import Markup

from xplain.errors import Refused, XplainError
from xplain.people import map_svg
from xplain.people.export import Findings, ParticipantRow, replayed
from xplain.people.flow import Flow, State
from xplain.people.plan import Pictures, StoredPlan

Do = Callable[..., sqlite3.Cursor]
"""Executes a statement within a transaction."""
Query = Callable[[str], list[dict[str, Any]]]
"""Rows of a reading query."""
F = TypeVar("F", bound=Flow[Any, Any])
LATEST = 8
"""Participants whose events are taken once more at a start: enough to notice changed code."""


class Full(Refused):
    """No place is free now."""


class Site(ABC, Generic[F]):
    """A flow at work. The defaults are those of one in which nobody gives a place back.

    Attributes:
        PLAN: class of its plans.
        TEMPLATES: folder of its pages, one named like each stage.
        OVERVIEW: template of the researcher's page.
        flow: with its plan.
    """

    PLAN: ClassVar[type[StoredPlan]]
    TEMPLATES: ClassVar[Path]
    OVERVIEW: ClassVar[str]

    def __init__(self, flow: F) -> None:
        self.flow = flow
        self.plan = flow.plan

    # Made from a stored plan ---------------------------------------------------------------------

    @classmethod
    @abstractmethod
    def of(cls, plan: Any) -> Self:
        """A plan at work."""

    def check(self, connection: sqlite3.Connection) -> None:
        """Takes the events of the latest participants once more.

        Raises:
            XplainError: the installed code decides differently from the code that they met.
        """
        found, _ = replayed(connection, self.flow, LATEST)
        if found.differences:
            raise XplainError(
                "database: this version of xplain decides differently from the one that started "
                f"{self.plan.OF} in it; go on and replay with that version, or start anew in "
                f"another database ({found.differences[0]})"
            )

    def announcement(self) -> str:
        """What a start of the server says of the plan."""
        return ""

    def state(self, text: str | None = None) -> Any:
        """The state that a text stands for; the first one without it."""
        return self.flow.STATE() if text is None else self.flow.STATE.from_text(text)

    # Places, within the transaction of the event that needs them ---------------------------------

    @abstractmethod
    def admit(self, do: Do, person: Mapping[str, Any]) -> Mapping[str, Any]:
        """What the consent of a participant (a row of the table) carries from elsewhere.

        Raises:
            Full: nobody can be admitted now.
        """

    def readmit(self, do: Do, person: Mapping[str, Any], state: Any) -> Mapping[str, Any]:
        """What the return of a participant who was silent for too long carries, as :meth:`admit`.

        Raises:
            Full: no place is free.
            Refused: they are not away.
        """
        return {}

    @abstractmethod
    def check_cell(self, cell: int) -> None:
        """Raises Refused: the researcher's page offers no such cell of the plan (a type under a
        condition) to look at."""

    def forget(self) -> None:
        """Drops what is kept in memory to answer sooner: somebody's data was erased."""
        State.from_text.cache_clear()

    # Pages ---------------------------------------------------------------------------------------

    def drawing(self) -> dict[str, Any]:
        """What every template may use: ``map``, ``ahead`` (that of the practice), ``legend``,
        ``about`` (the picture of a fact), ``changes``, ``pictures``, ``titles``."""
        words = self.plan.texts.words
        return {
            "map": lru_cache(4096)(self.picture),
            "ahead": lambda steps: map_svg.picture(self.plan, self.plan.ahead.way, steps),
            "legend": map_svg.legend(self.plan),
            "about": partial(map_svg.about, self.plan),
            "changes": self.plan.changes,
            "pictures": self.plan.pictures,
            "titles": {stage: words[stage] for stage in self.flow.stages[:-1]},
        }

    @abstractmethod
    def picture(self, what: Any) -> Markup:
        """The map with what a page's template asks for (hashable); "" without a map."""

    @property
    def pictures(self) -> Pictures:
        """Images that pages may show."""
        return self.plan.pictures

    @abstractmethod
    def glance(self, query: Query) -> dict[str, Any]:
        """What the researcher's page shows besides participants and stages; ``data`` names the
        tables of the export."""

    def about(self, state: Any, blinded: bool) -> dict[str, str]:
        """What the researcher's page says of a participant, by column.

        Args:
            state: of the participant.
            blinded: whether that may tell who gets what.
        """
        step = self.step_of(state)
        return {"Stage": state.stage.replace("_", " ") + (f", {step}" if step else "")}

    @abstractmethod
    def step_of(self, state: Any) -> str:
        """How far they are within a stage of several pages; empty elsewhere."""

    # Data ----------------------------------------------------------------------------------------

    @staticmethod
    @abstractmethod
    def export(database: Path, folder: Path) -> str:
        """Writes the tables of a database (better: of a snapshot); SHA-256 of its events."""

    def replay(self, connection: sqlite3.Connection) -> Findings:
        """Whether this plan would decide all of it again.

        Args:
            connection: to the database; its rows are mappings.
        """
        found, people = replayed(connection, self.flow)
        found.differences += self.unequal(connection, people)
        return found

    @abstractmethod
    def unequal(
        self, connection: sqlite3.Connection, people: list[ParticipantRow[Any]]
    ) -> Iterable[str]:
        """What else differs from what the log says, a sentence each."""
