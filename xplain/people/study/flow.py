"""The flow of the study:

    consent → before → briefing → training → ahead → eligibility → evaluation → quiz → questions
                           ↑__________________________|  (a failed attempt, while some are left)

People who come as they are have no eligibility test, for they are told nothing to be tested on.
Within the evaluation, a policy that asks opens pages of the stage ``asking`` before a step.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from xplain.errors import Refused
from xplain.people.flow import (
    Briefing,
    Consent,
    Form,
    LookingAhead,
    Practice,
    QuestionStage,
    Stage,
    choice,
    choices,
    small,
)
from xplain.people.study.evaluation import ENDS, Asking, Evaluation, Explaining, StudyState
from xplain.people.study.plan import StudyPlan

__all__ = ["ENDS", "Study", "StudyState"]
_WIDTH = re.compile(r"[1-9][0-9]{1,4}\Z")


class StudyConsent(Consent["Study", StudyState]):
    """With the width of the window."""

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """Without scripts the width is None."""
        width = (form.getlist("width") or [""])[-1]
        return super().read(flow, state, form) | {
            "width": int(width) if _WIDTH.match(width) else None
        }


class StudyBriefing(Briefing["Study", StudyState]):
    """What everybody is told, and what this user type knows."""

    def facts(self, flow: Study, state: StudyState) -> Mapping[str, Sequence[str]]:
        """No more than the role has; people as they are have no briefing."""
        known = [known.right for known in flow.plan.known]
        return {"told_to_all": known, "told_to_you": flow.role(state).briefing}

    def screens(self, flow: Study, state: StudyState) -> list[tuple[str, tuple[str, ...]]]:
        """After a failed attempt the facts alone."""
        every = super().screens(flow, state)
        return every[1:-1] if state.attempts else every

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """With the attempts that are left."""
        left = flow.plan.rules.max_attempts - state.attempts
        return super().view(flow, state) | {"attempts_left": left}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """After a failed attempt to the test: the practice is not repeated."""
        after = super().advance(flow, state, payload)
        again = state.attempts and after.stage != self.name
        return replace(after, stage="eligibility") if again else after


class TrainingStage(Practice["Study", StudyState]):
    """An added action, unexpected without its message."""

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """The message only in the second half."""
        example = flow.plan.training
        told = [example.message] if state.part else []
        slots = len(flow.plan.facts)
        return {"training": example, "part": state.part, "slots": slots, "told": told}


class Eligibility(Stage["Study", StudyState]):
    """Whether they know what they were told."""

    def wanted(self, plan: StudyPlan) -> bool:
        """Nobody who is not briefed can be checked."""
        return not plan.kinds

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """The questions in the participant's order."""
        questions = flow.role(state).eligibility
        return {
            "questions": [(i, questions[i]) for i in (state.orders or {})["eligibility"]],
            "fields": {f"q{i}": list(enumerate(q.options)) for i, q in enumerate(questions)},
        }

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """The answers in the plan's order."""
        count = len(flow.role(state).eligibility)
        return {"answers": [small(form.get(f"q{i}")) for i in range(count)]}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """On with all of them right; else back to the briefing, or to the end."""
        questions = flow.role(state).eligibility
        counts = [len(question.options) for question in questions]
        chosen = choices(payload.get("answers"), counts, flow.words["answer_all"])
        attempts = state.attempts + 1
        if chosen == tuple(question.answer for question in questions):
            return flow.after(state, attempts=attempts)
        if attempts >= flow.plan.rules.max_attempts:
            return state.to(stage="ineligible", attempts=attempts)
        return state.to(stage="briefing", attempts=attempts, wrong=True)


class Quiz(Stage["Study", StudyState]):
    """Which statements are true of the robot; no way back to the briefing."""

    def view(self, flow: Study, state: StudyState) -> dict[str, Any]:
        """The statements in the participant's order."""
        statements = flow.role(state).quiz
        shown = [(i, statements[i].text) for i in (state.orders or {})["quiz"]]
        return {"statements": shown, "fields": {"true": shown}}

    def read(self, flow: Study, state: StudyState, form: Form) -> dict[str, Any]:
        """Those that are ticked."""
        return {"chosen": [small(text) for text in form.getlist("true")[:100]]}

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """A point for each statement judged rightly."""
        statements, chosen = flow.role(state).quiz, payload.get("chosen")
        missing = flow.words["quiz_missing"]
        if not isinstance(chosen, list) or len(chosen) > len(statements):
            raise Refused(missing)
        ticked = {choice(c, len(statements), missing) for c in chosen}
        score = sum(statement.true == (i in ticked) for i, statement in enumerate(statements))
        return flow.after(state, score=score)


class LastQuestions(QuestionStage["Study", StudyState]):
    """The lab's questions after the quiz, with checks of attention among them."""

    def advance(self, flow: Study, state: StudyState, payload: Mapping[str, Any]) -> StudyState:
        """Counts the checks that were missed: these people are left out of the analysis."""
        wrong = [q for q in flow.plan.asked if q.right and payload.get(q.name) != q.right]
        return replace(super().advance(flow, state, payload), missed=len(wrong))


@dataclass(frozen=True)
class Study(Explaining):
    """A plan with its policies at work."""

    STATE: ClassVar = StudyState
    STAGES: ClassVar = (
        StudyConsent("consent", "consent"),
        QuestionStage("before", "screening", "before", "screened_out"),
        StudyBriefing("briefing", "read"),
        TrainingStage("training", "example"),
        LookingAhead("ahead", "ahead"),
        Eligibility("eligibility", "eligibility"),
        Evaluation("evaluation", "labels"),
        Asking("asking", "clip"),
        Quiz("quiz", "quiz"),
        LastQuestions("questions", "answers"),
    )

    def view(self, state: StudyState) -> dict[str, Any]:
        """At an end for good also which of the sentences that they were told are not true."""
        view = super().view(state)
        if not state.over or state.stage == "timed_out" or state.user_type is None:
            return view
        role, facts = self.role(state), self.plan.facts
        untrue = role.wrong if role.briefing else ()
        return view | {"untrue": [(role.briefing[j], facts[j].message) for j in untrue]}

    def advance(self, state: StudyState, kind: str, payload: Mapping[str, Any]) -> StudyState:
        """Who returns has the place that was free."""
        after = super().advance(state, kind, payload)
        return replace(after, **payload) if kind == "return" else after

    def admitted(self, payload: Mapping[str, Any]) -> dict[str, Any]:
        """The place and the orders of questions, where the window is wide enough."""
        width, least = payload.get("width"), self.plan.rules.min_width
        if least and (not isinstance(width, int) or width < least):
            raise Refused(self.words["too_narrow"].format(width=least))
        orders = {name: tuple(order) for name, order in payload["orders"].items()}
        place = {key: payload[key] for key in ("position", "user_type", "condition")}
        return place | {"orders": orders}
