"""Tables from a snapshot of the database: ``collect export``.

``labels.csv`` is what ``xplain discover`` reads, with the ``hypotheses.npz`` that the questions
were chosen by; ``observers.csv`` and ``clips.csv`` say who gave the labels, and how. People, pilots
and bots never share a table of labels.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.collect.analysis.codebook import CODEBOOK
from xplain.collect.analysis.labels import dataset_of, why_left_out
from xplain.collect.protocol.plan import CollectPlan
from xplain.collect.protocol.state import STATED, State
from xplain.data.label_table import write_table
from xplain.message_sets import names_of
from xplain.participants import exported
from xplain.participants.event_log import head_of
from xplain.participants.exported import Row, defused, described
from xplain.participants.stored import STREAMS, plan_of, reading

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Participant:
    """A row of the participant table, with the state and the events that belong to it."""

    row: Mapping[str, Any]
    state: State
    events: tuple[Row, ...]

    @property
    def id(self) -> str:
        """As in every table."""
        return str(self.row["id"])

    def answers(self, kind: str) -> list[Row]:
        """The accepted answers of a kind, in order."""
        return [e for e in self.events if e["source"] == "protocol" and e["kind"] == kind]

    @property
    def timed(self) -> list[tuple[Row, float | None]]:
        """Each answer to a clip, with the seconds since its page was first shown."""
        shown = {e["source_sequence"]: e["wall"] for e in self.events if e["source"] == "shown"}
        return [
            (e, e["wall"] - shown[e["source_sequence"]] if e["source_sequence"] in shown else None)
            for e in self.answers("labels")
        ]


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database (better: of a snapshot) into a folder.

    Returns:
        The head of the log: with it a replay can tell whether anything before was changed since.

    Raises:
        InputError: it is no collection's database.
    """
    with reading(database) as connection:
        plan, rows = plan_of(connection, CollectPlan), exported.participants(connection)
        of = exported.by_participant(rows, exported.events(connection))
        head = head_of(connection)
        steps = [dict(row) for row in connection.execute("SELECT * FROM step")]
    people = [Participant(r, State.from_text(r["state"]), tuple(of[r["id"]])) for r in rows]
    folder.mkdir(parents=True, exist_ok=True)
    for stream in STREAMS:
        kept = {
            one.id: one.state
            for one in people
            if one.row["stream"] == stream and not why_left_out(one.state)
        }
        if kept:
            name = "labels.csv" if stream == "person" else f"labels_{stream}.csv"
            write_table(dataset_of(plan, kept), folder / name)
    for name, table in tables(plan, people, steps).items():
        table.map(defused).to_csv(folder / f"{name}.csv", index=False)
    (plan.whole or plan.hypotheses).save(folder / "hypotheses.npz")
    exported.write_origin(folder, plan, head)
    return head


def tables(
    plan: CollectPlan, people: list[Participant], steps: list[Row]
) -> dict[str, pd.DataFrame]:
    """Every table but the labels, by name. Of who withdrew no answer is in them."""
    chosen = {(step["participant"], step["k"]): json.loads(step["action_values"]) for step in steps}
    clips = [
        row for one in people if one.state.stage != "withdrawn" for row in _clips(plan, one, chosen)
    ]
    codebook = [
        {"table": table, "column": column, "meaning": meaning}
        for table, columns in CODEBOOK.items()
        for column, meaning in columns.items()
    ]
    found = {
        "observers": [_observer(plan, one) for one in people],
        "clips": clips,
        "codebook": codebook,
    }
    return {name: described(name, rows, CODEBOOK[name]) for name, rows in found.items()}


def _observer(plan: CollectPlan, one: Participant) -> Row:
    state, names = one.state, plan.hypotheses.messages
    withdrawn = state.stage == "withdrawn"
    why = why_left_out(state)
    facts = {f: p for f, p in state.belief.items() if f != "none"} if not withdrawn else {}
    best = max(facts, key=lambda f: facts[f], default=None)
    timed = one.timed
    consent = one.answers("consent")
    row: Row = {
        "observer": one.id,
        "stream": one.row["stream"],
        "stage": state.stage,
        "in_labels": int(not why),
        "left_out": why,
        "labels": sum(len(clip.labels) for clip in state.questions()),
        "attentive": None if state.attentive is None else int(state.attentive),
        "consistency": state.consistency,
        "likeliest": None if best is None else ";".join(names_of(int(best), names)),
        "posterior": None if best is None else facts[best],
        "unlike": None if withdrawn else state.belief.get("none"),
        "role": None if state.role is None else plan.roles[state.role].name,
        "clips_s": _clips_seconds(timed),
        "label_s": _label_seconds(timed),
        "practice_errors": max(len(one.answers("example")) - 2, 0),
        "entered": one.row["entered"],
        "consent_hash": consent[0]["payload"].get("text") if consent else None,
        "completion_code": one.row["code"] if state.stage == "done" else None,
    }
    stated = state.stated if not withdrawn else ()
    for j, fact in enumerate(plan.facts):
        row[f"stated_{fact.name}"] = STATED[stated[j]] if stated else None
    given = one.answers("answers") if not withdrawn else []
    for asked in plan.asked:
        row[f"answer_{asked.name}"] = given[0]["payload"].get(asked.name, "") if given else None
    return row


def _clips_seconds(timed: list[tuple[Row, float | None]]) -> float | None:
    if not timed or timed[0][1] is None:
        return None
    return float(timed[-1][0]["wall"] - timed[0][0]["wall"] + timed[0][1])


def _label_seconds(timed: list[tuple[Row, float | None]]) -> float | None:
    import numpy as np

    each = [took / len(e["payload"]["labels"]) for e, took in timed if took is not None]
    return float(np.median(each)) if each else None


def _clips(
    plan: CollectPlan, one: Participant, chosen: Mapping[tuple[str, int], Row]
) -> Iterator[Row]:
    known = plan.hypotheses
    for number, (clip, (event, took)) in enumerate(zip(one.state.answered, one.timed, strict=True)):
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
