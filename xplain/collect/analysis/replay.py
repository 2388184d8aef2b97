"""Replays a collection from its log: ``python -m xplain collect replay database``.

From the events and the plan alone, read-only, every state, question and posterior is computed
again and compared with what was stored, to the last bit; and so is what each participant's prior
took from those before.
"""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass, field
from typing import Any

from xplain import event_log
from xplain.collect.protocol import machine
from xplain.collect.protocol.asking import schedule, shared
from xplain.collect.protocol.plan import Collection
from xplain.collect.protocol.state import State
from xplain.errors import Refused


@dataclass
class Findings:
    """How much was compared, and what differs."""

    participants: int = 0
    events: int = 0
    steps: int = 0
    differences: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Replayed:
    """One participant, as computed again: ``consent`` is the payload of that event, if any."""

    who: str
    stream: str
    state: State
    consent: dict[str, Any] | None


def replay(connection: sqlite3.Connection, collection: Collection) -> Findings:
    """Compares everything that can be computed from the events with what is stored."""
    found = Findings(differences=event_log.differences(connection))
    people: dict[int, Replayed] = {}
    for person in connection.execute(
        "SELECT * FROM participant WHERE NOT erased ORDER BY number"
    ).fetchall():
        found.participants += 1
        if one := _replay_one(connection, collection, person, found):
            people[person["number"]] = one
    _compare_others(collection, people, found)
    return found


def _replay_one(
    connection: sqlite3.Connection, collection: Collection, person: sqlite3.Row, found: Findings
) -> Replayed | None:
    who, state, consent = person["id"], State(), None
    steps: dict[int, dict[str, str | int | None]] = {}
    for event in connection.execute(
        "SELECT * FROM event WHERE participant = ? AND source = 'protocol' ORDER BY sequence",
        (who,),
    ):
        found.events += 1
        if event["source_sequence"] != state.accepted:
            found.differences.append(f"{who}: event {event['sequence']} is out of order")
            return None
        payload = json.loads(event["payload"])
        try:
            outcome = machine.advance(collection, state, event["kind"], payload)
        except (Refused, KeyError) as error:
            found.differences.append(f"{who}: event {event['sequence']} is refused: {error}")
            return None
        if event["kind"] == "consent" and payload.get("agree"):
            consent = payload
            if payload["number"] != person["number"]:
                found.differences.append(f"{who}: admitted as {payload['number']}")
        if answer := outcome.answer:
            steps[answer.step] |= answer.columns
        if decision := outcome.decision:
            steps[decision.step] = decision.columns
        state = outcome.state
    if state.text != person["state"] or state.over != bool(person["over"]):
        found.differences.append(f"{who}: the stored state differs")
    compared, differences = event_log.step_differences(connection, who, steps, "clip")
    found.steps += compared
    found.differences += differences
    return Replayed(who, person["stream"], state, consent)


def _compare_others(collection: Collection, people: dict[int, Replayed], found: Findings) -> None:
    """Each prior must be that of people of the same stream who had answered every clip."""
    clips = len(schedule(collection.plan, 0))
    for one in people.values():
        if one.consent is None:
            continue
        before = [people.get(number) for number in one.consent["after"]]
        known = [p for p in before if p and p.stream == one.stream]
        if len(known) < len(before) or any(len(p.state.answered) < clips for p in known):
            found.differences.append(f"{one.who}: the prior is of people who had not finished")
        elif shared([p.state.belief for p in known]) != one.consent["others"]:
            found.differences.append(f"{one.who}: the prior differs from what others answered")
