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
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from xplain.domains.users.hypotheses import Hypotheses
from xplain.errors import InputError, one_of
from xplain.explanation.belief import after_forgetting, after_message
from xplain.explanation.habits import Habits
from xplain.explanation.message_sets import indices, names_of, subsets
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.label_file import write_table
from xplain.learning.evidence import Evidence
from xplain.learning.mixture.labeler import KnownAnswers
from xplain.learning.mixture.likelihood import KnownTransitions
from xplain.people.collect.asking import ATTENTION, HEEDED, STATED, AskedClip, CollectState, prior
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectPlan
from xplain.people.export import Row, seconds, write
from xplain.people.flow import CANNOT_TELL, STREAMS, Event, Participant, People
from xplain.people.log import read

CONCENTRATION = 1.0
"""Of the process over types; that of ``clusterer=dirichlet``."""
SURE = 0.95
"""Posterior above which it is known what somebody believes incorrectly."""


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
        wrong: names of the facts that it believes incorrectly.
        members: positions of its people.
        posterior: mean probability that one of them, judged alone, believes exactly these
        incorrectly.
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
        evidence: how well hypotheses predicted the answers.
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
    """Clusters people with the Dirichlet process over fact sets that ``discover`` runs with the
    same hypotheses. Returns the facts [N] that each person's type believes incorrectly, and the
    share of wrong answers."""
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


def glance(collection: Collection, people: People) -> dict[str, Any]:
    """Figures for the researcher's page: labels so far, the types found in them, and what more
    people would bring. They are about people, or about bots while there are no people."""
    plan, found = collection.plan, collection.found
    whose = "person" if any(one.stream == "person" for one in people) else "bot"
    states = {one.id: one.state for one in people if one.stream == whose}
    kept = {who: state for who, state in states.items() if not state.left_out}
    key = tuple(kept)
    if key not in found:
        found.clear()  # people only get more
        found[key] = found_types(plan, list(kept.values()))
    left_out = [state.left_out for state in states.values()]
    return {
        "of": whose,
        "labels": sum(len(c.labels) for s in kept.values() for c in s.questions()),
        "finished": len(kept),
        "left_out": {why: left_out.count(why) for why in sorted({*left_out} - {""})},
        "found": found[key],
        "compared": compared(plan, list(kept.values())),
        "facts": {fact.name: fact.message for fact in plan.facts},
        "planned": plan.rules.people,
    }


