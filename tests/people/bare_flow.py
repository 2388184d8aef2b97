"""Simulated people in the bare flow, without a server: for tests and benchmarks."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.datastructures import ImmutableMultiDict

from tests.people.street import FAULTLESS_OBSERVER
from xplain.people.bots import Bot, Page
from xplain.people.collect.asking import CollectState, mean_posterior
from xplain.people.collect.bot import Habits, Observer, bot
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectPlan
from xplain.people.flow import Flow, S
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study, StudyState


def page_of(view: Mapping[str, Any]) -> Page:
    """Makes the content that simulated people read from the view of a page."""
    stage, new, fields = view["stage"], view.get("new", ()), dict[str, Any]()
    told = view.get("told", [*view.get("old", ()), *new])
    if stage == "practice" and view["part"]:
        told = [view["example"].message]
    elif stage == "evaluation":
        fields = {f"label_{i}": [] for i in range(view["step"] + 1)}
    elif stage == "quiz":
        fields = {"true": view["statements"]}
    elif stage == "beliefs":
        fields = {f"fact_{j}": pair for j, pair in view["statements"]}
    return Page(stage, view.get("briefing", ()), told, new, fields, view.get("transitions", ()))


def answer(flow: Flow[Any, S], person: Bot[Any, Any], state: S) -> tuple[str, dict[str, Any]]:
    """Returns kind and payload of a person's answer to the page of a state."""
    kind, (filled, _) = flow.waits_for(state), person.fill(page_of(flow.view(state)))
    return kind, flow.read(state, kind, ImmutableMultiDict(filled))


def walk(flow: Flow[Any, S], person: Bot[Any, Any], state: S) -> S:
    """Leads a person from a state to the end, or to the page where the person leaves."""
    while not state.over and not person.leaves(page_of(flow.view(state))):
        state = flow.advance(state, *answer(flow, person, state))
    return state


def take_part(study: Study, person: StudyBot, user_type: int, condition: str) -> StudyState:
    """Simulates one participant of a study, from the briefing on."""
    role = study.plan.roles[user_type]
    orders = {"quiz": range(len(role.quiz)), "eligibility": range(len(role.eligibility))}
    place = {"position": None, "user_type": user_type, "condition": condition}
    state = study.after(StudyState(), **place, orders=orders)
    return walk(study, person, replace(state, stage="briefing"))


def observe(
    collection: Collection,
    person: Observer,
    number: int,
    others: Mapping[str, float] | None = None,
    role: int | None = None,
) -> CollectState:
    """Simulates one observer of a collection; ``others`` is the distribution of earlier observers'
    incorrect beliefs."""
    consent = {"number": number, "role": role, "others": others or {}}
    return walk(collection, person, collection.after(CollectState(), **consent))


def somebody(
    collection: Collection, held: int, number: int = 0, habits: Habits = FAULTLESS_OBSERVER
) -> CollectState:
    """Simulates the observer with this number, who believes these facts incorrectly."""
    person = Observer(collection.plan, held, habits, np.random.default_rng(number))
    return observe(collection, person, number)


def crowd(plan: CollectPlan, people: int, habits: Habits, seed: int) -> list[CollectState]:
    """Simulates observers one after the other; the roles take turns."""
    collection, states = Collection(plan), list[CollectState]()
    for number in range(people):
        person = bot(plan, habits, seed, number)
        others = mean_posterior([state.belief for state in states])
        role = number % len(plan.roles) if plan.assigned else None
        # Each simulated collection draws questions and their order anew.
        states.append(observe(collection, person, seed * 10_000 + number, others, role))
    return states


def truth_of(plan: CollectPlan, people: int) -> NDArray[np.int64]:
    """Returns [people] the facts that each simulated observer believes incorrectly; roles that
    behave alike have the same facts."""
    known = plan.hypotheses
    held = np.array([plan.roles[i % len(plan.roles)].held for i in range(people)])
    return known.essential[known.row(held)]


def attend(store: Store, person: Bot[Any, Any], stream: str = "person") -> str:
    """Leads a person with a new invitation, without pages, to the end or to the page where the
    person leaves. Stores everything that a server would store. Returns the person's id."""
    flow, who = store.flow, store.enter_invited(store.invite(1, stream)[0])
    state, text = flow.STATE(), flow.plan.texts.consent_hash
    while not state.over and not person.leaves(page_of(flow.view(state))):
        store.show(store.participant(who), state)
        kind, payload = answer(flow, person, state)
        if kind == "consent":
            payload |= {"text": text}
        state = store.submit(who, state.accepted, kind, payload)
    return who
