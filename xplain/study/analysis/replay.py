"""Replays a study from its log: ``python -m xplain study replay database``.

The log is checked first: no event was changed, left out or put in (xplain/event_log.py). Then, from
the events and the plan alone, read-only, every state, belief, message and value is computed again
and compared with what was stored, to the last bit. Erased participants are counted, not replayed.
"""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass, field

from xplain import event_log
from xplain.study.protocol import machine
from xplain.study.protocol.machine import Refused, State
from xplain.study.protocol.plan import Study


@dataclass
class Findings:
    """How much was compared, and what differs."""

    participants: int = 0
    events: int = 0
    steps: int = 0
    erased: int | None = 0
    differences: list[str] = field(default_factory=list)


def replay(connection: sqlite3.Connection, study: Study, head: str = "") -> Findings:
    """Compares everything that can be computed from the events with what is stored.

    Args:
        connection: to the database; its rows are mappings.
        study: at work.
        head: of the log, as an earlier export printed it, or its first characters; "" for none.
    """
    found = Findings(differences=event_log.differences(connection, head))
    (found.erased,) = connection.execute("SELECT sum(erased) FROM participant").fetchone()
    for person in connection.execute("SELECT * FROM participant WHERE NOT erased ORDER BY number"):
        found.participants += 1
        _replay_one(connection, study, person, found)
    for slot in connection.execute(
        "SELECT slot.*, participant.state AS state, "
        "iif(entry = 'preview', 'preview', participant.stream) AS whose FROM slot "
        "JOIN participant ON participant.id = slot.holder"
    ):
        state = State.from_text(slot["state"])
        cell = (state.user_type, state.condition, slot["whose"])
        ended_early = state.over and state.stage != "done"
        if (
            cell != (slot["user_type"], slot["condition"], slot["stream"])
            or bool(slot["used"]) != (state.stage == "done")
            or ended_early
        ):
            found.differences.append(f"slot {slot['stream']} {slot['position']}: {slot['holder']}")
    return found


def _replay_one(
    connection: sqlite3.Connection, study: Study, person: sqlite3.Row, found: Findings
) -> None:
    who, state = person["id"], State()
    steps: dict[int, dict[str, str | int | None]] = {}
    entered = connection.execute(
        "SELECT payload FROM event WHERE participant = ? AND kind = 'enter'", (who,)
    ).fetchone()
    about = {key: person[key] for key in ("entry", "stream", "code")}
    if entered is None or json.loads(entered["payload"]) != about:
        found.differences.append(f"{who}: who they are is not what the log says")
    for event in connection.execute(
        "SELECT * FROM event WHERE participant = ? AND source = 'protocol' ORDER BY sequence",
        (who,),
    ):
        found.events += 1
        if event["source_sequence"] != state.accepted:
            found.differences.append(f"{who}: event {event['sequence']} is out of order")
            return
        try:
            outcome = machine.advance(study, state, event["kind"], json.loads(event["payload"]))
        except Refused as error:
            found.differences.append(f"{who}: event {event['sequence']} is refused: {error}")
            return
        if answer := outcome.answer:
            steps[answer.step] |= answer.columns
        if decision := outcome.decision:
            steps[decision.step] = decision.columns
        state = outcome.state
    if state.text != person["state"] or state.over != bool(person["over"]):
        found.differences.append(f"{who}: the stored state differs")
    compared, differences = event_log.step_differences(connection, who, steps, "step")
    found.steps += compared
    found.differences += differences
