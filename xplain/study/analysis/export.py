"""Tidy tables from a snapshot of the database: ``study export``.

One CSV and one Parquet file a table, the codebook of every column, and the study's plan. Bots and
pilots are in the tables too, marked in the column ``stream`` as they have been from their first
request on.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.message_sets import names_of
from xplain.participants import exported
from xplain.participants.event_log import head_of
from xplain.participants.exported import defused, described
from xplain.participants.stored import plan_of, reading
from xplain.study.analysis.codebook import CODEBOOK, kind_of, unit_of
from xplain.study.analysis.timing import Interaction, interaction, pages
from xplain.study.protocol.machine import State
from xplain.study.protocol.plan import StudyPlan

if TYPE_CHECKING:
    import pandas as pd


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database (better: of a snapshot) into a folder.

    Returns:
        The head of the log: with it a replay can tell whether anything before was changed since.

    Raises:
        InputError: it is no study's database.
    """
    with reading(database) as connection:
        plan, found = plan_of(connection, StudyPlan), tables(connection)
        head = head_of(connection)
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in found.items():
        table.map(defused).to_csv(folder / f"{name}.csv", index=False)
        table.to_parquet(folder / f"{name}.parquet", index=False)
    exported.write_origin(folder, plan, head)
    return head


def tables(connection: sqlite3.Connection) -> dict[str, pd.DataFrame]:
    """Every table by name; columns as in the codebook, which is a table too."""
    plan = plan_of(connection, StudyPlan)
    people, events = exported.participants(connection), exported.events(connection)
    steps = [dict(r) for r in connection.execute("SELECT * FROM step ORDER BY participant, k")]
    of = exported.by_participant(people, events)
    shown = {person["id"]: pages(of[person["id"]]) for person in people}
    seconds = {
        (page["participant"], page["step"]): page["seconds"]
        for own in shown.values()
        for page in own
        if page["stage"] == "evaluation"
    }
    states = {person["id"]: State.from_text(person["state"]) for person in people}
    rows = {
        "participants": [
            _participant(plan, person, states[person["id"]], interaction(of[person["id"]]))
            for person in people
        ],
        "steps": [_step(plan, step, seconds) for step in steps],
        "pages": [row for person in people for row in shown[person["id"]]],
        "labels": [row for step in steps for row in _labels(plan, step)],
        "eligibility": [r for p in people for r in _eligibility(plan, states, p["id"], of)],
        "quiz": [row for p in people for row in _quiz(plan, states, p["id"], of)],
        "answers": [
            {"participant": e["participant"], "question": name, "answer": value}
            for p in people
            for e in of[p["id"]]
            if e["kind"] in ("screening", "answers") and e["source"] == "protocol"
            for name, value in e["payload"].items()
        ],
        "events": events,
        "codebook": [
            {
                "table": table,
                "column": column,
                "type": kind_of(column),
                "unit": unit_of(column),
                "meaning": meaning,
            }
            for table, columns in CODEBOOK.items()
            for column, meaning in columns.items()
        ],
    }
    return {name: described(name, rows[name], CODEBOOK[name]) for name in CODEBOOK}


def _participant(
    plan: StudyPlan, person: dict[str, Any], state: State, took: Interaction
) -> dict[str, Any]:
    role = None if state.user_type is None else plan.roles[state.user_type].name
    finished = state.stage in ("quiz", "questions", "done")
    given = took.answers
    return {
        "participant": person["id"],
        "stream": person["stream"],
        "entry": person["entry"],
        "stage": state.stage,
        "type": role,
        "condition": state.condition,
        "eligibility_attempts": state.attempts,
        "eligible": int(bool(state.belief)),
        "steps_labelled": len(state.labels),
        "messages_given": state.given.bit_count(),
        "inexplicable_transitions": state.labels.count(0) if finished else None,
        "quiz_score": state.score,
        "interaction_time_s": took.wall if finished else None,
        "interaction_time_monotonic_s": took.monotonic if finished else None,
        "hidden_s": took.hidden if finished else None,
        "visible_time_s": took.visible if finished else None,
        "entered": person["entered"],
        "last_seen": person["seen"],
        "consent_hash": took.consent_hash,
        "timed_out": took.timed_out,
        "window_width": took.width,
        "attention_missed": sum(
            bool(q.right) and given.get(q.name, "") != q.right for q in plan.asked if given
        ),
        "completion_code": person["code"] if state.stage == "done" else None,
        "outside_ids": person["kept"] if person["kept"] != "{}" else None,
    }


def _step(
    plan: StudyPlan, step: dict[str, Any], seconds: dict[tuple[str, int], float | None]
) -> dict[str, Any]:
    names = plan.problem.message_names
    return {
        "participant": step["participant"],
        "k": step["k"],
        "transition": plan.trace[step["k"]],
        "given_before": ";".join(names_of(step["given"], names)),
        "messages": ";".join(names_of(step["messages"], names)),
        "belief_before": step["belief_before"],
        "belief_after": step["belief_after"],
        "action_values": step["action_values"],
        "labels": step["labels"],
        "seconds": seconds.get((step["participant"], step["k"])),
    }


def _labels(plan: StudyPlan, step: dict[str, Any]) -> Iterator[dict[str, Any]]:
    names = plan.problem.message_names
    on_page = step["given"] | step["messages"]
    for i, label in enumerate(json.loads(step["labels"] or "[]")):
        yield {
            "participant": step["participant"],
            "k": step["k"],
            "i": i,
            "transition": plan.trace[i],
            "messages_shown": ";".join(names_of(on_page, names)),
            "label": label,
        }


def _eligibility(
    plan: StudyPlan, states: dict[str, State], who: str, of: dict[str, list[dict[str, Any]]]
) -> Iterator[dict[str, Any]]:
    tests = [e for e in of[who] if e["kind"] == "eligibility" and e["source"] == "protocol"]
    user_type = states[who].user_type
    if user_type is None:
        return
    for attempt, event in enumerate(tests, 1):
        for j, question in enumerate(plan.roles[user_type].eligibility):
            answer = event["payload"]["answers"][j]
            yield {
                "participant": who,
                "attempt": attempt,
                "fact": plan.facts[j].name,
                "question": question.text,
                "answer": question.options[answer],
                "correct": int(answer == question.answer),
            }


def _quiz(
    plan: StudyPlan, states: dict[str, State], who: str, of: dict[str, list[dict[str, Any]]]
) -> Iterator[dict[str, Any]]:
    user_type = states[who].user_type
    for event in of[who]:
        if event["kind"] != "quiz" or event["source"] != "protocol" or user_type is None:
            continue
        for i, statement in enumerate(plan.roles[user_type].quiz):
            ticked = i in event["payload"]["chosen"]
            yield {
                "participant": who,
                "fact": statement.fact,
                "statement": statement.text,
                "true": int(statement.true),
                "ticked": int(ticked),
                "correct": int(ticked == statement.true),
            }
