"""The protocol of a collection, from consent to the completion code: a pure state machine.

``advance(collection, state, kind, payload)`` is the whole of it. No clock, no storage, no web;
what comes from elsewhere (a number, a briefing, what others hold wrong) is passed in with the
consent event. The same events give the same states and questions, which is what the replay checks.

    consent → task → practice → clips → beliefs → questions → done

and from anywhere to an end: declined, withdrawn, timed_out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from xplain.collect.protocol import asking
from xplain.collect.protocol.plan import Collection
from xplain.collect.protocol.state import (
    KINDS,
    QUESTION,
    STATED,
    Answer,
    Decision,
    Outcome,
    State,
)
from xplain.errors import Refused


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
    words = collection.plan.texts.words
    if state.over:
        raise Refused(words["ended"])
    if kind == "withdraw":
        return _to(state, stage="withdrawn")
    if kind == "time_out":
        return _to(state, stage="timed_out")
    if kind != KINDS[state.stage]:
        raise Refused(words["other_page"])
    return _STEPS[state.stage](collection, state, payload)


def _to(state: State, **changes: Any) -> Outcome:
    return Outcome(replace(state, accepted=state.accepted + 1, **changes))


def _consent(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    texts = collection.plan.texts
    agreed = _choice(payload.get("agree"), 2, texts.words["choose_consent"])
    if payload.get("text") != texts.consent_hash:
        raise Refused(texts.words["consent_changed"])
    if not agreed:
        return _to(state, stage="declined")
    return _to(
        state,
        stage="task",
        number=payload["number"],
        role=payload["role"],
        others=payload["others"],
    )


def _task(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    return _to(state, stage="practice")


def _practice(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    label = _choice(payload.get("label"), 2, collection.plan.texts.words["choose"])
    if label != state.part:  # no sense under the first sentence, sense under the second
        return _to(state, wrong=True)
    if state.part == 0:
        return _to(state, part=1, wrong=False)
    return _next(collection, replace(state, wrong=False), None)


def _labels(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    clip = state.clip
    assert clip is not None, "a clip is on the page"
    missing = collection.plan.texts.words["choose_each"]
    labels = payload.get("labels")
    if not isinstance(labels, list) or len(labels) != clip.size:
        raise Refused(missing)
    chosen = tuple(_choice(label, 2, missing) for label in labels)
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
        return replace(_to(state, stage="beliefs"), answer=answer)
    clip = asking.clip(plan, state, tasks[step], known)
    bits = 0.0
    if clip.purpose == QUESTION:
        bits = known.information((list(clip.transitions), clip.told))
    decision = Decision(step, belief, clip, bits)
    return replace(_to(state, stage="clips", clip=clip), decision=decision, answer=answer)


def _beliefs(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    plan = collection.plan
    stated, missing = payload.get("stated"), plan.texts.words["answer_every"]
    if not isinstance(stated, list) or len(stated) != len(plan.facts):
        raise Refused(missing)
    chosen = tuple(_choice(one, len(STATED), missing) for one in stated)
    return _to(state, stage="questions" if plan.asked else "done", stated=chosen)


def _questions(collection: Collection, state: State, payload: Mapping[str, Any]) -> Outcome:
    asked, words = collection.plan.asked, collection.plan.texts.words
    for one in asked:
        value = payload.get(one.name, "")
        if not isinstance(value, str) or len(value) > one.max_length:
            raise Refused(f"{one.label}: {words['too_long']} ({one.max_length})")
        if value and one.kind == "choice" and value not in one.choices:
            raise Refused(f"{one.label}: {words['choose']}")
        if value and one.kind == "number":
            whole = value.isascii() and value.isdigit() and len(value) < 10
            if not whole or not one.low <= int(value) <= one.high:
                raise Refused(f"{one.label}: {words['no_number']} {one.low} … {one.high}.")
    if payload.keys() - {one.name for one in asked}:
        raise Refused(words["other_page"])
    return _to(state, stage="done")


def _choice(value: object, count: int, otherwise: str) -> int:
    """An integer 0 … count − 1 (true booleans count as what they are)."""
    if not isinstance(value, int) or not 0 <= value < count:
        raise Refused(otherwise)
    return int(value)


_STEPS = {
    "consent": _consent,
    "task": _task,
    "practice": _practice,
    "clips": _labels,
    "beliefs": _beliefs,
    "questions": _questions,
}
