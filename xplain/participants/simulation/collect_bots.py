"""Simulated observers against a running collection: ``collect bots key=… count=24``."""

from __future__ import annotations

from collections import Counter

from xplain.collect.protocol.plan import CollectPlan
from xplain.collect.simulation.observer import Habits, Observer, observer
from xplain.collect.stored import plan_of
from xplain.participants.simulation.bots import Researcher, crowd
from xplain.participants.simulation.http_client import Page


def fill(person: Observer, page: Page) -> tuple[list[tuple[str, str]], float]:
    """The fields that an observer fills in, and how long it took them, in seconds."""
    if page.stage == "consent":
        return [("agree", "1")], 0.0
    if page.stage == "task":
        if page.facts:
            person.briefed(page.facts)
    elif page.stage == "practice":
        part = page.messages == [person.plan.example.speaks_for]
        return [("label", str(person.practises(part)))], 0.0
    elif page.stage == "clips":
        transitions = [int(step) for step in page.steps if step]
        labels, seconds = person.labels(transitions, page.messages)
        return [(f"label_{i}", str(label)) for i, label in enumerate(labels)], seconds
    elif page.stage == "beliefs":
        facts = [int(name.removeprefix("fact_")) for name in page.groups()]
        stated = zip(facts, person.states(facts), strict=True)
        return [(f"fact_{j}", str(value)) for j, value in stated], 0.0
    return [], 0.0


def plan(researcher: Researcher) -> CollectPlan:
    """The plan of a running collection."""
    with researcher.snapshot() as connection:
        return plan_of(connection)


def run(
    url: str,
    key: str,
    count: int,
    at_once: int,
    pace: float,
    habits: Habits,
    seed: int,
    in_chromium: bool,
) -> Counter[str]:
    """Lets observers take part, the roles of the plan in turn; how many ended at which stage. See
    :func:`xplain.participants.simulation.bots.run`."""
    researcher = Researcher(url, key)
    own = plan(researcher)

    def person(number: int) -> Observer:
        return observer(own, habits, seed, number)

    return crowd(researcher, count, at_once, pace, person, fill, in_chromium)
