"""Computes participants again from the log, and compares with what was stored, to the last bit.

The log is checked first: no event was changed, left out or put in
(xplain/participants/event_log.py).
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic

from xplain.errors import Refused
from xplain.participants import event_log
from xplain.participants.protocol.state import Outcome, S

Advance = Callable[[S, str, Mapping[str, Any]], Outcome[S]]


@dataclass
class Findings:
    """How much was compared, and what differs."""

    participants: int = 0
    events: int = 0
    steps: int = 0
    erased: int = 0
    differences: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Replayed(Generic[S]):
    """A participant as computed again.

    Attributes:
        row: of the participant table.
        state: the last one.
        payloads: (kind, payload) of each event.
    """

    row: Mapping[str, Any]
    state: S
    payloads: tuple[tuple[str, dict[str, Any]], ...]


def replayed(
    connection: sqlite3.Connection, start: S, advance: Advance[S], found: Findings, step: str
) -> Iterator[Replayed[S]]:
    """Everybody whose events could be replayed, in the order in which they came; erased
    participants are counted, not replayed.

    Args:
        connection: to the database; its rows are mappings.
        start: the first state.
        advance: of the protocol, by (state, kind, payload).
        found: takes what differs.
        step: what the protocol calls a step.
    """
    people = connection.execute("SELECT * FROM participant ORDER BY number").fetchall()
    found.erased = sum(person["erased"] for person in people)
    for person in people:
        if not person["erased"]:
            found.participants += 1
            one = _replayed(connection, person, start, advance, found, step)
            if one is not None:
                yield one


def _replayed(
    connection: sqlite3.Connection,
    person: sqlite3.Row,
    state: S,
    advance: Advance[S],
    found: Findings,
    step: str,
) -> Replayed[S] | None:
    who, differences = person["id"], found.differences
    steps: dict[int, dict[str, str | int | None]] = {}
    payloads = []
    entered = connection.execute(
        "SELECT payload FROM event WHERE participant = ? AND kind = 'enter'", (who,)
    ).fetchone()
    about = {key: person[key] for key in ("entry", "stream", "code")}
    if entered is None or json.loads(entered["payload"]) != about:
        differences.append(f"{who}: who they are is not what the log says")
    for event in connection.execute(
        "SELECT * FROM event WHERE participant = ? AND source = 'protocol' ORDER BY sequence",
        (who,),
    ):
        found.events += 1
        if event["source_sequence"] != state.accepted:
            differences.append(f"{who}: event {event['sequence']} is out of order")
            return None
        payload = json.loads(event["payload"])
        try:
            outcome = advance(state, event["kind"], payload)
        except (Refused, KeyError) as error:
            differences.append(f"{who}: event {event['sequence']} is refused: {error}")
            return None
        payloads.append((event["kind"], payload))
        if answer := outcome.answer:
            steps[answer.step] |= answer.columns
        if decision := outcome.decision:
            steps[decision.step] = dict(decision.columns)
        state = outcome.state
    if state.text != person["state"] or state.over != bool(person["over"]):
        differences.append(f"{who}: the stored state differs")
    compared, unequal = event_log.step_differences(connection, who, steps, step)
    found.steps += compared
    differences += unequal
    return Replayed(dict(person), state, tuple(payloads))
