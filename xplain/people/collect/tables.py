"""Tables from a snapshot of the database: ``collect export``.

``labels.csv`` is the input of ``xplain discover``, together with ``hypotheses.npz``, from which the
questions were chosen. ``observers.csv`` describes the people who gave the labels, and ``clips.csv``
the pages of these people. People, pilots and bots never share a table of labels.
"""

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
from xplain.learning.user_types import NOISY
from xplain.people.collect.asking import ATTENTION, HEEDED, STATED, AskedClip, CollectState, prior
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectPlan
from xplain.people.export import Row, measure_seconds, write
from xplain.people.flow import CANNOT_TELL, STREAMS, Event, Participant, People
from xplain.people.log import read

CONCENTRATION = 1.0
"""α of the Dirichlet process over types, as in ``clusterer=dirichlet``."""
SURE = 0.95
"""Posterior above which a person's incorrect beliefs count as known."""


def dataset_of(plan: CollectPlan, people: Mapping[str, CollectState]) -> Dataset:
    """Collects the labels of these people's questions as a dataset. Repetitions and the obvious
    step are no questions, and "I cannot tell" is no label."""
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
        wrong: names of the facts that the type believes incorrectly.
        members: indices of the people who have the type.
        posterior: mean probability that a member, judged alone, believes exactly these facts
            incorrectly.
    """

    wrong: tuple[str, ...]
    members: tuple[int, ...]
    posterior: float


@dataclass(frozen=True)
class KnownSoFar:
    """The results after N people.

    Attributes:
        types: the types, largest first.
        error: learned share of wrong answers.
        unsure: number of people whose most likely fact set has a posterior of at most SURE.
        unlike: mean probability that no hypothesis fits a person.
        evidence: how well hypotheses predicted the answers.
        new_types: expected number of new types in another ten people.
        next_new: probability that the next person has a new type.
    """

    types: tuple[FoundType, ...]
    error: float
    unsure: int
    unlike: float
    evidence: Evidence
    new_types: float
    next_new: float

    @property
    def doubtful(self) -> bool:
        """True if so many answers are wrong that the types may be wrong, as in ``discover``."""
        return self.error > NOISY


def fact_sets(plan: CollectPlan, people: Sequence[CollectState]) -> tuple[NDArray[np.int64], float]:
    """Clusters people by the Dirichlet process over fact sets, as ``discover`` does with the same
    hypotheses. Returns the facts [N] that each person's type believes incorrectly, and the share of
    wrong answers."""
    asked = _collect_answers(plan, people)
    facts, model, _ = asked.partition(CONCENTRATION)
    return facts, model.wrong(asked.dataset.transition, asked.dataset.observer)


def _collect_answers(plan: CollectPlan, people: Sequence[CollectState]) -> KnownAnswers:
    """Collects the labels of these people about transitions that the hypotheses contain."""
    data = dataset_of(plan, {str(o): state for o, state in enumerate(people)})
    return KnownAnswers.of(KnownTransitions.of(plan.hypotheses), data)


def find_types_so_far(plan: CollectPlan, people: Sequence[CollectState]) -> KnownSoFar | None:
    """Finds the types so far; None before the second person."""
    if len(people) < 2:
        return None
    facts, error = fact_sets(plan, people)
    members = {held: np.flatnonzero(facts == held).tolist() for held in np.unique(facts).tolist()}
    types = [
        FoundType(
            wrong=names_of(held, plan.hypotheses.messages),
            members=tuple(own),
            posterior=float(np.mean([people[i].belief.get(str(held), 0.0) for i in own])),
        )
        for held, own in sorted(members.items(), key=lambda item: -len(item[1]))
    ]
    best = [max([p for f, p in s.belief.items() if f != "none"], default=0.0) for s in people]
    next_new, new_types = predict_new_types(len(types), len(people), 10)
    return KnownSoFar(
        types=tuple(types),
        error=error,
        unsure=sum(one <= SURE for one in best),
        unlike=float(np.mean([state.belief.get("none", 0.0) for state in people])),
        evidence=_collect_answers(plan, people).evidence(np.unique(facts, return_inverse=True)[1]),
        new_types=new_types,
        next_new=next_new,
    )


def glance(collection: Collection, people: People) -> dict[str, Any]:
    """Computes figures for the researcher's page: the labels so far, the types found in these
    labels, and the expected number of new types in more people. The figures are about people, or
    about bots if no person has taken part yet."""
    plan, found = collection.plan, collection.found
    whose = "person" if any(one.stream == "person" for one in people) else "bot"
    states = {one.id: one.state for one in people if one.stream == whose}
    kept = {who: state for who, state in states.items() if not state.left_out}
    key = tuple(kept)
    if key not in found:
        found.clear()  # old results are never needed again
        found[key] = find_types_so_far(plan, list(kept.values()))
    left_out = [state.left_out for state in states.values()]
    return {
        "of": whose,
        "labels": sum(len(c.labels) for s in kept.values() for c in s.questions()),
        "finished": len(kept),
        "left_out": {why: left_out.count(why) for why in sorted({*left_out} - {""})},
        "found": found[key],
        "compared": count_agreement(plan, list(kept.values())),
        "facts": {fact.name: fact.message for fact in plan.facts},
        "planned": plan.rules.people,
    }


def count_agreement(plan: CollectPlan, people: Sequence[CollectState]) -> dict[str, dict[str, int]]:
    """Counts people for each fact. Returns four numbers for each fact, by the fact's name:

    - "of": people who stated a belief at the end.
    - "said": people who stated the incorrect belief.
    - "inferred": people whose answers show the incorrect belief.
    - "agree": people whose statement agrees with their answers.

    People who stated that they are unsure about a fact are not counted for this fact. Facts without
    counted people are left out.
    """
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


def predict_new_types(types: int, people: int, more: int) -> tuple[float, float]:
    """Predicts the new types in more people, after ``types`` types were found in ``people`` people
    (Ewens' sampling formula).

    The concentration α is the value at which the expected number of types, Σ α / (α + i) over i <
    people, is ``types``. α has a minimum, at which about 1.5 types are expected: without it, a
    single found type would give α = 0, and new types would have probability 0.

    Returns:
        The probability that the next person has a new type, and the expected number of new types in
        ``more`` people.
    """

    def expected(alpha: float) -> float:
        return float((alpha / (alpha + np.arange(people))).sum())

    if types >= people:  # every person has a different type, so α would be infinite
        return 1.0, float(more)
    low = 0.5 / np.log1p(people)
    # brentq needs a sign change, and expected(low) may already exceed one type.
    alpha = low if expected(low) >= types else brentq(lambda a: expected(a) - types, low, 1e6)
    new = alpha / (alpha + people + np.arange(more))
    return float(new[0]), float(new.sum())


FAST = 1.0
"""Seconds per step below which a page cannot have been read."""
Person = Participant[CollectState]


def export(database: Path, folder: Path) -> str:
    """Writes all tables of a database, or better of a snapshot, into a folder. Returns the SHA-256
    of the events.

    Raises:
        InputError: the file is not a collection's database.
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
    """Makes the rows of every table except the labels, by name. Answers of people who withdrew are
    left out."""
    stayed = [one for one in people if one.state.stage != "withdrawn"]
    return {
        "observers": [_describe_observer(plan, one) for one in people],
        "clips": [row for one in stayed for row in _list_clips(plan, one)],
    }


def _pair_with_pages(one: Person) -> list[tuple[Event, Event | None]]:
    """Returns each answer to a clip, with the event that first showed the clip's page."""
    shown = {e.source_sequence: e for e in one.events if e.source == "shown"}
    return [(answer, shown.get(answer.source_sequence)) for answer in one.answers("labels")]


def _describe_observer(plan: CollectPlan, one: Person) -> Row:
    state, why = one.state, one.state.left_out
    withdrawn = state.stage == "withdrawn"
    facts = {f: p for f, p in state.belief.items() if f != "none" and not withdrawn}
    best = max(facts, key=lambda f: facts[f], default=None)
    timed = _pair_with_pages(one)
    each = [
        took / len(answer.payload["labels"])
        for answer, shown in timed
        if shown and (took := measure_seconds(shown, answer)[0]) is not None
    ]
    begun = timed[0][1] if timed else None
    took, clock = measure_seconds(begun, timed[-1][0]) if begun else (None, None)
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


def _list_clips(plan: CollectPlan, one: Person) -> Iterator[Row]:
    known = plan.hypotheses
    for number, (clip, (answer, shown)) in enumerate(
        zip(one.state.answered, _pair_with_pages(one), strict=True)
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
            "seconds": measure_seconds(shown, answer)[0] if shown else None,
            "browser_ms": answer.browser,
        }


# How people listened ---------------------------------------------------------------------------
#
# On most pages a message is valid for that page alone. At the end (``rules.listening``) messages
# stay valid: a step that made no sense is shown with the message that explains it, some pages
# later without the message, and then with the message again. If the person makes no error, a first
# label of 0 means a missed message, and a later label of 0 a forgotten message. An exact filter
# over (facts believed incorrectly, habits, known messages) computes this, as in an explanation.

FACT_SETS = 64
"""Maximum number of fact sets of a person: the most likely fact sets, given all answers."""


@dataclass(frozen=True)
class PersonAnswers:
    """The answered pages of one person, and the fact sets that the person may believe incorrectly.

    Attributes:
        known: the hypotheses: the label of each transition for people who believe a fact set
            incorrectly.
        held: [N] fact sets that the person may believe incorrectly, as bitmasks.
        prior: [N] probabilities of these fact sets before any answer.
        clips: all pages except the page with the obvious step, in order, with their labels.
    """

    known: Hypotheses
    held: NDArray[np.int64]
    prior: NDArray[np.float64]
    clips: Sequence[AskedClip]

    def posterior(self, habits: Habits) -> NDArray[np.float64]:
        """Computes the posterior of each of the F habits in ``habits``. Returns [F]."""
        weight = np.outer(self.prior, habits.prior).ravel()
        lasting = [clip for clip in self.clips if clip.purpose in HEEDED]
        for clip in self.clips:
            if clip.purpose not in HEEDED:
                weight = self._update_weights([clip], weight, habits)
                weight /= weight.sum()
        found = self._update_weights(lasting, weight, habits).reshape(-1, len(habits)).sum(axis=0)
        return np.asarray(found / found.sum())

    def _update_weights(
        self, clips: Sequence[AskedClip], weight: NDArray[np.float64], habits: Habits
    ) -> NDArray[np.float64]:
        """Multiplies the weights of the pairs (fact set, habit) by the likelihoods of the labels on
        some pages. Messages stay valid from page to page; at first the person knows no message.

        Args:
            clips: the pages.
            weight: [N · F] weights of the pairs, before these pages.
            habits: F habits.

        Returns:
            [N · F] the new weights, not normalised.
        """
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
                one = habits.add_errors(self.known.labels[table, transition].astype(float))
                belief = belief * (one if label else 1 - one)
            belief = after_forgetting(belief.ravel(), lose).reshape(belief.shape)
        return np.asarray(belief.sum(axis=0))


def listeners_in(database: Path, stream: str = "person") -> list[PersonAnswers]:
    """Lists the people of a stream whose labels are used, except those whom no hypothesis fits.

    Args:
        database: a collection's database that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.

    Raises:
        InputError: the file is not a collection's database, the stream does not exist, or no
            messages stay valid from page to page.
    """
    one_of("stream", stream, STREAMS)
    plan, people = read(database, CollectPlan, CollectState)
    states = [one.state for one in people if one.stream == stream]
    if not plan.rules.listening:
        wanted = "1 or more at the start of the collection: nothing was asked again"
        raise InputError("rules.listening", 0, wanted)
    kept = [state for state in states if not state.left_out and state.belief["none"] < 0.5]
    if not kept:
        raise InputError("database", str(database), f"a database with answers (stream {stream})")
    return [collect_pages(plan, state) for state in kept]


def collect_pages(plan: CollectPlan, state: CollectState) -> PersonAnswers:
    """Collects the pages of a person who answered all clips."""
    known = plan.hypotheses
    before = np.bincount(known.classes, prior(plan, state.others))
    shares = {int(facts): share for facts, share in state.belief.items() if facts != "none"}
    held = np.array(sorted(shares, key=lambda facts: -shares[facts])[:FACT_SETS])
    own = before[known.classes[known.row(held)]]
    clips = tuple(clip for clip in state.answered if clip.purpose != ATTENTION)
    return PersonAnswers(known, held, own / own.sum(), clips)
