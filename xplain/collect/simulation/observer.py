"""Simulated observers: they read what a page says, answer as what they hold wrong makes them, err
now and then, lapse, and leave.

The same observer takes part in the bare protocol, over HTTP, and in a real browser.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from xplain.collect.protocol import machine
from xplain.collect.protocol.plan import Collection, CollectPlan
from xplain.collect.protocol.state import State
from xplain.collect.protocol.view import page
from xplain.errors import InputError
from xplain.participants.simulation.http_client import Page
from xplain.randomness import stream


@dataclass(frozen=True)
class Habits:
    """Assumptions about observers.

    Attributes:
        error: probability of the wrong label, step by step.
        lapse: probability that a page is clicked through: its labels are tosses of a coin.
        mistake: probability of a wrong answer in the practice.
        leaving: probability of leaving at each page.
        seconds: to read and judge a step; σ of its logarithm is 0.4.
    """

    error: float = 0.05
    lapse: float = 0.0
    mistake: float = 0.02
    leaving: float = 0.0
    seconds: float = 6.0

    def __post_init__(self) -> None:
        """Raises InputError: no probability, or no time."""
        for key in ("error", "lapse", "mistake", "leaving"):
            if not 0 <= getattr(self, key) <= 1:
                raise InputError(f"habits.{key}", getattr(self, key), "a probability")
        if not self.seconds >= 0:
            raise InputError("habits.seconds", self.seconds, "a number ≥ 0")


class Observer:
    """One simulated observer.

    Args:
        plan: for the sentences, and the labels of people of each role.
        held: bitmask of the facts that they hold wrong; a briefing changes it.
        habits: how they behave.
        rng: their stream.
    """

    def __init__(
        self, plan: CollectPlan, held: int, habits: Habits, rng: np.random.Generator
    ) -> None:
        self.plan, self.held, self.habits, self.rng = plan, held, habits, rng

    def _chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def leaves(self) -> bool:
        """Whether this page is where they drop out."""
        return self._chance(self.habits.leaving)

    def briefed(self, sentences: Sequence[str]) -> None:
        """Takes over what the briefing says."""
        told = [role.briefing for role in self.plan.roles]
        self.held = self.plan.roles[told.index(tuple(sentences))].held

    def practises(self, part: int) -> int:
        """The label of the practice step."""
        return int(part) ^ int(self._chance(self.habits.mistake))

    def labels(self, transitions: Sequence[int], told: Sequence[str]) -> tuple[list[int], float]:
        """Labels of a clip's transitions with these messages on the page, and the seconds that it
        took; none stands for the obvious step."""
        sentences = [fact.message for fact in self.plan.facts]
        mask = sum(1 << sentences.index(sentence) for sentence in told)
        known = self.plan.hypotheses
        row = int(known.row(np.array(self.held & ~mask)))
        true = [int(known.labels[row, t]) for t in transitions] or [0]
        if self._chance(self.habits.lapse):
            labels = self.rng.integers(0, 2, len(true)).tolist()
        else:
            labels = [label ^ self._chance(self.habits.error) for label in true]
        seconds = self.habits.seconds * self.rng.lognormal(0, 0.4, len(true)).sum()
        return labels, float(seconds)

    def states(self, facts: Sequence[int]) -> list[int]:
        """What they believe of each fact: an index into STATED."""
        return [self.held >> j & 1 for j in facts]

    def fill(self, page: Page) -> tuple[list[tuple[str, str]], float]:
        """The fields that they fill in on a page, and how long it took them, in seconds."""
        if page.stage == "consent":
            return [("agree", "1")], 0.0
        if page.stage == "task":
            if page.facts:
                self.briefed(page.facts)
        elif page.stage == "practice":
            part = page.messages == [self.plan.example.speaks_for]
            return [("label", str(self.practises(part)))], 0.0
        elif page.stage == "clips":
            transitions = [int(step) for step in page.steps if step]
            labels, seconds = self.labels(transitions, page.messages)
            return [(f"label_{i}", str(label)) for i, label in enumerate(labels)], seconds
        elif page.stage == "beliefs":
            facts = [int(name.removeprefix("fact_")) for name in page.groups()]
            stated = zip(facts, self.states(facts), strict=True)
            return [(f"fact_{j}", str(value)) for j, value in stated], 0.0
        return [], 0.0


def observer(plan: CollectPlan, habits: Habits, seed: int, number: int) -> Observer:
    """The simulated observer with a number; the roles take turns."""
    held = plan.roles[number % len(plan.roles)].held
    return Observer(plan, held, habits, stream(seed, "bots", number))


def answers(person: Observer, view: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The kind and payload with which an observer answers a page, in the bare protocol."""
    stage = view["stage"]
    if stage == "task":
        if "briefing" in view:
            person.briefed(view["briefing"])
        return "read", {}
    if stage == "practice":
        return "example", {"label": person.practises(view["part"])}
    if stage == "clips":
        return "labels", {"labels": person.labels(view["transitions"], view["told"])[0]}
    if stage == "beliefs":
        return "beliefs", {"stated": person.states(range(len(person.plan.facts)))}
    return "answers", {}


def take_part(
    collection: Collection,
    person: Observer,
    number: int,
    others: dict[str, float],
    role: int | None = None,
) -> State:
    """One observer in the bare protocol, to the end or to where they leave.

    Args:
        collection: the plan at work.
        person: who answers.
        number: of the participant.
        others: what those asked before hold wrong (:func:`xplain.collect.protocol.asking.shared`).
        role: whose briefing they get, if any.
    """
    payload: dict[str, Any] = {
        "agree": 1,
        "text": collection.plan.texts.consent_hash,
        "number": number,
        "role": role,
        "others": others,
    }
    state = machine.advance(collection, State(), "consent", payload).state
    while not state.over and not person.leaves():
        kind, payload = answers(person, page(collection, state))
        state = machine.advance(collection, state, kind, payload).state
    return state
