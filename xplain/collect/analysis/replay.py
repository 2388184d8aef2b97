"""Replays a collection from its log: ``python -m xplain collect replay database``.

From the events and the plan alone, read-only, every state, question and posterior is computed
again and compared with what was stored, to the last bit; and so is what each participant's prior
took from those before.
"""

from __future__ import annotations

import sqlite3
from functools import partial

from xplain.collect.protocol import machine
from xplain.collect.protocol.asking import schedule, shared
from xplain.collect.protocol.plan import Collection
from xplain.collect.protocol.state import State
from xplain.participants import event_log
from xplain.participants.protocol.replay import Findings, Replayed, replayed


def replay(connection: sqlite3.Connection, collection: Collection, head: str = "") -> Findings:
    """Compares everything that can be computed from the events with what is stored; see
    :func:`xplain.study.analysis.replay.replay`."""
    found = Findings(differences=event_log.differences(connection, head))
    advance = partial(machine.advance, collection)
    people = {
        one.row["number"]: one for one in replayed(connection, State(), advance, found, "clip")
    }
    for one in people.values():
        _compare_others(collection, one, people, found)
    return found


def _compare_others(
    collection: Collection,
    one: Replayed[State],
    people: dict[int, Replayed[State]],
    found: Findings,
) -> None:
    """The prior must be that of people of the same stream who had answered every clip."""
    consent = next((load for kind, load in one.payloads if kind == "consent"), {})
    if not consent.get("agree"):
        return
    who, clips = one.row["id"], len(schedule(collection.plan, 0))
    if consent["number"] != one.row["number"]:
        found.differences.append(f"{who}: admitted as {consent['number']}")
    before = [people.get(number) for number in consent["after"]]
    known = [p for p in before if p and p.row["stream"] == one.row["stream"]]
    if len(known) < len(before) or any(len(p.state.answered) < clips for p in known):
        found.differences.append(f"{who}: the prior is of people who had not finished")
    elif shared([p.state.belief for p in known]) != consent["others"]:
        found.differences.append(f"{who}: the prior differs from what others answered")
