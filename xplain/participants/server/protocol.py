"""What the server asks of a protocol: the study's, or the collection of labels.

A protocol is a pure state machine with the tables and pages that belong to it. The store keeps its
states and events, the pages show what it says; neither knows which one it is. An implementation
stands beside this file for each, named in :mod:`xplain.participants.server.protocols`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

from werkzeug.datastructures import MultiDict

from xplain.participants.server.database import Do

Query = Callable[[str], list[dict[str, Any]]]
"""Rows of a reading query."""


class State(Interface):
    """Where a participant is; immutable."""

    @property
    def stage(self) -> str: ...
    @property
    def accepted(self) -> int: ...
    @property
    def over(self) -> bool: ...
    @property
    def text(self) -> str: ...


class StepColumns(Interface):
    """A row of the step table, or the columns that an answer fills in."""

    @property
    def step(self) -> int: ...
    @property
    def columns(self) -> Mapping[str, str | int | None]: ...


class Outcome(Interface):
    """A new state; the step that it opens (decision) and the one that it completes (answer)."""

    @property
    def state(self) -> State: ...
    @property
    def decision(self) -> StepColumns | None: ...
    @property
    def answer(self) -> StepColumns | None: ...


class Protocol(Interface):
    """A protocol at work.

    Attributes:
        plan: the value everything follows from, with ``text``, ``hash``, ``texts`` and
            ``rules.timeout_minutes``.
        stages: in order, as far as the plan has them.
        ends: other stages that nothing follows.
        kinds: of the event that each stage waits for.
        overview: template of the researcher's page.
    """

    @property
    def plan(self) -> Any: ...
    @property
    def stages(self) -> Sequence[str]: ...
    @property
    def ends(self) -> Sequence[str]: ...
    @property
    def kinds(self) -> Mapping[str, str]: ...
    @property
    def overview(self) -> str: ...

    def state(self, text: str | None = None) -> State:
        """The state that a text stands for; the first one without it."""
        ...

    def advance(self, state: Any, kind: str, payload: Mapping[str, Any]) -> Outcome:
        """The state after an event.

        Raises:
            Refused: the event does not fit the stage.
        """
        ...

    def found(self, do: Do) -> None:
        """What a new database holds besides the plan."""
        ...

    def admit(self, do: Do, person: Mapping[str, Any]) -> Mapping[str, Any]:
        """What the consent of a participant (a row of the table) carries from elsewhere, such as
        the place that was reserved.

        Raises:
            Refused: nobody can be admitted now.
        """
        ...

    def readmit(self, do: Do, person: Mapping[str, Any], state: Any) -> Mapping[str, Any]:
        """What the return of a participant who was silent for too long carries, as
        :meth:`admit`.

        Raises:
            Refused: no place is free, or they are not away.
        """
        ...

    def pin(self, do: Do, who: str, cell: int) -> None:
        """Makes a participant one of that cell of the plan (a type under a condition), in the
        order in which the protocol names its cells on the researcher's page.

        Raises:
            Refused: there is no such cell.
        """
        ...

    def settle(self, do: Do, who: str, stage: str) -> None:
        """The end of somebody's part."""
        ...

    def payload(self, kind: str, form: MultiDict[str, str], state: Any) -> dict[str, Any]:
        """The payload of an event from what a browser sent, which nobody trusts."""
        ...

    def view(self, state: Any) -> dict[str, Any]:
        """What the page of this state shows, in plain values."""
        ...

    def drawing(self) -> dict[str, Any]:
        """What every template may use: ``map``, ``legend``, ``changes``, ``titles``."""
        ...

    def glance(self, query: Query) -> dict[str, Any]:
        """What the researcher's page shows besides participants and stages."""
        ...

    def export(self, snapshot: Path, folder: Path) -> None:
        """Writes the tables of a snapshot of the database."""
        ...

    def file(self, name: str) -> tuple[str, bytes] | None:
        """A picture that belongs to the plan: media type and content."""
        ...
