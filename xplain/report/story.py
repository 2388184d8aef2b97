"""One episode as it is drawn and told, read from a run's files alone."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median_low

from xplain.experiment.results import EPISODES


@dataclass(frozen=True)
class Story:
    """One episode.

    Attributes:
        user_type: whom the trace was explained to.
        cost: of the episode.
        phrases: the m transitions in words.
        positions: m + 1 cells, or none.
        messages: names of the new messages before each step.
        labels: row k the k + 1 labels given at step k.
        changes: what each transition changes, or none.
        questions: (what was asked about, the reply) of each question before each step; or none.
    """

    solver: str
    trace: int
    user_type: str
    cost: float
    phrases: tuple[str, ...]
    positions: tuple[tuple[int, int], ...]
    messages: tuple[tuple[str, ...], ...]
    labels: tuple[tuple[int, ...], ...]
    changes: tuple[tuple[str, ...], ...] = ()
    questions: tuple[tuple[tuple[str, str], ...], ...] = ()

    @property
    def n_questions(self) -> int:
        """Number of questions asked over all steps."""
        return sum(map(len, self.questions))

    @property
    def n_messages(self) -> int:
        """Number of messages given over all steps."""
        return sum(map(len, self.messages))

    @property
    def n_inexplicable(self) -> int:
        """Number of labels 0 over all steps."""
        return sum(row.count(0) for row in self.labels)


def stories(folder: Path, solver: str) -> Iterator[Story]:
    """The episodes of a run's folder, of one solver ("solver", "oracle" or "clairvoyant")."""
    with (folder / EPISODES).open(encoding="utf-8") as file:
        for line in file:
            if f'"solver": "{solver}"' not in line:
                continue
            content = json.loads(line)
            yield Story(
                solver=content["solver"],
                trace=content["trace"],
                user_type=content["type"],
                cost=content["cost"],
                phrases=tuple(content["transitions"]),
                positions=tuple((row, column) for row, column in content["positions"]),
                messages=tuple(tuple(step["messages"]) for step in content["steps"]),
                labels=tuple(tuple(step["labels"]) for step in content["steps"]),
                changes=tuple(map(tuple, content.get("changes", ()))),
                questions=tuple(
                    tuple((one["about"] or one["text"], one["reply"]) for one in step["questions"])
                    for step in content["steps"]
                    if "questions" in step
                ),
            )


def typical(found: Sequence[Story]) -> Story:
    """The first episode whose cost is the median of all (of an even number, the lower middle)."""
    median = median_low(story.cost for story in found)
    return next(story for story in found if math.isclose(story.cost, median, abs_tol=1e-9))


def which(story: Story, episodes: int) -> str:
    """Which of a run's episodes a :func:`typical` one is, and by what rule it was taken."""
    return (
        f"trace {story.trace}, user of type {story.user_type}: cost {story.cost:g}, the median of "
        f"{counted(episodes, 'episode')} (the first that costs this)"
    )


def counted(number: int, what: str) -> str:
    """``no message``, ``1 message``, ``2 messages``."""
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"
