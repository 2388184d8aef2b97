"""Tables from a snapshot of the database: ``collect export``.

``labels.csv`` is what ``xplain discover`` reads, with the ``hypotheses.npz`` that the questions
were chosen by; ``observers.csv`` and ``clips.csv`` say who gave the labels, and how. People, pilots
and bots never share a table of labels.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xplain.data.label_file import write_table
from xplain.message_sets import names_of
from xplain.people.analysis import export as exported
from xplain.people.analysis.export import Row, described, participants, write
from xplain.people.analysis.stored import STREAMS, plan_of, reading
from xplain.people.collect.asking import STATED, State
from xplain.people.collect.codebook import CODEBOOK
from xplain.people.collect.labels import dataset_of, why_left_out
from xplain.people.collect.plan import CollectPlan

if TYPE_CHECKING:
    import pandas as pd

Participant = exported.Participant[State]


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database (better: of a snapshot) into a folder.

    Returns:
        The head of the log.

    Raises:
        InputError: it is no collection's database.
    """
    with reading(database) as connection:
        plan, people = plan_of(connection, CollectPlan), participants(connection, State)
        steps = [dict(row) for row in connection.execute("SELECT * FROM step")]
        head = write(connection, tables(plan, people, steps), folder, parquet=False)
    for stream in STREAMS:
        own = [one for one in people if one.row["stream"] == stream]
        if kept := {one.id: one.state for one in own if not why_left_out(one.state)}:
            name = "labels.csv" if stream == "person" else f"labels_{stream}.csv"
            write_table(dataset_of(plan, kept), folder / name)
    (plan.whole or plan.hypotheses).save(folder / "hypotheses.npz")
    return head


def tables(
    plan: CollectPlan, people: list[Participant], steps: list[Row]
) -> dict[str, pd.DataFrame]:
    """Every table but the labels, by name. Of who withdrew no answer is in them."""
    chosen = {(step["participant"], step["k"]): json.loads(step["action_values"]) for step in steps}
    rows = {
        "observers": [_observer(plan, one) for one in people],
        "clips": [
            row
            for one in people
            if one.state.stage != "withdrawn"
            for row in _clips(plan, one, chosen)
        ],
        "codebook": [
            {"table": table, "column": column, "meaning": meaning}
            for table, columns in CODEBOOK.items()
            for column, meaning in columns.items()
        ],
    }
    return {name: described(name, rows[name], CODEBOOK[name]) for name in rows}


def _timed(one: Participant) -> list[tuple[Row, float | None]]:
    """Each answer to a clip, with the seconds since its page was first shown."""
    shown = {e["source_sequence"]: e["wall"] for e in one.events if e["source"] == "shown"}
    clips = [(e, shown.get(e["source_sequence"])) for e in one.answers("labels")]
    return [(event, None if since is None else event["wall"] - since) for event, since in clips]


def _observer(plan: CollectPlan, one: Participant) -> Row:
    state, why = one.state, why_left_out(one.state)
    withdrawn = state.stage == "withdrawn"
    facts = {f: p for f, p in state.belief.items() if f != "none" and not withdrawn}
    best = max(facts, key=lambda f: facts[f], default=None)
    timed = _timed(one)
    each = [took / len(event["payload"]["labels"]) for event, took in timed if took is not None]
    begun = bool(timed) and timed[0][1] is not None
    stated = {} if withdrawn else dict(enumerate(state.stated))
    given = [] if withdrawn else [event["payload"] for event in one.answers("answers")]
    return {
        "observer": one.id,
        "stream": one.row["stream"],
        "stage": state.stage,
        "in_labels": int(not why),
        "left_out": why,
        "labels": sum(len(clip.labels) for clip in state.questions()),
        "attentive": None if state.attentive is None else int(state.attentive),
        "consistency": state.consistency,
        "likeliest": best and ";".join(names_of(int(best), plan.hypotheses.messages)),
        "posterior": None if best is None else facts[best],
        "unlike": None if withdrawn else state.belief.get("none"),
        "role": None if state.role is None else plan.roles[state.role].name,
        "clips_s": timed[-1][0]["wall"] - timed[0][0]["wall"] + timed[0][1] if begun else None,
        "label_s": float(np.median(each)) if each else None,
        "practice_errors": max(len(one.answers("example")) - 2, 0),
        "entered": one.row["entered"],
        "consent_hash": one.first("consent").get("text"),
        "completion_code": one.row["code"] if state.stage == "done" else None,
        **{
            f"stated_{fact.name}": STATED[stated[j]] if stated else None
            for j, fact in enumerate(plan.facts)
        },
        **{f"answer_{q.name}": given[0].get(q.name, "") if given else None for q in plan.asked},
    }


def _clips(
    plan: CollectPlan, one: Participant, chosen: Mapping[tuple[str, int], Row]
) -> Iterator[Row]:
    known = plan.hypotheses
    for number, (clip, (event, took)) in enumerate(
        zip(one.state.answered, _timed(one), strict=True)
    ):
        steps = [known.phrases[t] for t in clip.transitions] or [plan.attention]
        yield {
            "observer": one.id,
            "number": number + 1,
            "purpose": clip.purpose,
            "steps": "|".join(steps),
            "messages": ";".join(names_of(clip.told, known.messages)),
            "labels": ";".join(map(str, clip.labels)),
            "bits": chosen[one.id, number]["bits"],
            "seconds": took,
            "browser_ms": event["browser"],
        }
