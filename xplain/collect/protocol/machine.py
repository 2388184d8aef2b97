"""The protocol of a collection, from consent to the completion code: a pure state machine.

``advance(collection, state, kind, payload)`` is the whole of it. No clock, no storage, no web;
what comes from elsewhere (a number, a briefing, what others hold wrong) is passed in with the
consent event. The same events give the same states and questions, which is what the replay checks.

    consent → task → practice → clips → beliefs → questions → done

and from anywhere to an end: declined, withdrawn, timed_out. From the last of these a participant
may return to where they were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from xplain.collect.protocol import asking
from xplain.collect.protocol.plan import Collection
from xplain.collect.protocol.state import (
    QUESTION,
    STATED,
    Decision,
    Outcome,
    State,
)
from xplain.participants.protocol.answers import check, choice, choices, consents
from xplain.participants.protocol.state import Answer, at_any_stage


def advance(collection: Collection, state: State, kind: str, payload: Mapping[str, Any]) -> Outcome:
    """The state after an event.

    Args:
        collection: the plan at work.
        state: before.
        kind: of the event.
        payload: what came with it.

    Raises:
        Refused: the event does not fit the stage, or its payload is not what the stage asks for.
    """
    outcome = at_any_stage(state, kind, collection.plan.texts.words)
    return outcome or _STEPS[state.stage](collection, state, payload)


def _consent(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    if not consents(collection.plan.texts, payload):
        return state.to(stage="declined")
    return state.to(
        stage="task",
        number=payload["number"],
        role=payload["role"],
        others=payload["others"],
    )


def _task(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    return state.to(stage="practice")


def _practice(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    label = choice(payload.get("label"), 2, collection.plan.texts.words["choose"])
    if label != state.part:  # no sense under the first sentence, sense under the second
        return state.to(wrong=True)
    if state.part == 0:
        return state.to(part=1, wrong=False)
    return _next(collection, replace(state, wrong=False), None)


def _labels(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    clip = state.clip
    assert clip is not None, "a clip is on the page"
    missing = collection.plan.texts.words["choose_each"]
    chosen = choices(payload.get("labels"), [2] * clip.size, missing)
    labelled = replace(state, answered=(*state.answered, replace(clip, labels=chosen)), clip=None)
    return _next(collection, labelled, chosen)


def _next(collection: Collection, state: State, labels: tuple[int, ...] | None) -> Outcome:
    """The next clip, or the end of the clips; ``labels`` were given to the last one."""
    plan, step = collection.plan, len(state.answered)
    known = asking.questionnaire(collection, state)
    belief = asking.belief(known)
    answer = None if labels is None else Answer(step - 1, labels, belief)
    state = replace(state, belief=belief)
    tasks = asking.schedule(plan, state.person)
    if step == len(tasks):
        return replace(state.to(stage="beliefs"), answer=answer)
    clip = asking.clip(plan, state, tasks[step], known)
    bits = 0.0
    if clip.purpose == QUESTION:
        bits = known.information((list(clip.transitions), clip.told))
    decision = Decision(step, belief, clip, bits)
    return replace(state.to(stage="clips", clip=clip), decision=decision, answer=answer)


def _beliefs(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    plan = collection.plan
    missing = plan.texts.words["answer_all"]
    chosen = choices(payload.get("stated"), [len(STATED)] * len(plan.facts), missing)
    return state.to(stage="questions" if plan.asked else "done", stated=chosen)


def _questions(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    check(collection.plan.asked, payload, collection.plan.texts.words)
    return state.to(stage="done")


_STEPS = {
    "consent": _consent,
    "task": _task,
    "practice": _practice,
    "clips": _labels,
    "beliefs": _beliefs,
    "questions": _questions,
}
