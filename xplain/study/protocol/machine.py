"""The protocol of the study, from consent to the completion code: a pure state machine.

``advance(study, state, kind, payload)`` is the whole of it. No clock, no storage, no web; chance
is passed in (the slot and the orders of questions come with the consent event). The same events
give the same states, which is what the replay checks.

    consent → before → briefing → training → eligibility → evaluation → quiz → questions → done
                           ↑__________________|  (a failed attempt, while some are left)

and from anywhere to an end: declined, screened_out, ineligible, withdrawn, timed_out. From the
last of these a participant may return to where they were.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from xplain.errors import Refused as Refused
from xplain.explanation import belief as beliefs
from xplain.message_sets import indices
from xplain.study.protocol.plan import Asked, Study

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
class State:
    """Where a participant is. The first value is the start.

    Attributes:
        stage: one of STAGES or ENDS.
        accepted: events accepted so far, which is the sequence number of the next one.
        user_type, condition: the slot; None before consent.
        orders: {"eligibility" | "quiz": the order in which questions are shown}.
        part: which half of the training example.
        wrong: whether the last answer of the training or the eligibility test was wrong.
        attempts: eligibility tests taken.
        step: k of the evaluation.
        given: bitmask of the messages on the page, the new ones among them.
        new: bitmask of the messages that are new at this step.
        previous: bitmask of the messages at the step before; None at the first.
        belief: [N].
        labels: of the transitions 0 … k − 1, as answered last.
        heard: the messages given, by number, in the order of their arrival.
        left: the stage at which somebody was timed out.
        score: of the quiz.
    """

    stage: str = "consent"
    accepted: int = 0
    user_type: int | None = None
    condition: str | None = None
    orders: Mapping[str, tuple[int, ...]] | None = None
    part: int = 0
    wrong: bool = False
    attempts: int = 0
    step: int = 0
    given: int = 0
    new: int = 0
    previous: int | None = None
    belief: tuple[float, ...] = ()
    labels: tuple[int, ...] = ()
    score: int | None = None
    heard: tuple[int, ...] = ()
    left: str | None = None

    @property
    def slot_type(self) -> int:
        """The user type, in the stages after consent: each of them has a slot."""
        assert self.user_type is not None, f"no slot at {self.stage}"
        return self.user_type

    @property
    def over(self) -> bool:
        """Whether nothing more can happen."""
        return self.stage == "done" or self.stage in ENDS

    @property
    def text(self) -> str:
        """As JSON, for the store."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_text(cls, text: str) -> State:
        """The state that :attr:`text` was made from, equal to the last bit."""
        value = json.loads(text)
        orders = value["orders"]
        return cls(
            **value
            | {
                "belief": tuple(value["belief"]),
                "labels": tuple(value["labels"]),
                "heard": tuple(value["heard"]),
                "orders": orders and {key: tuple(order) for key, order in orders.items()},
            }
        )


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


@dataclass(frozen=True)
class Answer:
    """The labels of a step and the belief after them."""

    step: int
    labels: tuple[int, ...]
    belief: tuple[float, ...]

    @property
    def columns(self) -> dict[str, str]:
        """Of the step table, by name: those that :attr:`Decision.columns` leaves None."""
        return {"labels": json.dumps(self.labels), "belief_after": json.dumps(self.belief)}


@dataclass(frozen=True)
class Outcome:
    """A new state, with what belongs into the step table."""

    state: State
    decision: Decision | None = None
    answer: Answer | None = None


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
    words = study.plan.texts.words
    if state.stage == "timed_out" and kind == "return":
        return _to(state, stage=state.left, left=None)
    if state.over:
        raise Refused(words["ended"])
    if kind == "withdraw":
        return _to(state, stage="withdrawn")
    if kind == "time_out":
        return _to(state, stage="timed_out", left=state.stage)
    if kind != KINDS[state.stage]:
        raise Refused(words["other_page"])
    return _STEPS[state.stage](study, state, payload)


def _to(state: State, **changes: Any) -> Outcome:
    return Outcome(replace(state, accepted=state.accepted + 1, **changes))


