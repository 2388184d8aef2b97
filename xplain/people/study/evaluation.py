"""The evaluation: the robot's steps with the policy's messages, and the policy's questions before a
step.

The explanation is the :class:`~xplain.interaction.dialogue.Dialogue` of the offline experiments,
restored for each page.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from xplain.explanation.actions import AskQuestion, VisibleState
from xplain.explanation.asking import bitmask
from xplain.explanation.belief import BeliefUpdate
from xplain.explanation.message_sets import indices
from xplain.interaction.dialogue import (
    Dialogue,
    DialogueState,
    QuestionAnswered,
    StepLabelled,
)
from xplain.people import flow as core
from xplain.people.flow import CANNOT_TELL, Flow, Form, OneLabel, Stage, pick
from xplain.people.study.plan import StudyPlan, StudyRole
from xplain.solvers.base import CachedPolicy, messages_of

ENDS = ("declined", "screened_out", "ineligible", "withdrawn", "timed_out")
EVALUATING = ("evaluation", "asking")
"""Stages of the evaluation."""


@dataclass(frozen=True)
class AskedQuestion:
    """A question to the participant. The policy knows M user types.

    Attributes:
        step: index of the trace's step that follows the question, from 0.
        question: index of the question in the problem.
        told: number of messages given before the question.
        worth: the policy's value of the question minus the value of its best other action; None if
            unknown.
        before: [M] belief over user types before the answer.
        answer: 1 if the step made sense to the participant, 0 if not, or CANNOT_TELL; None before
            the answer.
        after: [M] belief over user types after the answer; empty before the answer.
    """

    step: int
    question: int
    told: int
    worth: float | None
    before: tuple[float, ...]
    answer: int | None = None
    after: tuple[float, ...] = ()


@dataclass(frozen=True)
class StudyState(core.State):
    """The state of a participant. The default values are the state before the first page.

    A *place* is one numbered opening in the study for a participant of one type and condition.

    Attributes:
        user_type, condition: type and condition of the participant; None before consent.
        orders: {"eligibility" or "quiz": the order in which its questions are shown}.
        attempts: number of eligibility tests taken.
        step: index k of the trace's step that is shown last, from 0.
        given: bitmask of all messages on the page, including new messages.
        new: bitmask of the messages given at step k.
        previous: bitmask of the messages on the page at step k − 1; None at the first step.
        known: True for each transition of the trace whose label is known since the last message.
        belief: belief over hidden states.
        labels: latest labels of the transitions 0 … k − 1.
        heard: indices of the given messages, in the order in which they were given; a repeated
            message occurs again.
        score: score of the quiz.
        asked: the policy's questions so far; a question without an answer is last.
        position: number of the participant's place, also after the place was given back; None if
            there never was a place.
        missed: number of attention checks after the quiz with a wrong answer.
        before: belief over user types when the policy chose the messages of step k.
        values: {message set: the policy's value of giving it} at that decision.
        after: belief over user types after the labels of the last step.
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
    known: tuple[bool, ...] = ()
    belief: tuple[float, ...] = ()
    labels: tuple[int, ...] = ()
    score: int | None = None
    heard: tuple[int, ...] = ()
    asked: tuple[AskedQuestion, ...] = ()
    position: int | None = None
    missed: int = 0
    before: tuple[float, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    after: tuple[float, ...] = ()

    @property
    def slot_type(self) -> int:
        """The user type, for stages after consent."""
        assert self.user_type is not None, f"no slot at {self.stage}"
        return self.user_type

    @property
    def place(self) -> int | None:
        """The number of the place that the participant holds or has used up. None if the place
        is free again, for example because the participant is excluded from the analysis."""
        used = self.stage == "done" and not self.missed
        return self.position if used or not self.over else None

    @property
    def again(self) -> int:
        """Number of times that a message was given again."""
        return len(self.heard) - self.given.bit_count()


@dataclass(frozen=True)
class ExplanationFlow(Flow[StudyPlan, StudyState]):
    """A flow that explains a trace.

    Attributes:
        policies: {condition: policy for the problem of that condition}.
        belief: the belief update; it also decides which labels count as evidence.
    """

    policies: Mapping[str, CachedPolicy]
    belief: BeliefUpdate

    def role(self, state: StudyState) -> StudyRole:
        """Returns the participant's role, for stages after consent."""
        return self.plan.roles[state.slot_type]

    def talk(self, state: StudyState) -> Dialogue:
        """Returns the dialogue as it was when this page of the evaluation was shown."""
        condition = state.condition or ""
        talk = Dialogue(self.plan.problem_of(condition), self.policies[condition], self.belief)
        if state.belief:
            asked = bitmask(one.question for one in state.asked)
            visible = VisibleState(state.step, state.given, asked)
            belief, known = np.array(state.belief), np.array(state.known, np.bool_)
            talk.state = DialogueState(visible, belief, known)
        return talk

    def next_step(self, state: StudyState) -> StudyState:
        """Returns the state at the policy's question, if the policy asks before the next step;
        otherwise the state at the next step, with the policy's messages."""
        talk = self.talk(state)
        belief = self.of_types(talk)
        action, values = talk.decide(), talk.values()
        said = {
            messages_of(one): float(value)
            for one, value in values.items()
            if not isinstance(one, AskQuestion)
        }
        if isinstance(action, AskQuestion):
            best = max(said.values(), default=0.0)
            worth = float(values[action]) - best if action in values else None
            one = AskedQuestion(state.step, action.question, len(state.heard), worth, belief)
            return state.to(stage="asking", asked=(*state.asked, one), **keep(talk))
        new = messages_of(action)
        talk.hear(action)
        shown = {str(int(mask)): value for mask, value in said.items()}
        return state.to(
            stage="evaluation",
            given=talk.state.visible.given,
            new=new,
            heard=(*state.heard, *indices(new)),
            before=belief,
            **keep(talk),
            values=shown,
        )

    def of_types(self, talk: Dialogue) -> tuple[float, ...]:
        """Returns the belief over user types, for the log: the belief over hidden states, summed
        over habits and knowledge."""
        return tuple(self.plan.problem.type_belief(talk.state.belief).tolist())

    def collect_content(self, state: StudyState) -> dict[str, Any]:
        """Collects the content that every page of the evaluation has: the briefing, the old
        messages and the new messages. A message that was given twice appears once, at its last
        position; ``again`` lists new messages that were also given before."""
        messages = [fact.message for fact in self.plan.facts]
        last = [*dict.fromkeys(reversed(state.heard))][::-1]
        old = [messages[j] for j in last if not state.new >> j & 1]
        new = [messages[j] for j in last if state.new >> j & 1]
        again = [messages[j] for j in last if state.new >> j & 1 and state.heard.count(j) > 1]
        return {
            "briefing": self.role(state).briefing,
            "old": old,
            "new": new,
            "again": again,
        }


def keep(talk: Dialogue) -> dict[str, Any]:
    """Returns the fields of the state from which :meth:`ExplanationFlow.talk` restores a dialogue,
    except those that pages show."""
    belief, known = talk.state.belief, talk.state.known
    return {"belief": tuple(belief.tolist()), "known": tuple(known.tolist())}


class Evaluation(Stage["ExplanationFlow", StudyState]):
    """The robot's steps, one after the other, with the policy's messages."""

    def enter(self, flow: ExplanationFlow, state: StudyState) -> StudyState:
        """Returns the state of the first page: the policy's first decision from the initial
        belief."""
        return flow.next_step(replace(state, wrong=False))

    def view(self, flow: ExplanationFlow, state: StudyState) -> dict[str, Any]:
        """Shows the steps so far, the labels, the old messages and the new messages."""
        plan = flow.plan
        return flow.collect_content(state) | {
            "step": state.step,
            "trace": plan.trace[: state.step + 1],
            "n_steps": plan.n_steps,
            "labels": state.labels,
        }

    def read(self, flow: ExplanationFlow, state: StudyState, form: Form) -> dict[str, Any]:
        """Reads the labels; an earlier label that is not sent again keeps its value."""
        kept = [*map(str, state.labels[: state.step]), ""]
        sent = [form.get(f"label_{i}", old) for i, old in enumerate(kept)]
        missing = flow.words["label_missing"]
        return {"labels": [pick(label, CANNOT_TELL + 1, missing) for label in sent]}

    def advance(
        self, flow: ExplanationFlow, state: StudyState, payload: Mapping[str, Any]
    ) -> StudyState:
        """Moves to the next step, or to the next stage after the last step."""
        talk, chosen = flow.talk(state), tuple(payload["labels"])
        talk.hear(StepLabelled(chosen))
        state = replace(
            state,
            labels=chosen,
            after=flow.of_types(talk),
            previous=state.given,
            new=0,
            **keep(talk),
        )
        if state.step + 1 == flow.plan.n_steps:
            return flow.after(state)
        return flow.next_step(replace(state, step=state.step + 1))


class ClipQuestion(OneLabel["ExplanationFlow", StudyState]):
    """A question: does one step of the task, on the trace or not, make sense?"""

    def view(self, flow: ExplanationFlow, state: StudyState) -> dict[str, Any]:
        """Shows the transition that is asked about, and the messages given so far."""
        question = state.asked[-1].question
        return flow.collect_content(state) | {
            "clip": flow.plan.clips[question],
            "transitions": (question,),
            "first_picture": flow.plan.n_steps,
        }

    def advance(
        self, flow: ExplanationFlow, state: StudyState, payload: Mapping[str, Any]
    ) -> StudyState:
        """Moves to another question, or to the next step. The answer "I cannot tell" is no
        evidence."""
        label, talk = payload["label"], flow.talk(state)
        if label != CANNOT_TELL:
            talk.hear(AskQuestion(state.asked[-1].question), QuestionAnswered(label))
        answered = replace(state.asked[-1], answer=label, after=flow.of_types(talk))
        return flow.next_step(replace(state, asked=(*state.asked[:-1], answered), **keep(talk)))
