"""Computes participants again from the log, and compares with what was stored, to the last bit.
What another version or machine adds up in another order differs by rounding; that is told apart.

The log is checked first: no event was changed, left out or put in (xplain/people/analysis/log.py).
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from xplain.errors import Refused
from xplain.people.analysis import log
from xplain.people.analysis.export import ParticipantRow, Row, everybody
from xplain.people.flow import Flow, Outcome, S

Steps = dict[int, dict[str, Any]]
"""By step k, the columns of the step table."""
ROUNDING = 1e-9


@dataclass
class Findings:
    """How much was compared, what differs, how many columns of steps do by rounding alone, and
    whether the log itself is whole."""

    participants: int = 0
    events: int = 0
    steps: int = 0
    erased: int = 0
    rounded: int = 0
    whole: bool = True
    differences: list[str] = field(default_factory=list)


def replayed(
    connection: sqlite3.Connection, flow: Flow[Any, S], head: str, step: str
) -> tuple[Findings, list[ParticipantRow[S]]]:
    """What differs, and everybody whose events could be replayed, with the states as computed
    again; erased participants are counted, not replayed.

    Args:
        connection: to the database; its rows are mappings.
        flow: at work.
        head: of the log, as an earlier export printed it, or its first characters; "" for none.
        step: what the flow calls a step.
    """
    found, people = Findings(differences=log.differences(connection, head)), []
    found.whole = not found.differences
    gone, said = (
        {row[0] for row in connection.execute(f"SELECT {of}")}
        for of in ("id FROM participant WHERE erased", "participant FROM event WHERE kind='erase'")
    )
    found.erased = len(gone)
    found.differences += [f"{who}: erased, says the log or the table alone" for who in gone ^ said]
    for row, events in everybody(connection):
        one, differences = ParticipantRow(row, flow.STATE(), events), list[str]()
        about = [e["payload"].items() for e in events if e["kind"] == "enter"]
        if len(about) != 1 or any(row[key] != value for key, value in about[0]):
            differences.append("who they are is not what the log says")
        own = [event for event in events if event["source"] == "protocol"]
        found.participants, found.events = found.participants + 1, found.events + len(own)
        try:
            state, steps = _advanced(flow, own)
        except Refused as error:
            differences.append(str(error))
        else:
            people.append(ParticipantRow(row, state, one.events))
            if not _alike(row["state"], state.text) or state.over != bool(row["over"]):
                differences.append("the stored state differs")
            stored = connection.execute("SELECT * FROM step WHERE participant = ?", (one.id,))
            kept = {row["k"]: row for row in stored}
            found.steps += len(kept.keys() & steps.keys())
            unlike, rounded = _unequal(kept, steps, step)
            differences, found.rounded = differences + unlike, found.rounded + rounded
        found.differences += [f"{one.id}: {difference}" for difference in differences]
    (steps_stored,) = connection.execute("SELECT count(*) FROM step").fetchone()
    if not found.differences and steps_stored != found.steps:
        found.differences.append(f"{steps_stored} {step}s are stored, not {found.steps}")
    return found, people


def outcomes(flow: Flow[Any, S], events: Sequence[Row]) -> Iterator[Outcome[S]]:
    """What each of somebody's answers leads to, in order.

    Raises:
        Refused: an event that does not follow from those before.
    """
    state: S = flow.STATE()
    for event in events:
        if event["source_sequence"] != state.accepted:
            raise Refused(f"event {event['sequence']} is out of order")
        try:
            outcome = flow.advance(state, event["kind"], event["payload"])
        except (Refused, KeyError) as error:
            raise Refused(f"event {event['sequence']} is refused: {error}") from None
        yield outcome
        state = outcome.state


def _advanced(flow: Flow[Any, S], events: Sequence[Row]) -> tuple[S, Steps]:
    """The last state, and the steps on the way; raises as :func:`outcomes`."""
    state: S = flow.STATE()
    steps: Steps = {}
    for outcome in outcomes(flow, events):
        for k, row in outcome.rows.items():
            steps.setdefault(k, {}).update(row)
        state = outcome.state
    return state, steps


def _unequal(stored: Mapping[int, sqlite3.Row], steps: Steps, name: str) -> tuple[list[str], int]:
    """Columns that differ, a line each, and how many do by rounding alone."""
    found, rounded = list[str](), 0
    if stored.keys() != steps.keys():
        found.append(f"{name}s {sorted(stored)} are stored, not {sorted(steps)}")
    for k in stored.keys() & steps.keys():
        for column, value in steps[k].items():
            if not _alike(stored[k][column], value):
                found.append(f"{name} {k}: {column} is {stored[k][column]}, replayed {value}")
            else:
                rounded += stored[k][column] != value
    return found, rounded


def _alike(one: Any, other: Any) -> bool:
    """Equal, or JSON whose numbers are but for rounding."""
    if one == other:
        return True
    if isinstance(one, str) and isinstance(other, str):
        try:
            return _alike(json.loads(one), json.loads(other))
        except ValueError:
            return False
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=ROUNDING, abs_tol=ROUNDING)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_alike, one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_alike(one[key], other[key]) for key in one)
    return False
