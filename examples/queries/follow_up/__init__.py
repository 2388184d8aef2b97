"""Follow-up questions: a step that makes no sense is asked again, with one message at a time."""

from dataclasses import dataclass

import numpy as np

from xplain import Answer, Setting, stream
from xplain.learning.data.queries import QueryAnswers, RandomTraces


@dataclass(frozen=True)
class FollowUp:
    """Attributes:
    trace_length: maximum length of a trace.
    """

    trace_length: int = 10

    def ask(
        self, setting: Setting, sizes: np.ndarray, answer: Answer, seed: int
    ) -> list[QueryAnswers]:
        """Asks about a trace without messages first; then about each step that made no sense, with
        each single message."""
        return [self._interview(setting, int(s), answer, o, seed) for o, s in enumerate(sizes)]

    def _interview(
        self, setting: Setting, size: int, answer: Answer, observer: int, seed: int
    ) -> QueryAnswers:
        rng = stream(seed, "queries", observer)
        silent = RandomTraces(self.trace_length, message_probability=0.0)
        single = 1 << np.arange(setting.n_messages)
        asked = QueryAnswers(np.empty((0, 3), int), np.empty(0, int), np.empty(0, np.uint8))
        while (left := size - len(asked.labels)) > 0:
            trace, nothing = silent.draw(setting, min(left, self.trace_length), rng)
            labels = answer(observer, trace, nothing)
            asked = _append(asked, trace, nothing, labels)
            again = np.repeat(trace[labels == 0], len(single), axis=0)[: left - len(trace)]
            if len(again):
                messages = np.resize(single, len(again))
                asked = _append(asked, again, messages, answer(observer, again, messages))
        return asked


def _append(asked: QueryAnswers, *more: np.ndarray) -> QueryAnswers:
    before = asked.transitions, asked.message_sets, asked.labels
    return QueryAnswers(*(np.concatenate(pair) for pair in zip(before, more, strict=True)))
