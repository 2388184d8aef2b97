"""The flow of the study:

    consent → before → briefing → training → ahead → eligibility → evaluation → quiz → questions
                           ↑__________________________|  (a failed attempt, while some are left)

People who come as they are have no eligibility test, for they are told nothing to be tested on.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from xplain.errors import Refused
from xplain.explanation import belief as beliefs
from xplain.explanation.belief import BeliefUpdate
from xplain.message_sets import indices
from xplain.people import flow as core
from xplain.people import stages
from xplain.people.flow import Answer, Decision, Fields, Flow, Form, Stage
from xplain.people.stages import LookingAhead, Questions, choice, choices, small
from xplain.people.study.plan import Role, StudyPlan
from xplain.solvers.base import Policy

ENDS = ("declined", "screened_out", "ineligible", "withdrawn", "timed_out")
_WIDTH = re.compile(r"[1-9][0-9]{1,4}\Z")


@dataclass(frozen=True)
class State(core.State):
    """Where a participant is. The first value is the start.

    Attributes:
        user_type, condition: the slot; None before consent.
        orders: {"eligibility" | "quiz": the order in which questions are shown}.
        attempts: eligibility tests taken.
        step: k of the evaluation.
        given: bitmask of the messages on the page, the new ones among them.
        new: bitmask of the messages that are said at this step.
        previous: bitmask of the messages at the step before; None at the first.
        belief: over what is hidden.
        labels: of the transitions 0 … k − 1, as answered last.
        heard: the messages said, by number, in the order of their arrival; again where said again.
        score: of the quiz.
    """

    ENDS = ENDS

    user_type: int | None = None
    condition: str | None = None
    orders: Mapping[str, tuple[int, ...]] | None = None
    attempts: int = 0
    step: int = 0
    given: int = 0
    new: int = 0
    previous: int | None = None
    belief: tuple[float, ...] = ()
    labels: tuple[int, ...] = ()
    score: int | None = None
    heard: tuple[int, ...] = ()

    @property
    def slot_type(self) -> int:
        """The user type, in the stages after consent: each of them has a slot."""
        assert self.user_type is not None, f"no slot at {self.stage}"
        return self.user_type

    @property
    def again(self) -> int:
        """How often a message was said that had been said before."""
        return len(self.heard) - self.given.bit_count()


Outcome = core.Outcome[State]


class Consent(stages.Consent["Study", State]):
    """With the width of the window."""

    def read(self, flow: Study, state: State, form: Form) -> dict[str, Any]:
        """Without scripts the width is None."""
        width = (form.getlist("width") or [""])[-1]
        return super().read(flow, state, form) | {
            "width": int(width) if _WIDTH.match(width) else None
        }

    def fields(self, payload: Mapping[str, Any]) -> Fields:
        """With the width."""
        return [*super().fields(payload), ("width", str(payload["width"] or ""))]


class Briefing(Stage["Study", State]):
    """What this user type knows."""

    def view(self, flow: Study, state: State) -> dict[str, Any]:
        """The sentences of the type, and what everybody is told."""
        return {
            "briefing": flow.role(state).briefing,
            "known": [known.right for known in flow.plan.known],
            "attempts_left": flow.plan.rules.max_attempts - state.attempts,
        }

    def advance(self, flow: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
        """After a failed attempt the example is known; only the facts need another look."""
        if state.attempts:
            return state.to(stage="eligibility", wrong=False)
        return flow.after(state, wrong=False)


class Training(stages.Practice["Study", State]):
    """An added action, unexpected without its message."""

    def view(self, flow: Study, state: State) -> dict[str, Any]:
        """The message only in the second half."""
        example = flow.plan.training
        told = [example.message] if state.part else []
        slots = len(flow.plan.facts)
        return {"training": example, "part": state.part, "slots": slots, "told": told}


class Eligibility(Stage["Study", State]):
    """Whether they know what they were told."""

    def wanted(self, plan: StudyPlan) -> bool:
        """Nobody who is not briefed can be checked."""
        return not plan.kinds

    def view(self, flow: Study, state: State) -> dict[str, Any]:
        """The questions in the participant's order."""
        questions = flow.role(state).eligibility
        return {
            "questions": [(i, questions[i]) for i in (state.orders or {})["eligibility"]],
            "fields": {f"q{i}": list(enumerate(q.options)) for i, q in enumerate(questions)},
        }

    def read(self, flow: Study, state: State, form: Form) -> dict[str, Any]:
        """The answers in the plan's order."""
        count = len(flow.role(state).eligibility)
        return {"answers": [small(form.get(f"q{i}")) for i in range(count)]}

    def fields(self, payload: Mapping[str, Any]) -> Fields:
        """The answers."""
        return [(f"q{i}", str(answer)) for i, answer in enumerate(payload["answers"])]

    def advance(self, flow: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
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


class Evaluation(Stage["Study", State]):
    """The robot's steps, one after the other, with the policy's messages."""

    def enter(self, flow: Study, state: State) -> Outcome:
        """The first step."""
        belief = tuple(flow.plan.problem.start.tolist())
        return self._decide(flow, replace(state, wrong=False, belief=belief), None)

    def view(self, flow: Study, state: State) -> dict[str, Any]:
        """The steps so far, the labels, the old messages and the new ones, each where it was said
        last; ``again`` are those of the new ones that had been said before."""
        plan, messages = flow.plan, [fact.message for fact in flow.plan.facts]
        last = [*dict.fromkeys(reversed(state.heard))][::-1]
        old = [messages[j] for j in last if not state.new >> j & 1]
        new = [messages[j] for j in last if state.new >> j & 1]
        again = [messages[j] for j in last if state.new >> j & 1 and state.heard.count(j) > 1]
        return {
            "briefing": flow.role(state).briefing,
            "step": state.step,
            "trace": plan.trace[: state.step + 1],
            "n_steps": plan.n_steps,
            "labels": state.labels,
            "slots": len(plan.facts),
            "recall": plan.rules.recall,
            "old": old,
            "new": new,
            "again": again,
            "told": old + new,
            "fields": {f"label_{i}": [] for i in range(state.step + 1)},
        }

    def read(self, flow: Study, state: State, form: Form) -> dict[str, Any]:
        """An earlier label that is not sent again stays as it was."""
        kept = [*state.labels[: state.step], None]
        sent = [small(form.get(f"label_{i}")) for i in range(state.step + 1)]
        pairs = zip(sent, kept, strict=True)
        return {"labels": [old if label is None else label for label, old in pairs]}

    def fields(self, payload: Mapping[str, Any]) -> Fields:
        """All labels."""
        return [(f"label_{i}", str(label)) for i, label in enumerate(payload["labels"])]

    def advance(self, flow: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
        """To the next step, or on from the last one."""
        count = [2] * (state.step + 1)
        chosen = choices(payload.get("labels"), count, flow.words["label_missing"])
        problem, before = flow.plan.problem, np.array(state.belief)
        # Who was told something, or may have forgotten something, is asked something new.
        previous = None if state.new or problem.habits.forget.any() else state.previous
        evidence = flow.belief.evidence(state.given, previous, len(chosen))
        labels = np.array(chosen, dtype=np.uint8)
        after = beliefs.update(problem, before, state.given, labels, evidence)
        belief = tuple(after.tolist())
        answer = Answer(state.step, chosen, self._of_types(flow, belief))
        state = replace(state, labels=chosen, belief=belief, previous=state.given)
        if state.step + 1 == flow.plan.n_steps:
            return replace(flow.after(state, new=0), answer=answer)
        return self._decide(flow, replace(state, step=state.step + 1), answer)

    def _of_types(self, flow: Study, belief: Sequence[float]) -> tuple[float, ...]:
        """What is logged: over user types, whatever habits and knowledge go with them."""
        return tuple(flow.plan.problem.type_belief(np.array(belief)).tolist())

    def _decide(self, flow: Study, state: State, answer: Answer | None) -> Outcome:
        """The policy's messages at the state's step."""
        policy, belief = flow.policies[state.condition or ""], np.array(state.belief)
        new = int(policy.messages(state.step, state.given, belief))
        values = policy.values(state.step, state.given, belief)
        shown = {str(int(mask)): float(value) for mask, value in values.items()}
        decision = Decision(state.step, self._of_types(flow, state.belief), state.given, new, shown)
        outcome = state.to(
            stage=self.name,
            given=state.given | new,
            new=new,
            heard=(*state.heard, *indices(new)),
            belief=tuple(beliefs.told(flow.plan.problem, belief, new).tolist()),
        )
        return replace(outcome, decision=decision, answer=answer)


class Quiz(Stage["Study", State]):
    """Which statements are true of the robot; no way back to the briefing."""

    def view(self, flow: Study, state: State) -> dict[str, Any]:
        """The statements in the participant's order."""
        statements = flow.role(state).quiz
        shown = [(i, statements[i].text) for i in (state.orders or {})["quiz"]]
        return {"statements": shown, "fields": {"true": shown}}

    def read(self, flow: Study, state: State, form: Form) -> dict[str, Any]:
        """Those that are ticked."""
        return {"chosen": [small(text) for text in form.getlist("true")[:100]]}

    def fields(self, payload: Mapping[str, Any]) -> Fields:
        """Those that are ticked."""
        return [("true", str(one)) for one in payload["chosen"]]

    def advance(self, flow: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
        """A point for each statement judged rightly."""
        statements, chosen = flow.role(state).quiz, payload.get("chosen")
        missing = flow.words["quiz_missing"]
        if not isinstance(chosen, list) or len(chosen) > len(statements):
            raise Refused(missing)
        ticked = {choice(c, len(statements), missing) for c in chosen}
        score = sum(statement.true == (i in ticked) for i, statement in enumerate(statements))
        return flow.after(state, score=score)


@dataclass(frozen=True)
class Study(Flow[StudyPlan, State]):
    """A plan with its policies at work.

    Attributes:
        policies: {condition: policy for ``plan.problem``}.
        belief: which labels are evidence.
    """

    STATE: ClassVar = State
    STAGES: ClassVar = (
        Consent("consent", "consent"),
        Questions("before", "screening", "before", "screened_out"),
        Briefing("briefing", "read"),
        Training("training", "example", "label_missing"),
        LookingAhead("ahead", "ahead", "label_missing"),
        Eligibility("eligibility", "eligibility"),
        Evaluation("evaluation", "labels"),
        Quiz("quiz", "quiz"),
        Questions("questions", "answers"),
    )

    policies: Mapping[str, Policy]
    belief: BeliefUpdate

    def view(self, state: State) -> dict[str, Any]:
        """At an end for good also which of the sentences that they were told are not true."""
        view = super().view(state)
        if not state.over or state.stage == "timed_out" or state.user_type is None:
            return view
        role, facts = self.role(state), self.plan.facts
        untrue = role.wrong if role.briefing else ()
        return view | {"untrue": [(role.briefing[j], facts[j].message) for j in untrue]}

    def role(self, state: State) -> Role:
        """What the participant is told and asked, in the stages after consent."""
        return self.plan.roles[state.slot_type]

    def admitted(self, payload: Mapping[str, Any]) -> dict[str, Any]:
        """The slot and the orders of questions, where the window is wide enough."""
        width, least = payload.get("width"), self.plan.rules.min_width
        if least and (not isinstance(width, int) or width < least):
            raise Refused(self.words["too_narrow"].format(width=least))
        orders = {name: tuple(order) for name, order in payload["orders"].items()}
        slot = {key: payload[key] for key in ("user_type", "condition")}
        return slot | {"orders": orders}