def compared(plan: CollectPlan, people: Sequence[CollectState]) -> dict[str, dict[str, int]]:
    """By fact, of the people ("of") who had an opinion at the end: how many said that they believed
    it incorrectly ("said"), of how many their answers say so ("inferred"), and of how many both are
    the same ("agree")."""
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
Person = Participant[CollectState]


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database (better: of a snapshot) into a folder; SHA-256 of the events.

    Raises:
        InputError: it is no collection's database.
    """
    plan, people = read(database, CollectPlan, CollectState)
    digest = write(folder, Collection.PACKAGE, plan, people, tables)
    for stream in STREAMS:
        own = [one for one in people if one.stream == stream]
        if kept := {one.id: one.state for one in own if not one.state.left_out}:
            name = "labels.csv" if stream == "person" else f"labels_{stream}.csv"
            write_table(dataset_of(plan, kept), folder / name)
    (plan.whole or plan.hypotheses).save(folder / "hypotheses.npz")
    said = json.dumps({one.name: one.message for one in plan.facts}, ensure_ascii=False, indent=1)
    (folder / "sentences.yaml").write_text(f"{said}\n", encoding="utf-8")  # JSON is YAML
    return digest


def tables(plan: CollectPlan, people: list[Person]) -> dict[str, Iterable[Row]]:
    """Rows of every table but the labels, by name. Answers of people who withdrew are left out."""
    stayed = [one for one in people if one.state.stage != "withdrawn"]
    return {
        "observers": [_observer(plan, one) for one in people],
        "clips": [row for one in stayed for row in _clips(plan, one)],
    }


def _timed(one: Person) -> list[tuple[Event, Event | None]]:
    """Each answer to a clip, and when its page was first shown."""
    shown = {e.source_sequence: e for e in one.events if e.source == "shown"}
    return [(answer, shown.get(answer.source_sequence)) for answer in one.answers("labels")]


def _observer(plan: CollectPlan, one: Person) -> Row:
    state, why = one.state, one.state.left_out
    withdrawn = state.stage == "withdrawn"
    facts = {f: p for f, p in state.belief.items() if f != "none" and not withdrawn}
    best = max(facts, key=lambda f: facts[f], default=None)
    timed = _timed(one)
    each = [
        took / len(answer.payload["labels"])
        for answer, shown in timed
        if shown and (took := seconds(shown, answer)[0]) is not None
    ]
    begun = timed[0][1] if timed else None
    took, clock = seconds(begun, timed[-1][0]) if begun else (None, None)
    stated = {} if withdrawn else dict(enumerate(state.stated))
    given = [] if withdrawn else [event.payload for event in one.answers("answers")]
    return {
        "observer": one.id,
        "stream": one.stream,
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
        + sum(not event.payload["label"] for event in one.answers("ahead")),
        "entered": one.events[0].wall,
        "entry": one.about["entry"],
        "consent_hash": one.first("consent").get("text"),
        **{
            f"stated_{fact.name}": STATED[stated[j]] if stated else None
            for j, fact in enumerate(plan.facts)
        },
        **{f"answer_{q.name}": given[0].get(q.name, "") if given else None for q in plan.asked},
    }


def _clips(plan: CollectPlan, one: Person) -> Iterator[Row]:
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
            "browser_ms": answer.browser,
        }


# How people listened ---------------------------------------------------------------------------
#
# On most pages messages hold for that page alone. At the end (``rules.listening``) they hold from
# then on: a step that made no sense is shown with the message that explains it, some pages later
# with nothing said, and then with the message said again. A label of 0 at first was a message
# missed, a label that falls back one forgotten, unless the person erred: an exact filter over
# (facts believed incorrectly, habits, messages known now) weighs it, as in an explanation.

FACT_SETS = 64
"""The likeliest of a person, by their answers to all questions; others are left out."""


@dataclass(frozen=True)
class Asked:
    """The pages of one person.

    Attributes:
        known: labels of people who believe some facts incorrectly.
        held: [N] fact sets that may be the person's, as bitmasks.
        prior: [N] how likely each is before any answer.
        clips: all pages but the obvious step, in order, with their labels.
    """

    known: Hypotheses
    held: NDArray[np.int64]
    prior: NDArray[np.float64]
    clips: Sequence[AskedClip]

    def posterior(self, habits: Habits) -> NDArray[np.float64]:
        """[F] how likely each habit is to be the person's."""
        weight = np.outer(self.prior, habits.prior).ravel()
        lasting = [clip for clip in self.clips if clip.purpose in HEEDED]
        for clip in self.clips:
            if clip.purpose not in HEEDED:
                weight = self._through([clip], weight, habits)
                weight /= weight.sum()
        found = self._through(lasting, weight, habits).reshape(-1, len(habits)).sum(axis=0)
        return np.asarray(found / found.sum())

    def _through(
        self, clips: Sequence[AskedClip], weight: NDArray[np.float64], habits: Habits
    ) -> NDArray[np.float64]:
        """The weights [N F] of (fact set, habit), times what pages tell on which what is said holds
        from page to page; nothing is known before."""
        told = sorted({j for clip in clips for j in indices(clip.told)})
        relevant = np.tile(np.array(told, np.int64), (len(weight), 1))
        accept, lose = (np.tile(rate, len(self.held)) for rate in (habits.accept, habits.forget))
        table = self.known.row(self.held & ~subsets(told)[:, None])
        belief = np.zeros((len(table), len(weight)))
        belief[0] = weight
        for clip in clips:
            for j in indices(clip.told):
                belief = after_message(belief, relevant, j, accept)
            judged = clip.judged
            for transition, label in zip(judged.transitions, judged.labels, strict=True):
                one = habits.answered(self.known.labels[table, transition].astype(float))
                belief = belief * (one if label else 1 - one)
            belief = after_forgetting(belief.ravel(), lose).reshape(belief.shape)
        return np.asarray(belief.sum(axis=0))


def listeners_in(database: Path, stream: str = "person") -> list[Asked]:
    """The people of a stream whose labels count, but for those whom no hypothesis fits.

    Args:
        database: of a collection that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.

    Raises:
        InputError: it is no collection's database, there is no such stream, or nothing was told
            that holds from page to page.
    """
    one_of("stream", stream, STREAMS)
    plan, people = read(database, CollectPlan, CollectState)
    states = [one.state for one in people if one.stream == stream]
    if not plan.rules.listening:
        wanted = "1 or more at the start of the collection: nothing was asked again"
        raise InputError("rules.listening", 0, wanted)
    kept = [state for state in states if not state.left_out and state.belief["none"] < 0.5]
    if not kept:
        raise InputError("database", str(database), f"one with answers (stream {stream})")
    return [asked_of(plan, state) for state in kept]


def asked_of(plan: CollectPlan, state: CollectState) -> Asked:
    """The pages of somebody who came to the end of them."""
    known = plan.hypotheses
    before = np.bincount(known.classes, prior(plan, state.others))
    shares = {int(facts): share for facts, share in state.belief.items() if facts != "none"}
    held = np.array(sorted(shares, key=lambda facts: -shares[facts])[:FACT_SETS])
    own = before[known.classes[known.row(held)]]
    clips = tuple(clip for clip in state.answered if clip.purpose != ATTENTION)
    return Asked(known, held, own / own.sum(), clips)
