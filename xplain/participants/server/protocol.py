"""What the server asks of a protocol, such as a study's or that of a collection of labels.

A protocol is a pure state machine with the tables and pages that belong to it. The store keeps its
states and events, the pages show what it says; neither knows which one it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from typing import Protocol as Interface

from werkzeug.datastructures import MultiDict

from xplain.errors import Refused
from xplain.participants.protocol.state import Outcome, State
from xplain.participants.server.database import Do

Query = Callable[[str], list[dict[str, Any]]]
"""Rows of a reading query."""


class Full(Refused):
    """No place is free now."""


class Protocol(Interface):
    """A protocol at work.

    Attributes:
        plan: the value everything follows from, with ``text``, ``hash``, ``texts`` and
            ``rules.timeout_minutes``.
        stages: in order, as far as the plan has them.
        templates: folder of its pages, one named like each stage.
        overview: template of the researcher's page.
    """

    @property
    def plan(self) -> Any: ...
    @property
    def stages(self) -> Sequence[str]: ...
    @property
    def templates(self) -> Path: ...
    @property
    def overview(self) -> str: ...

    def state(self, text: str | None = None) -> State:
        """The state that a text stands for; the first one without it."""
        ...

    def advance(self, state: Any, kind: str, payload: Mapping[str, Any]) -> Outcome[State]:
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
            Full: nobody can be admitted now.
        """
        ...

    def readmit(self, do: Do, person: Mapping[str, Any], state: Any) -> Mapping[str, Any]:
        """What the return of a participant who was silent for too long carries, as
        :meth:`admit`.

        Raises:
            Full: no place is free.
            Refused: they are not away.
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

    def forget(self) -> None:
        """Drops what is kept in memory to answer sooner: somebody's data was erased."""
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
        """What the researcher's page shows besides participants and stages; ``data`` names the
        tables of the export."""
        ...

    def about(self, state: Any, blinded: bool) -> dict[str, str]:
        """What the researcher's page says of a participant, by column.

        Args:
            state: of the participant.
            blinded: whether that may tell who gets what.
        """
        ...

    def export(self, snapshot: Path, folder: Path) -> None:
        """Writes the tables of a snapshot of the database."""
        ...

    def file(self, name: str) -> tuple[str, bytes] | None:
        """A picture that belongs to the plan: media type and content."""
        ...
