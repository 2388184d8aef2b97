"""What a session does next, and what it may ask."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError
from xplain.explanation.asking import Limits, Question, Questions
from xplain.explanation.label_table import LabelTable


@dataclass(frozen=True)
class Say:
    """Say these messages.

    Attributes:
        messages: names, at least one.
    """

    messages: tuple[str, ...]


@dataclass(frozen=True)
class Show:
    """Show the first transitions of the trace, and ask for a label of each.

    Attributes:
        steps: how many.
    """

    steps: int


Move = Question | Say | Show


@dataclass(frozen=True)
class Candidate:
    """What may be asked about.

    Attributes:
        transition: as ``types`` takes it; the answer is its label.
        text: for people. Of a belief its two sentences, a line each, in the order to be shown.
        right: of a belief, which line is right; −1 of a step.
    """

    transition: Any
    text: str
    right: int = -1


@dataclass(frozen=True)
class Why:
    """The values behind a decision.

    Attributes:
        step: transitions shown before it.
        given: messages given before it.
        belief: in each type, by name.
        chosen: the messages that it gave; none is *explain* at once.
        values: estimated discounted return by the messages given next, the best first; ``()`` is
            *explain* at once. Some solvers weigh messages one at a time.
        asked: the question, where it was one.
        questions: (question, estimated return if it is asked next), the best first, of those that
            the solver looked into.
    """

    step: int
    given: tuple[str, ...]
    belief: Mapping[str, float]
    chosen: tuple[str, ...]
    values: Mapping[tuple[str, ...], float]
    asked: Question | None = None
    questions: tuple[tuple[Question, float], ...] = ()

    def __str__(self) -> str:
        did = f"ask: {self.asked}" if self.asked else ", ".join(self.chosen) or "nothing to say"
        told = [
            *((value, f"ask: {question}") for question, value in self.questions),
            *((v, ", ".join(names) or "say nothing more") for names, v in self.values.items()),
        ]
        told.sort(key=lambda one: -one[0])
        return "\n".join([f"step {self.step + 1}: {did}"] + [f"  {v:9.3f}  {t}" for v, t in told])


def candidates(clips: Sequence[Any] | NDArray[Any] | Mapping[str, Any]) -> tuple[Candidate, ...]:
    """Transitions, or transitions by what people call them, or candidates."""
    named = clips.items() if isinstance(clips, Mapping) else ((str(clip), clip) for clip in clips)
    found = (
        clip if isinstance(clip, Candidate) else Candidate(plain(clip), text)
        for text, clip in named
    )
    return tuple(found)


def plain(transition: Any) -> Any:
    """Without numpy, for comparisons and JSON."""
    wrapped = isinstance(transition, (np.ndarray, np.generic))
    return transition.tolist() if wrapped else transition


def questions_of(
    clips: Sequence[Candidate], table: LabelTable, limits: Limits, trace: Sequence[Any], steps: int
) -> Questions:
    """The questions that these candidates are, of a trace that is to have so many steps."""
    shows = np.zeros((len(clips), steps), np.bool_)
    for q, clip in enumerate(clips):
        for i, transition in enumerate(trace):
            shows[q, i] = clip.right < 0 and clip.transition == transition
    texts = tuple(clip.text for clip in clips)
    return Questions(table, limits, shows, texts, np.array([clip.right for clip in clips]))


def check_texts(clips: Sequence[Candidate]) -> None:
    """Raises InputError: a belief that does not have two sentences."""
    for clip in clips:
        if clip.right not in (-1, 0, 1):
            raise InputError("clips.right", clip.right, "0 or 1 of a belief, −1 of a step")
        if clip.right >= 0 and clip.text.count("\n") != 1:
            raise InputError("clips.text", clip.text, "two sentences of a belief, a line each")
