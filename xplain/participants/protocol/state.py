"""Where a participant is, and what an event makes of it: the parts that any protocol has."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

from xplain.errors import Refused
from xplain.storage import decode


@dataclass(frozen=True)
class State:
    """Where a participant is. The first value is the start.

    Attributes:
        ENDS: the stages that nothing follows, beside "done".
        KINDS: the kind of event that each stage waits for; ``withdraw`` and ``time_out`` are
            always heard.
        stage: of the protocol.
        accepted: events accepted so far, which is the sequence number of the next one.
        part: which half of the practice.
        wrong: whether the last answer of a practice or a test was wrong.
        left: the stage at which somebody was timed out.
    """

    ENDS: ClassVar[tuple[str, ...]]
    KINDS: ClassVar[Mapping[str, str]]

    stage: str = "consent"
    accepted: int = 0
    part: int = 0
    wrong: bool = False
    left: str | None = None

    @property
    def over(self) -> bool:
        """Whether nothing more can happen."""
        return self.stage == "done" or self.stage in self.ENDS

    @property
    def text(self) -> str:
        """As JSON, for the store."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    @lru_cache(maxsize=1024)  # a page asks for its state several times
    def from_text(cls, text: str) -> Self:
        """The state that :attr:`text` was made from, equal to the last bit."""
        state: Self = decode(cls, json.loads(text))
        return state

    def to(self, **changes: Any) -> Outcome[Self]:
        """After one more accepted event."""
        return Outcome(replace(self, accepted=self.accepted + 1, **changes))


class StepColumns(Protocol):
    """A row of the step table, or the columns that an answer fills in."""

    @property
    def step(self) -> int: ...
    @property
    def columns(self) -> Mapping[str, str | int | None]: ...


@dataclass(frozen=True)
class Answer:
    """The labels of a step and the belief after them."""

    step: int
    labels: tuple[int, ...]
    belief: tuple[float, ...] | Mapping[str, float]

    @property
    def columns(self) -> dict[str, str]:
        """Of the step table, by name: those that the decision leaves None."""
        return {"labels": json.dumps(self.labels), "belief_after": json.dumps(self.belief)}


S_co = TypeVar("S_co", bound=State, covariant=True)
S = TypeVar("S", bound=State)


@dataclass(frozen=True)
class Outcome(Generic[S_co]):
    """A new state; the step that it opens (decision) and the one that it completes (answer)."""

    state: S_co
    decision: StepColumns | None = None
    answer: Answer | None = None


def at_any_stage(state: S, kind: str, words: Mapping[str, str]) -> Outcome[S] | None:
    """What an event does at any stage: it ends the part, or takes up one that was timed out. None
    where the stage's own step follows.

    Raises:
        Refused: the part has ended, or the stage waits for another kind of event.
    """
    if state.stage == "timed_out" and kind == "return":
        return state.to(stage=state.left, left=None)
    if state.over:
        raise Refused(words["ended"])
    if kind == "withdraw":
        return state.to(stage="withdrawn")
    if kind == "time_out":
        return state.to(stage="timed_out", left=state.stage)
    if kind != state.KINDS[state.stage]:
        raise Refused(words["other_page"])
    return None
