"""What a participant sees at each stage, in plain values for whatever draws it."""

from __future__ import annotations

from typing import Any

from xplain.collect.protocol.asking import questions_of
from xplain.collect.protocol.plan import Collection, CollectPlan
from xplain.collect.protocol.state import ATTENTION, Clip, State
from xplain.message_sets import indices
from xplain.randomness import stream


def page(collection: Collection, state: State) -> dict[str, Any]:
    """What the participant sees now: sentences, steps, questions in their order.

    Nothing of the hypotheses, the posterior, or what a clip is for is in it.
    """
    plan = collection.plan
    view: dict[str, Any] = {"stage": state.stage, "sequence": state.accepted, "wrong": state.wrong}
    if state.stage in ("task", "clips", "beliefs") and state.role is not None:
        view["briefing"] = plan.roles[state.role].briefing
    if state.stage == "practice":
        example = plan.example
        told = example.speaks_for if state.part else example.against
        view |= {"part": state.part, "told": [told], "action": example.action}
    elif state.stage == "clips" and state.clip is not None:
        view |= _clip(plan, state.clip) | {
            "clip_number": len(state.answered) + 1,
            "clip_count": _count(plan),
        }
    elif state.stage == "beliefs":
        view["statements"] = statements(plan, state.person)
    elif state.stage == "questions":
        view["asked"] = plan.asked
    return view


def statements(plan: CollectPlan, number: int) -> list[tuple[int, list[tuple[int, str]]]]:
    """The facts in an order of the participant's own, each with its two sentences, of which the
    first is not always the true one: [(fact, [(index into STATED, sentence), …])]."""
    rng = stream(plan.seed, "beliefs", number)
    found = []
    for j in rng.permutation(len(plan.facts)).tolist():
        fact = plan.facts[j]
        pair = [(0, fact.message), (1, fact.belief)]
        found.append((j, pair if rng.random() < 0.5 else pair[::-1]))
    return found


def _clip(plan: CollectPlan, clip: Clip) -> dict[str, Any]:
    told = [plan.facts[j].message for j in indices(clip.told)]
    if clip.purpose == ATTENTION:
        return {"told": told, "steps": [plan.attention], "transitions": (), "situation": ()}
    steps = clip.transitions
    return {
        "told": told,
        "steps": [f"{plan.subject} {plan.hypotheses.phrases[t]}".strip() for t in steps],
        "transitions": steps,
        "situation": plan.situations[steps[0]] if plan.situations else (),
        "pictures": [t for t in steps if plan.pictures and plan.pictures[t] is not None],
    }


def _count(plan: CollectPlan) -> int:
    return questions_of(plan) + plan.rules.repeats + int(plan.rules.attention)
