"""One step of an explanation after the other: ask, decide, say, hear, believe.

The experiments and the sessions that people embed run this same loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.asking import NO_QUESTION, bitmask
from xplain.explanation.belief import BeliefUpdate, Evidence, answered, told, update
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers.base import Policy, asking


@dataclass
class Interaction:
    """One trace being explained (docs/method.md, section 5), by masks and arrays.

    Attributes:
        problem: what the agent believes of users.
        policy: planned for that problem. Both may be replaced between steps, by those of a trace
            that begins with the same transitions.
        belief_update: which labels change the belief.
        belief: over what is hidden, at first the prior.
        step: k, transitions shown so far.
        said: what was said so far, as :mod:`xplain.explanation.again` has it.
        asked: bitmask of the questions asked so far.
    """

    problem: Problem
    policy: Policy
    belief_update: BeliefUpdate
    belief: NDArray[np.float64] = field(init=False)
    step: int = field(init=False)
    said: int = field(init=False)
    asked: int = field(init=False)
    _answered: int | None = field(init=False)
    _clips: int = field(init=False)

    def __post_init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Nothing was said or shown yet."""
        self.belief, self.step, self.said, self.asked = self.problem.start, 0, 0, 0
        self._listen_anew()

    def resume(
        self,
        belief: NDArray[np.float64],
        step: int,
        said: int,
        asked: Sequence[int],
        answered: int | None,
        clips: Sequence[int],
    ) -> None:
        """Goes on from where an interaction stood.

        Args:
            belief, step, said: as the attributes.
            asked: the questions asked so far.
            answered: bitmask of the messages at the labels given last, if what is answered is no
                news since; else None.
            clips: the questions asked since news came last.
        """
        self.belief, self.step, self.said, self.asked = belief, step, said, bitmask(asked)
        self._answered, self._clips = answered, bitmask(clips)

    @property
    def given(self) -> int:
        """Bitmask of the messages given so far."""
        return self.said & (1 << self.problem.n_messages) - 1

    def _listen_anew(self) -> None:
        """From now on whatever is answered is news."""
        self._answered: int | None = None
        self._clips = 0  # asked since, whose answers are labels of the trace

    def ask(self) -> int:
        """The question to ask now, before this step's messages; NO_QUESTION for none."""
        if self.problem.questions is None:
            return NO_QUESTION
        return asking(self.policy).question(self.step, self.said, self.belief, self.no_news)

    @property
    def no_news(self) -> int:
        """Bitmask of the questions asked, and of those whose answers were heard as labels."""
        questions = self.problem.questions
        if questions is None or self._answered is None or self.belief_update.fresh_labels:
            return self.asked
        heard = questions.shows[:, : self.step].any(axis=1)
        return self.asked | bitmask(np.flatnonzero(heard).tolist())

    def hear_answer(self, question: int, answer: int) -> None:
        """The user's answer, 0 or 1, to a question."""
        self.belief = answered(self.problem, self.belief, self.given, question, answer)
        self.asked |= 1 << question
        self._clips |= 1 << question

    def values(self) -> Mapping[int, float]:
        """The values behind what is asked or said now: by bitmask of messages, by ``~q`` of
        question q."""
        if self.problem.questions is None:
            return self.policy.values(self.step, self.said, self.belief)
        return asking(self.policy).values(self.step, self.said, self.belief, self.no_news)

    def say(self) -> int:
        """Decides which messages come before the next *explain*: a bitmask, given from now on.

        Raises:
            ValueError: as :meth:`give`.
        """
        if self.problem.questions is None:
            new = self.policy.messages(self.step, self.said, self.belief)
        else:
            no_news = self.no_news
            new = asking(self.policy).messages(self.step, self.said, self.belief, no_news)
        self.give(new)
        return new

    def give(self, new: int) -> None:
        """These messages are said; again, where users may have missed or forgotten them.

        Raises:
            ValueError: one does not exist, or may not be said any more.
        """
        problem = self.problem
        if new & ~problem.may_say(self.said):
            raise ValueError(
                f"policy gave message set {new:b} at step {self.step}, {self.said:b} already said"
            )
        self.said = problem.again.after(self.said, new, problem.n_messages)
        self.belief = told(problem, self.belief, new)
        if new:
            self._listen_anew()  # who heard something new is asked something new

    def hear(self, labels: NDArray[np.uint8]) -> None:
        """*Explain* showed the first ``step + 1`` transitions; these are the user's labels."""
        count = self.step + 1
        evidence: Evidence = self.belief_update.evidence(self.given, self._answered, count)
        if self._clips and not self.belief_update.fresh_labels and self.problem.questions:
            shows = self.problem.questions.shows[indices(self._clips), :count]
            evidence = ~shows.any(axis=0) & np.isin(np.arange(count), np.arange(count)[evidence])
        self.belief = update(self.problem, self.belief, self.given, labels, evidence)
        self._answered = self.given
        if self.problem.habits.forget.any():
            self._listen_anew()  # who may have forgotten something is asked something new, too
        self.step = count
