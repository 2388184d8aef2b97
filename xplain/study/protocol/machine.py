"""The protocol of the study, from consent to the completion code: a pure state machine.

``advance(study, state, kind, payload)`` is the whole of it. No clock, no storage, no web; chance
is passed in (the slot and the orders of questions come with the consent event). The same events
give the same states, which is what the replay checks.

    consent → before → briefing → training → eligibility → evaluation → quiz → questions → done
                           ↑__________________|  (a failed attempt, while some are left)

People who come as they are have no eligibility test, for they are told nothing to be tested on;

and from anywhere to an end: declined, screened_out, ineligible, withdrawn, timed_out. From the
last of these a participant may return to where they were.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from xplain.errors import Refused as Refused
from xplain.explanation import belief as beliefs
from xplain.message_sets import indices
from xplain.participants.protocol import state as core
from xplain.participants.protocol.answers import check, choice, choices, consents
from xplain.participants.protocol.state import Answer, at_any_stage
from xplain.study.protocol.plan import Study

STAGES = (
    "consent",
    "before",
    "briefing",
    "training",
    "eligibility",
    "evaluation",
    "quiz",
    "questions",
    "done",
)
ENDS = ("declined", "screened_out", "ineligible", "withdrawn", "timed_out")
KINDS = {
    "consent": "consent",
    "before": "screening",
    "briefing": "read",
    "training": "example",
    "eligibility": "eligibility",
    "evaluation": "labels",
    "quiz": "quiz",
    "questions": "answers",
    "timed_out": "return",
}
"""The kind of event that each stage waits for; ``withdraw`` and ``time_out`` are always heard."""


@dataclass(frozen=True)
class State(core.State):
    """Where a participant is. The first value is the start.

    Attributes:
        stage: one of STAGES or ENDS.
        user_type, condition: the slot; None before consent.
        orders: {"eligibility" | "quiz": the order in which questions are shown}.
        attempts: eligibility tests taken.
        step: k of the evaluation.
        given: bitmask of the messages on the page, the new ones among them.
        new: bitmask of the messages that are new at this step.
        previous: bitmask of the messages at the step before; None at the first.
        belief: [N].
        labels: of the transitions 0 … k − 1, as answered last.
        heard: the messages given, by number, in the order of their arrival.
        score: of the quiz.
    """

    ENDS = ENDS
    KINDS = KINDS

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


Outcome = core.Outcome[State]


@dataclass(frozen=True)
class Decision:
    """What the policy did at a step: the messages, and the values behind them."""

    step: int
    belief: tuple[float, ...]
    given: int
    messages: int
    values: Mapping[int, float]

    @property
    def columns(self) -> dict[str, str | int | None]:
        """Of the step table, by name; what the answer will fill in is None."""
        return {
            "belief_before": json.dumps(self.belief),
            "given": self.given,
            "messages": self.messages,
            "action_values": json.dumps({str(mask): v for mask, v in self.values.items()}),
            "labels": None,
            "belief_after": None,
        }


def advance(study: Study, state: State, kind: str, payload: Mapping[str, Any]) -> Outcome:
    """The state after an event.

    Args:
        study: the plan and its policies.
        state: before.
        kind: of the event.
        payload: what came with it.

    Raises:
        Refused: the event does not fit the stage, or its payload is not what the stage asks for.
    """
    outcome = at_any_stage(state, kind, study.plan.texts.words)
    return outcome or _STEPS[state.stage](study, state, payload)


def _consent(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    words, least = study.plan.texts.words, study.plan.rules.min_width
    if not consents(study.plan.texts, payload):
        return state.to(stage="declined")
    width = payload.get("width")
    if least and (not isinstance(width, int) or width < least):
        raise Refused(words["too_narrow"].format(width=least))
    orders = {name: tuple(order) for name, order in payload["orders"].items()}
    return state.to(
        stage="before" if study.plan.before else "briefing",
        user_type=payload["user_type"],
        condition=payload["condition"],
        orders=orders,
    )


def _before(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    check(study.plan.before, payload, study.plan.texts.words)
    missed = any(q.right and payload.get(q.name) != q.right for q in study.plan.before)
    return state.to(stage="screened_out" if missed else "briefing")


def _briefing(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    # After a failed attempt the example is known; only the facts need another look.
    return state.to(stage="eligibility" if state.attempts else "training", wrong=False)


def _training(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    label = choice(payload.get("label"), 2, study.plan.texts.words["label_missing"])
    right = label == state.part  # unexpected without the message, expected with it
    if not right:
        return state.to(wrong=True)
    if state.part == 0:
        return state.to(part=1, wrong=False)
    if study.plan.kinds:  # nobody was told anything that could be checked
        return _begin(study, state)
    return state.to(stage="eligibility", wrong=False)


def _eligibility(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    questions = study.plan.roles[state.slot_type].eligibility
    missing = study.plan.texts.words["answer_all"]
    chosen = choices(
        payload.get("answers"), [len(question.options) for question in questions], missing
    )
    attempts = state.attempts + 1
    if all(c == question.answer for c, question in zip(chosen, questions, strict=True)):
        return _begin(study, replace(state, attempts=attempts))
    if attempts >= study.plan.rules.max_attempts:
        return state.to(stage="ineligible", attempts=attempts)
    return state.to(stage="briefing", attempts=attempts, wrong=True)


def _begin(study: Study, state: State) -> Outcome:
    """The first step of the evaluation."""
    belief = tuple(study.plan.problem.prior.tolist())
    return _decide(study, replace(state, wrong=False, belief=belief), None)


def _evaluation(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    missing = study.plan.texts.words["label_missing"]
    chosen = choices(payload.get("labels"), [2] * (state.step + 1), missing)
    problem = study.plan.problem
    evidence = study.belief.evidence(state.given, state.previous, len(chosen))
    after = beliefs.update(
        problem,
        np.array(state.belief),
        state.given,
        np.array(chosen, dtype=np.uint8),
        evidence,
    )
    belief = tuple(after.tolist())
    answer = Answer(state.step, chosen, belief)
    labelled = replace(state, labels=chosen, belief=belief, previous=state.given)
    if state.step + 1 == study.plan.n_steps:
        return replace(labelled.to(stage="quiz", new=0), answer=answer)
    return _decide(study, replace(labelled, step=state.step + 1), answer)


def _decide(study: Study, state: State, answer: Answer | None) -> Outcome:
    """The policy's messages at the state's step."""
    policy = study.policies[state.condition or ""]
    belief = np.array(state.belief)
    new = int(policy.messages(state.step, state.given, belief))
    values = {
        int(mask): float(value)
        for mask, value in policy.values(state.step, state.given, belief).items()
    }
    decision = Decision(state.step, state.belief, state.given, new, values)
    heard = (*state.heard, *indices(new & ~state.given))
    outcome = state.to(stage="evaluation", given=state.given | new, new=new, heard=heard)
    return replace(outcome, decision=decision, answer=answer)


def _quiz(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    statements = study.plan.roles[state.slot_type].quiz
    missing = study.plan.texts.words["quiz_missing"]
    chosen = payload.get("chosen")
    if not isinstance(chosen, list) or len(chosen) > len(statements):
        raise Refused(missing)
    ticked = {choice(c, len(statements), missing) for c in chosen}
    score = sum(statement.true == (i in ticked) for i, statement in enumerate(statements))
    return state.to(stage="questions" if study.plan.asked else "done", score=score)


def _questions(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    check(study.plan.asked, payload, study.plan.texts.words)
    return state.to(stage="done")


_STEPS = {
    "consent": _consent,
    "before": _before,
    "briefing": _briefing,
    "training": _training,
    "eligibility": _eligibility,
    "evaluation": _evaluation,
    "quiz": _quiz,
    "questions": _questions,
}
