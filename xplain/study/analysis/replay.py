"""Replays a study from its log: ``python -m xplain study replay database``.

From the events and the plan alone, read-only, every state, belief, message and value is computed
again and compared with what was stored, to the last bit; and so are the slots.
"""

from __future__ import annotations

import sqlite3
from functools import partial

from xplain.participants import event_log
from xplain.participants.protocol.replay import Findings, replayed
from xplain.study.protocol import machine
from xplain.study.protocol.machine import State
from xplain.study.protocol.plan import Study


def replay(connection: sqlite3.Connection, study: Study, head: str = "") -> Findings:
    """Compares everything that can be computed from the events with what is stored.

    Args:
        connection: to the database; its rows are mappings.
        study: at work.
        head: of the log, as an earlier export printed it, or its first characters; "" for none.
    """
    found = Findings(differences=event_log.differences(connection, head))
    for _ in replayed(connection, State(), partial(machine.advance, study), found, "step"):
        pass
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
