"""Tables from a snapshot of the database: ``collect export``.

``labels.csv`` is what ``xplain discover`` reads, with the ``hypotheses.npz`` that the questions
were chosen by; ``observers.csv`` and ``clips.csv`` say who gave the labels, and how. People, pilots
and bots never share a table of labels.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from xplain.explanation.message_sets import names_of
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.label_file import write_table
from xplain.learning.evidence import Evidence
from xplain.learning.mixture.labeler import KnownAnswers
from xplain.learning.mixture.likelihood import KnownTransitions
from xplain.people.collect.asking import FINISHED, STATED, CollectState
from xplain.people.collect.plan import CollectPlan
from xplain.people.export import STREAMS, ParticipantRow, Row, events_of, seconds, write
from xplain.people.flow import CANNOT_TELL

CODEBOOK = {
    "labels": {
        "observer": "who answered; the key of observers.csv",
        "messages": "what they had been told on that page, joined by ;",
        "label": "1 = the step made sense to them, 0 = it did not",
        "…": "every other column is a feature of the robot's step",
    },
    "observers": {
        "observer": "random id",
        "stream": "person, pilot or bot; decided by the invitation, never changed",
        "stage": "where they are or how it ended: done, declined, withdrawn, timed_out",
        "in_labels": "1 if their labels are in labels.csv (or labels_STREAM.csv)",
        "left_out": "why not: unfinished, withdrawn, timed_out, declined, or inattentive (the "
        "obvious step made sense to them)",
        "labels": "number of their labels",
        "cannot_tell": "steps of which they could not tell whether they make sense",
        "attentive": "1 if the obvious step made no sense to them; empty if it was not reached",
        "consistency": "share of the labels of repeated questions that were as before, 0 … 1",
        "likeliest": "facts that they most probably hold wrong, by their own answers, joined by ;",
        "posterior": "probability of that, 0 … 1",
        "unlike": "probability that none of the hypotheses fits them, 0 … 1",
        "role": "whose briefing they got; empty for people as they are",
        "clips_s": "seconds from the first clip's page to the last clip's answer, server's clock",
        "clock": "by which that is: monotonic, or wall where the machine was restarted in between; "
        "impossible where the wall clock was set back, and the time is left out",
        "label_s": "median seconds a label, page shown to answer, server's clock",
        "fast_pages": "pages answered in less than a second a step, which nobody can have read",
        "practice_errors": "answers of the practice that were not as expected",
        "entered": "server's wall clock, seconds since 1970-01-01 UTC",
        "entry": "invitation, platform, open or preview",
        "consent_hash": "SHA-256 of the consent text agreed to (or declined)",
        "stated_…": "of each fact what they say they thought: accurate, inaccurate or unsure",
        "answer_…": "answers to the lab's own questions, as given; a text that a spreadsheet would "
        "run is preceded by '",
    },
    "clips": {
        "observer": "key",
        "number": "order on their pages, 1, 2, …",
        "purpose": "question, repeat (of an earlier question) or attention (the obvious step); at "
        "the end told (the messages hold from then on), later (its step with nothing said), again "
        "(said again)",
        "steps": "what the robot did, as shown, joined by |",
        "messages": "what they were told on the page, joined by ;",
        "labels": "1 = made sense, 0 = did not, 2 = they cannot tell; one a step, joined by ;",
        "bits": "information that the answer was expected to give about what they hold wrong",
        "seconds": "page shown to answer, server's clock",
        "browser_ms": "milliseconds since the page began to load, browser's clock; empty without "
        "JavaScript",
    },
}

CONCENTRATION = 1.0
"""Of the process over types; that of ``clusterer=dirichlet``."""
SURE = 0.95
"""Posterior above which it is known what somebody holds wrong."""


def why_left_out(state: CollectState) -> str:
    """Why a participant's labels are not learned from; "" where they are."""
    if state.stage not in FINISHED:
        return state.stage if state.over else "unfinished"
    return "inattentive" if state.attentive is False else ""


def dataset_of(plan: CollectPlan, people: Mapping[str, CollectState]) -> Dataset:
    """The labels of the questions of these people, as :mod:`xplain.learning.data.label_file` writes
    them. Second looks and the obvious step are no questions,
    and "I cannot tell" is no label."""
    known = plan.hypotheses
    assert known.features is not None, "a plan's hypotheses have features"
    rows = [
        (o, transition, clip.told, label)
        for o, state in enumerate(people.values())
        for clip in (one.judged for one in state.questions())
        for transition, label in zip(clip.transitions, clip.labels, strict=True)
    ]
    observer, transition, told, label = np.array(rows, dtype=np.int64).reshape(-1, 4).T
    distinct, which = np.unique(known.features[transition], axis=0, return_inverse=True)
    return Dataset(
        features=distinct,
        feature_names=known.feature_names,
        messages=known.messages,
        observers=tuple(people),
        observer=observer,
        transition=which.ravel(),
        message_set=told,
        label=label.astype(np.uint8),
    )


