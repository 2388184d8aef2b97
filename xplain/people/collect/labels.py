"""From participants to a table of labels, and to the types that are in it so far."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from xplain.explanation.message_sets import names_of
from xplain.learning.data.dataset import Dataset
from xplain.learning.evidence import Evidence
from xplain.learning.mixture.labeler import KnownAnswers
from xplain.learning.mixture.likelihood import KnownTransitions
from xplain.people.collect.asking import FINISHED, STATED, CollectState
from xplain.people.collect.plan import CollectPlan

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
