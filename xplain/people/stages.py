"""Stages that flows share, and what their pages may be answered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from xplain.errors import Refused
from xplain.people.flow import F, Form, S, Stage
from xplain.people.plan import LabQuestion

CANNOT_TELL = 2
"""The answer of somebody who cannot tell whether a step makes sense: no evidence of anything."""


class Consent(Stage[F, S]):
    """The consent, to the text as it is now."""

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """Whether they agree, and the hash of the text that they read."""
        return {"agree": small(form.get("agree")), "text": form.get("text", "")[:64]}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """To the flow, or to a polite end."""
        agreed = choice(payload.get("agree"), 2, flow.words["consent_missing"])
        if payload.get("text") != flow.plan.texts.consent_hash:
            raise Refused(flow.words["consent_changed"])
        if not agreed:
            return state.to(stage="declined")
        return flow.after(state, **flow.admitted(payload))


@dataclass(frozen=True)
class OneLabel(Stage[F, S]):
    """A page with one step to label.

    Attributes:
        missing: key of the words for no answer.
    """

    missing: str

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """The label."""
        return {"label": small(form.get("label"))}

    def label(self, flow: F, payload: Mapping[str, Any], count: int = 2) -> int:
        """What was chosen, of so many answers.

        Raises:
            Refused: nothing.
        """
        return choice(payload.get("label"), count, flow.words[self.missing])


class Practice(OneLabel[F, S]):
    """One step twice: without the message that explains it (label 0), and with it (label 1)."""

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """On to the other half, or to the next stage; not before the label is right."""
        right = self.label(flow, payload) == state.part
        if right and state.part:
            return flow.after(state, wrong=False)
        return state.to(part=int(right or state.part), wrong=not right)


class LookingAhead(OneLabel[F, S]):
    """A step that looks odd and is right because of what comes later, which who errs is shown."""

    def wanted(self, plan: Any) -> bool:
        """Where the task has such a step."""
        return plan.ahead is not None

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """The step; what comes later once somebody erred."""
        steps = flow.plan.ahead.steps
        return {"action": steps[0], "later": steps[1:] if state.wrong else ()}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """On once it makes sense to them."""
        if self.label(flow, payload):
            return flow.after(state, wrong=False)
        return state.to(wrong=True)


@dataclass(frozen=True)
class QuestionStage(Stage[F, S]):
    """The lab's own questions.

    Attributes:
        of: the plan's field that has them.
        missed: the end for who gives another answer than the right one; "" goes on.
    """

    of: str = "asked"
    missed: str = ""

    def wanted(self, plan: Any) -> bool:
        """Where there are some."""
        return bool(getattr(plan, self.of))

    def view(self, flow: F, state: S) -> dict[str, Any]:
        """The questions."""
        return {"asked": getattr(flow.plan, self.of)}

    def read(self, flow: F, state: S, form: Form) -> dict[str, Any]:
        """The answers by name."""
        asked = getattr(flow.plan, self.of)
        return {one.name: one.read(form.get(one.name, "")) for one in asked}

    def advance(self, flow: F, state: S, payload: Mapping[str, Any]) -> S:
        """Each answer has to be one that its question allows."""
        asked: Sequence[LabQuestion] = getattr(flow.plan, self.of)
        for one in asked:
            if problem := one.problem(payload.get(one.name, ""), flow.words):
                raise Refused(problem)
        if payload.keys() - {one.name for one in asked}:
            raise Refused(flow.words["not_understood"])
        if self.missed and any(q.right and payload.get(q.name) != q.right for q in asked):
            return state.to(stage=self.missed)
        return flow.after(state)


# Answers ----------------------------------------------------------------------------------------


def small(text: object) -> int | None:
    """A whole number 0 … 999 in plain digits, else None."""
    if isinstance(text, str) and 0 < len(text) <= 3 and text.isascii() and text.isdigit():
        return int(text)
    return None


def choice(value: object, count: int, otherwise: str) -> int:
    """An integer 0 … count − 1 (true booleans count as what they are).

    Raises:
        Refused: anything else, with the words ``otherwise``.
    """
    if not isinstance(value, int) or not 0 <= value < count:
        raise Refused(otherwise)
    return int(value)


def choices(values: object, counts: Sequence[int], otherwise: str) -> tuple[int, ...]:
    """One choice a place, each from 0 … its count − 1.

    Raises:
        Refused: as :func:`choice`, or another number of them.
    """
    if not isinstance(values, list) or len(values) != len(counts):
        raise Refused(otherwise)
    pairs = zip(values, counts, strict=True)
    return tuple(choice(value, count, otherwise) for value, count in pairs)
