"""What a participant sees at each stage, in plain values for whatever draws it."""

from __future__ import annotations

from typing import Any

from xplain.study.protocol.machine import State
from xplain.study.protocol.plan import Study


def page(study: Study, state: State) -> dict[str, Any]:
    """What the participant sees now, in plain values: sentences, questions in their order.

    Nothing of the type, the condition, the belief or the right answers is in it.
    """
    plan = study.plan
    view: dict[str, Any] = {"stage": state.stage, "sequence": state.accepted, "wrong": state.wrong}
    if state.stage in ("briefing", "evaluation"):
        view["briefing"] = plan.roles[state.slot_type].briefing
    if state.stage == "briefing":
        view["known"] = [known.right for known in plan.known]
        view["attempts_left"] = plan.rules.max_attempts - state.attempts
    elif state.stage == "training":
        view |= {"training": plan.training, "part": state.part, "slots": len(plan.facts)}
    elif state.stage == "eligibility":
        questions = plan.roles[state.slot_type].eligibility
        view["questions"] = [(i, questions[i]) for i in (state.orders or {})["eligibility"]]
    elif state.stage == "evaluation":
        view |= {
            "step": state.step,
            "trace": plan.trace[: state.step + 1],
            "labels": state.labels,
            "slots": len(plan.facts),
            "old": [plan.facts[j].message for j in state.heard if not state.new >> j & 1],
            "new": [plan.facts[j].message for j in state.heard if state.new >> j & 1],
        }
    elif state.stage == "quiz":
        statements = plan.roles[state.slot_type].quiz
        view["statements"] = [(i, statements[i].text) for i in (state.orders or {})["quiz"]]
    elif state.stage in ("before", "questions"):
        view["asked"] = plan.before if state.stage == "before" else plan.asked
    return view
