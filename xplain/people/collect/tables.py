"""Tables from a snapshot of the database: ``collect export``.

``labels.csv`` is what ``xplain discover`` reads, with the ``hypotheses.npz`` that the questions
were chosen by; ``observers.csv`` and ``clips.csv`` say who gave the labels, and how. People, pilots
and bots never share a table of labels.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from xplain.explanation.message_sets import names_of
from xplain.learning.data.label_file import write_table
from xplain.people.analysis.export import ParticipantRow, Row, events_of, seconds, write
from xplain.people.analysis.stored import STREAMS
from xplain.people.collect.asking import STATED, CollectState
from xplain.people.collect.codebook import CODEBOOK
from xplain.people.collect.labels import dataset_of, why_left_out
from xplain.people.collect.plan import CollectPlan
from xplain.people.stages import CANNOT_TELL

FAST = 1.0
"""Seconds a step below which nobody has read it."""
Participant = ParticipantRow[CollectState]


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database (better: of a snapshot) into a folder; SHA-256 of the events.

    Raises:
        InputError: it is no collection's database.
    """
    digest, plan, people = write(database, folder, CollectPlan, CollectState, tables, CODEBOOK)
    for stream in STREAMS:
        own = [one for one in people if one.row["stream"] == stream]
        if kept := {one.id: one.state for one in own if not why_left_out(one.state)}:
            name = "labels.csv" if stream == "person" else f"labels_{stream}.csv"
            write_table(dataset_of(plan, kept), folder / name)
    (plan.whole or plan.hypotheses).save(folder / "hypotheses.npz")
    said = json.dumps({one.name: one.message for one in plan.facts}, ensure_ascii=False, indent=1)
    (folder / "sentences.yaml").write_text(f"{said}\n", encoding="utf-8")  # JSON is YAML
    return digest


def tables(plan: CollectPlan, people: list[Participant]) -> dict[str, Iterable[Row]]:
    """Rows of every table but the labels, by name. Answers of people who withdrew are left out."""
    stayed = [one for one in people if one.state.stage != "withdrawn"]
    return {
        "observers": [_observer(plan, one) for one in people],
        "clips": [row for one in stayed for row in _clips(plan, one)],
        "events": events_of(stayed),
    }


def _timed(one: Participant) -> list[tuple[Row, Row | None]]:
    """Each answer to a clip, and when its page was first shown."""
    shown = {e["source_sequence"]: e for e in one.events if e["source"] == "shown"}
    return [(answer, shown.get(answer["source_sequence"])) for answer in one.answers("labels")]


def _observer(plan: CollectPlan, one: Participant) -> Row:
    state, why = one.state, why_left_out(one.state)
    withdrawn = state.stage == "withdrawn"
    facts = {f: p for f, p in state.belief.items() if f != "none" and not withdrawn}
    best = max(facts, key=lambda f: facts[f], default=None)
    timed = _timed(one)
    each = [
        took / len(answer["payload"]["labels"])
        for answer, shown in timed
        if shown and (took := seconds(shown, answer)[0]) is not None
    ]
    begun = timed[0][1] if timed else None
    took, clock = seconds(begun, timed[-1][0]) if begun else (None, None)
    stated = {} if withdrawn else dict(enumerate(state.stated))
    given = [] if withdrawn else [event["payload"] for event in one.answers("answers")]
    return {
        "observer": one.id,
        "stream": one.row["stream"],
        "stage": state.stage,
        "in_labels": int(not why),
        "left_out": why,
        "labels": sum(len(clip.judged.labels) for clip in state.questions()),
        "cannot_tell": sum(clip.labels.count(CANNOT_TELL) for clip in state.answered),
        "attentive": None if state.attentive is None else int(state.attentive),
        "consistency": state.consistency,
        "likeliest": best and ";".join(names_of(int(best), plan.hypotheses.messages)),
        "posterior": None if best is None else facts[best],
        "unlike": None if withdrawn else state.belief.get("none"),
        "role": None if state.role is None else plan.roles[state.role].name,
        "clips_s": took,
        "clock": clock,
        "label_s": float(np.median(each)) if each else None,
        "fast_pages": sum(took < FAST for took in each),
        "practice_errors": max(len(one.answers("example")) - 2, 0)
        + sum(not event["payload"]["label"] for event in one.answers("ahead")),
        "entered": one.events[0]["wall"],
        "entry": one.row["entry"],
        "consent_hash": one.first("consent").get("text"),
        **{
            f"stated_{fact.name}": STATED[stated[j]] if stated else None
            for j, fact in enumerate(plan.facts)
        },
        **{f"answer_{q.name}": given[0].get(q.name, "") if given else None for q in plan.asked},
    }


def _clips(plan: CollectPlan, one: Participant) -> Iterator[Row]:
    known = plan.hypotheses
    for number, (clip, (answer, shown)) in enumerate(
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
            "bits": clip.bits,
            "seconds": seconds(shown, answer)[0] if shown else None,
            "browser_ms": answer["browser"],
        }