@dataclass(frozen=True)
class FoundType:
    """A type that was found.

    Attributes:
        wrong: names of the facts that it holds wrong.
        members: positions of its people.
        posterior: mean probability that one of them, judged alone, holds exactly these wrong.
    """

    wrong: tuple[str, ...]
    members: tuple[int, ...]
    posterior: float


@dataclass(frozen=True)
class KnownSoFar:
    """What is known after N people.

    Attributes:
        types: the largest first.
        error: share of wrong answers that was learned.
        unsure: people of whom no fact set has a posterior above SURE.
        unlike: mean probability that no hypothesis fits somebody.
        evidence: how well hypotheses foretold the answers.
        new_types: that another ten people are expected to bring.
        next_new: probability that the next person is of a type not seen so far.
    """

    types: tuple[FoundType, ...]
    error: float
    unsure: int
    unlike: float
    evidence: Evidence
    new_types: float
    next_new: float


def fact_sets(plan: CollectPlan, people: Sequence[CollectState]) -> tuple[NDArray[np.int64], float]:
    """[N] the facts that each person's type holds wrong, and the share of wrong answers: the
    Dirichlet process over fact sets that ``discover`` runs with the same hypotheses."""
    asked = _asked(plan, people)
    found, data = asked.partition(CONCENTRATION), asked.dataset
    return found.facts, found.answers.wrong(asked.place[data.transition], data.observer)


def _asked(plan: CollectPlan, people: Sequence[CollectState]) -> KnownAnswers:
    """The labels of these people, and what hypotheses know of them."""
    data = dataset_of(plan, {str(o): state for o, state in enumerate(people)})
    return KnownAnswers.of(KnownTransitions.of(plan.hypotheses), data)


def found_types(plan: CollectPlan, people: Sequence[CollectState]) -> KnownSoFar | None:
    """The types so far; None before the second person."""
    if len(people) < 2:
        return None
    facts, error = fact_sets(plan, people)
    types = []
    for held in np.unique(facts).tolist():
        members = np.flatnonzero(facts == held).tolist()
        alone = [people[i].belief.get(str(held), 0.0) for i in members]
        wrong = names_of(held, plan.hypotheses.messages)
        types.append(FoundType(wrong, tuple(members), float(np.mean(alone))))
    types.sort(key=lambda one: -len(one.members))
    best = [max([p for f, p in s.belief.items() if f != "none"], default=0.0) for s in people]
    next_new, new_types = expected_new(len(types), len(people), 10)
    return KnownSoFar(
        types=tuple(types),
        error=error,
        unsure=sum(one <= SURE for one in best),
        unlike=float(np.mean([state.belief.get("none", 0.0) for state in people])),
        evidence=_asked(plan, people).evidence(np.unique(facts, return_inverse=True)[1]),
        new_types=new_types,
        next_new=next_new,
    )


def compared(plan: CollectPlan, people: Sequence[CollectState]) -> dict[str, dict[str, int]]:
    """By fact, of the people ("of") who had an opinion at the end: how many said that they hold it
    wrong ("said"), of how many their answers say so ("inferred"), and of how many both are the same
    ("agree")."""
    found = {
        fact.name: dict.fromkeys(("said", "inferred", "agree", "of"), 0) for fact in plan.facts
    }
    for state in people:
        known = {facts: share for facts, share in state.belief.items() if facts != "none"}
        best = int(max(known, key=lambda facts: known[facts], default=0))
        for j, (stated, row) in enumerate(zip(state.stated, found.values(), strict=False)):
            if known and STATED[stated] != "unsure":
                said, inferred = STATED[stated] == "inaccurate", bool(best >> j & 1)
                for key, one in (("said", said), ("inferred", inferred), ("of", True)):
                    row[key] += one
                row["agree"] += said == inferred
    return {name: row for name, row in found.items() if row["of"]}


def expected_new(types: int, people: int, more: int) -> tuple[float, float]:
    """What more people bring, after ``types`` were seen in ``people`` (Ewens' sampling formula).

    The concentration α is the one under which so many types are expected, Σ α / (α + i) over
    i < people; but at least one under which about half a type beside the first is, or one type
    alone would rule out every other for ever.

    Returns:
        The probability that the next person is of a new type, and the number of new types
        expected in ``more`` people.
    """

    def expected(alpha: float) -> float:
        return float((alpha / (alpha + np.arange(people))).sum())

    if types >= people:  # everybody is unlike everybody else: nothing is known to come to an end
        return 1.0, float(more)
    low = 0.5 / np.log1p(people)
    # brentq needs a sign change: expected(low) may exceed one type already.
    alpha = low if expected(low) >= types else brentq(lambda a: expected(a) - types, low, 1e6)
    new = alpha / (alpha + people + np.arange(more))
    return float(new[0]), float(new.sum())


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
