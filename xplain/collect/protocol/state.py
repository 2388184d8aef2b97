"""Where a participant is, and what belongs into the step table: plain values."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from xplain.participants.protocol import state as core

STAGES = ("consent", "task", "practice", "clips", "beliefs", "questions", "done")
ENDS = ("declined", "withdrawn", "timed_out")
FINISHED = ("beliefs", "questions", "done")
"""Stages of those who have answered every clip."""
KINDS = {
    "consent": "consent",
    "task": "read",
    "practice": "example",
    "clips": "labels",
    "beliefs": "beliefs",
    "questions": "answers",
    "timed_out": "return",
}
"""The kind of event that each stage waits for; ``withdraw`` and ``time_out`` are always heard."""
QUESTION, REPEAT, ATTENTION = "question", "repeat", "attention"
STATED = ("accurate", "inaccurate", "unsure")
"""What somebody may say of a fact, by the number in the payload."""


@dataclass(frozen=True)
class Clip:
    """A few transitions under one message set, and their labels once they are given.

    Attributes:
        purpose: QUESTION, REPEAT or ATTENTION (which has no transitions, and one label).
        transitions: rows of the hypotheses.
        told: bitmask of the messages shown.
        labels: one a transition; empty before the answer.
    """

    purpose: str
    transitions: tuple[int, ...]
    told: int
    labels: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """Steps on the page."""
        return max(len(self.transitions), 1)


@dataclass(frozen=True)
class State(core.State):
    """Where a participant is. The first value is the start.

    Attributes:
        stage: one of STAGES or ENDS.
        number: the participant's, which seeds their questions; None before consent.
        role: index of the role whose briefing they got; None for people as they are.
        others: {fact set: its share among those asked before}.
        answered: clips with their labels.
        clip: the one on the page.
        belief: {fact set, or "none": its posterior}, after the last question.
        stated: of each fact an index into STATED.
    """

    ENDS = ENDS
    KINDS = KINDS

    number: int | None = None
    role: int | None = None
    others: Mapping[str, float] = field(default_factory=dict)
    answered: tuple[Clip, ...] = ()
    clip: Clip | None = None
    belief: Mapping[str, float] = field(default_factory=dict)
    stated: tuple[int, ...] = ()

    @property
    def person(self) -> int:
        """The participant's number, in the stages after consent."""
        assert self.number is not None, f"no number at {self.stage}"
        return self.number

    def questions(self) -> list[Clip]:
        """The answered clips that are questions: what is learned from."""
        return [clip for clip in self.answered if clip.purpose == QUESTION]

    @property
    def attentive(self) -> bool | None:
        """Whether the obvious step was labelled as anybody would; None before it was seen."""
        seen = [clip.labels[0] for clip in self.answered if clip.purpose == ATTENTION]
        return None if not seen else seen[0] == 0

    @property
    def consistency(self) -> float | None:
        """Share of the labels of repeated clips that are as before; None where none is."""
        first = {(c.transitions, c.told): c.labels for c in reversed(self.questions())}
        pairs = [
            pair
            for clip in self.answered
            if clip.purpose == REPEAT
            for pair in zip(clip.labels, first[clip.transitions, clip.told], strict=True)
        ]
        return sum(a == b for a, b in pairs) / len(pairs) if pairs else None


@dataclass(frozen=True)
class Decision:
    """Which clip was chosen, and why: the posterior before it and the bits that it tells."""

    step: int
    belief: Mapping[str, float]
    clip: Clip
    bits: float

    @property
    def columns(self) -> dict[str, str | int | None]:
        """Of the step table, by name; what the answer will fill in is None."""
        chosen = {
            "purpose": self.clip.purpose,
            "transitions": self.clip.transitions,
            "bits": self.bits,
        }
        return {
            "belief_before": json.dumps(self.belief),
            "given": self.clip.told,
            "messages": 0,
            "action_values": json.dumps(chosen),
            "labels": None,
            "belief_after": None,
        }


Outcome = core.Outcome[State]