def _consent(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    words, least = study.plan.texts.words, study.plan.rules.min_width
    agreed = _choice(payload.get("agree"), 2, words["consent_missing"])
    if payload.get("text") != study.plan.texts.consent_hash:
        raise Refused(words["consent_changed"])
    if not agreed:
        return _to(state, stage="declined")
    width = payload.get("width")
    if least and (not isinstance(width, int) or width < least):
        raise Refused(words["too_narrow"].format(width=least))
    orders = {name: tuple(order) for name, order in payload["orders"].items()}
    return _to(
        state,
        stage="before" if study.plan.before else "briefing",
        user_type=payload["user_type"],
        condition=payload["condition"],
        orders=orders,
    )


def _before(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    _check(study.plan.before, payload, study.plan.texts.words)
    missed = any(q.right and payload.get(q.name) != q.right for q in study.plan.before)
    return _to(state, stage="screened_out" if missed else "briefing")


def _briefing(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    # After a failed attempt the example is known; only the facts need another look.
    return _to(state, stage="eligibility" if state.attempts else "training", wrong=False)


def _training(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    label = _choice(payload.get("label"), 2, study.plan.texts.words["label_missing"])
    right = label == state.part  # unexpected without the message, expected with it
    if not right:
        return _to(state, wrong=True)
    if state.part == 0:
        return _to(state, part=1, wrong=False)
    return _to(state, stage="eligibility", wrong=False)


def _eligibility(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    questions = study.plan.roles[state.slot_type].eligibility
    answers = payload.get("answers")
    missing = study.plan.texts.words["answer_all"]
    if not isinstance(answers, list) or len(answers) != len(questions):
        raise Refused(missing)
    chosen = [
        _choice(answer, len(question.options), missing)
        for answer, question in zip(answers, questions, strict=True)
    ]
    attempts = state.attempts + 1
    if all(c == question.answer for c, question in zip(chosen, questions, strict=True)):
        belief = tuple(study.plan.problem.prior.tolist())
        return _decide(study, replace(state, attempts=attempts, wrong=False, belief=belief), None)
    if attempts >= study.plan.rules.max_attempts:
        return _to(state, stage="ineligible", attempts=attempts)
    return _to(state, stage="briefing", attempts=attempts, wrong=True)


def _evaluation(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    labels = payload.get("labels")
    missing = study.plan.texts.words["label_missing"]
    if not isinstance(labels, list) or len(labels) != state.step + 1:
        raise Refused(missing)
    chosen = tuple(_choice(label, 2, missing) for label in labels)
    problem = study.plan.problem
    evidence = study.belief.evidence(state.given, state.previous, len(chosen))
    after = beliefs.update(
        problem,
        np.array(state.belief),
        state.given,
        np.array(chosen, dtype=np.uint8),
        evidence,
    )
    answer = Answer(state.step, chosen, tuple(after.tolist()))
    labelled = replace(state, labels=chosen, belief=answer.belief, previous=state.given)
    if state.step + 1 == study.plan.n_steps:
        return replace(_to(labelled, stage="quiz", new=0), answer=answer)
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
    outcome = _to(state, stage="evaluation", given=state.given | new, new=new, heard=heard)
    return replace(outcome, decision=decision, answer=answer)


def _quiz(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    statements = study.plan.roles[state.slot_type].quiz
    missing = study.plan.texts.words["quiz_missing"]
    chosen = payload.get("chosen")
    if not isinstance(chosen, list) or len(chosen) > len(statements):
        raise Refused(missing)
    ticked = {_choice(c, len(statements), missing) for c in chosen}
    score = sum(statement.true == (i in ticked) for i, statement in enumerate(statements))
    return _to(state, stage="questions" if study.plan.asked else "done", score=score)


def _questions(study: Study, state: State, payload: Mapping[str, Any]) -> Outcome:
    _check(study.plan.asked, payload, study.plan.texts.words)
    return _to(state, stage="done")


def _check(
    questions: Sequence[Asked], payload: Mapping[str, Any], words: Mapping[str, str]
) -> None:
    """Raises Refused: an answer that its question does not allow."""
    for asked in questions:
        value, label = payload.get(asked.name, ""), asked.label
        if not isinstance(value, str) or len(value) > asked.max_length:
            raise Refused(words["too_long"].format(label=label, most=asked.max_length))
        if asked.needed and not value:
            raise Refused(words["answer_this"].format(label=label))
        if value and asked.options and value not in asked.options:
            raise Refused(words["choose_one"].format(label=label))
        if value and asked.kind == "number":
            whole = value.isascii() and value.isdigit() and len(value) < 10
            if not whole or not asked.low <= int(value) <= asked.high:
                text = words["whole_number"]
                raise Refused(text.format(label=label, low=asked.low, high=asked.high))
    if payload.keys() - {asked.name for asked in questions}:
        raise Refused(words["not_understood"])


def _choice(value: object, count: int, otherwise: str) -> int:
    """An integer 0 … count − 1 (true booleans count as what they are)."""
    if not isinstance(value, int) or not 0 <= value < count:
        raise Refused(otherwise)
    return int(value)


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
