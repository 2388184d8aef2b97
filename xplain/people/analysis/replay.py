"""Would this plan decide all of it again? Every participant's events are taken once more, and each
state that they lead to is compared with the one that was stored."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass, field
from typing import Any

from xplain.errors import Refused
from xplain.people.analysis.export import ParticipantRow, participants
from xplain.people.flow import Flow, S


@dataclass
class Findings:
    """How many people and events were compared, how many people were erased, and what differs."""

    participants: int = 0
    events: int = 0
    erased: int = 0
    differences: list[str] = field(default_factory=list)


def replayed(
    connection: sqlite3.Connection, flow: Flow[Any, S], latest: int | None = None
) -> tuple[Findings, list[ParticipantRow[S]]]:
    """What differs, and everybody who was not erased.

    Args:
        connection: to the database; its rows are mappings.
        flow: at work.
        latest: how many participants, those who came last; None takes all.
    """
    people = participants(connection, flow.STATE)[-(latest or 0) :]
    (erased,) = connection.execute("SELECT sum(erased) FROM participant").fetchone()
    found = Findings(len(people), erased=erased or 0)
    for one in people:
        state = flow.STATE()
        for event in one.moves:
            found.events += 1
            try:
                state = flow.advance(state, event["kind"], event["payload"])
            except (Refused, KeyError) as error:
                found.differences.append(f"{one.id}: event {event['sequence']}: {error}")
                break
            stored, again = json.loads(event["state"]), json.loads(state.text)
            for key in again:
                if stored.get(key) != again[key]:
                    what = f"{key} is {stored.get(key)}, decided again {again[key]}"
                    found.differences.append(f"{one.id}: event {event['sequence']}: {what}")
    return found, people
