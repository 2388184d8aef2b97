"""Simulated participants. They read sentences, forget some, sometimes err, and need time.

A :class:`StudyBot` has the plan's table of true labels, but uses only what the pages say. The same
participant can use HTTP or a real browser.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from xplain.errors import Probability, Range, checks
from xplain.explanation.message_sets import indices
from xplain.people import bots
from xplain.people.bots import Page
from xplain.people.flow import Fields
from xplain.people.study.plan import StudyPlan
from xplain.randomness import stream


@checks("habits")
@dataclass(frozen=True)
class Habits(bots.BotHabits):
    """Assumptions about simulated participants.

    Attributes:
        label_noise: probability that a new label is wrong.
        forgetting: probability that a message is missed when it is given.
        overload: increase of the probability ``forgetting`` for each other message on the page, old
            or new.
        fading: probability that a fact learned from a message is forgotten before the quiz.
        losing: probability that a fact learned from a message is forgotten after a step, for each
            step.
        page_seconds: time to read an evaluation page and press the button.
        message_seconds: time to read a new message; an old message takes a twentieth of this time.
        label_seconds: time to label a step; a step whose label is kept takes a tenth of this time.
        spread: σ of two lognormal factors: one for each single time, and one for all times of a
            participant.
    """

    label_noise: Probability = 0.03
    forgetting: Probability = 0.05
    overload: Probability = 0.03
    fading: Probability = 0.1
    losing: Probability = 0.0
    page_seconds: Annotated[float, Range(0)] = 4.0
    message_seconds: Annotated[float, Range(0)] = 5.0
    label_seconds: Annotated[float, Range(0)] = 4.0
    spread: Annotated[float, Range(0)] = 0.35


class StudyBot(bots.Bot[StudyPlan, Habits]):
    """One simulated participant. In a study without a briefing, the participant is of a random
    kind (``plan.kinds``). Otherwise the user type follows from the briefing."""

    def __init__(self, plan: StudyPlan, habits: Habits, rng: np.random.Generator) -> None:
        super().__init__(plan, habits, rng)
        self.role = int(rng.integers(len(plan.kinds))) if plan.kinds else 0
        self.seconds = 0.0
        self._judged: int | None = None
        self._labels: list[int] = []
        self._pace = self._draw_factor()

    def _draw_factor(self) -> float:
        sigma = self.habits.spread
        return float(self.rng.lognormal(-(sigma**2) / 2, sigma))

    def at_briefing(self, page: Page) -> None:
        """Learns the facts of the briefing, if there are any."""
        self.learn(page, [role.briefing for role in self.plan.roles])

    def at_eligibility(self, page: Page) -> Fields:
        """Answers each question as the briefing says, apart from mistakes."""
        questions = self.plan.roles[self.role].eligibility
        return [
            (f"q{i}", str((q.answer + self.chance(self.habits.mistake)) % len(q.options)))
            for i, q in enumerate(questions)
        ]

    def at_evaluation(self, page: Page) -> tuple[Fields, float]:
        """Gives a label for each step."""
        labels, seconds = self.labels(len(page.fields), len(page.messages), page.new)
        self.seconds += seconds
        return [(f"label_{i}", str(label)) for i, label in enumerate(labels)], seconds

    def at_asking(self, page: Page) -> tuple[Fields, float]:
        """Answers the question about a transition. The answer is wrong with the probability
        ``label_noise``, like the labels of the trace."""
        labels, habits, (clip,) = self.plan.clip_labels, self.habits, page.steps
        assert labels is not None, "a plan that asks has the answers of simulated people"
        truth = labels.of_steps([clip]).label_probabilities(1, self.known)[self.role, 0]
        label = int(truth) ^ self.chance(habits.label_noise)
        seconds = (habits.page_seconds + habits.label_seconds) * self._draw_factor() * self._pace
        self.seconds += seconds
        return [("label", str(label))], seconds

    def at_quiz(self, page: Page) -> Fields:
        """Ticks the statements that the simulated participant believes."""
        wrong = self.plan.wrong[self.role]
        self._forget(self.habits.fading)
        true = {
            fact.belief if j in wrong and not self.known >> j & 1 else fact.message
            for j, fact in enumerate(self.plan.facts)
        } | {known.message for known in self.plan.known}
        return [
            ("true", str(value))
            for value, sentence in page.fields["true"]
            if (sentence in true) ^ self.chance(self.habits.label_noise)
        ]

    def _forget(self, probability: float) -> None:
        """Forgets each corrected fact with this probability, independently."""
        wrong = self.plan.wrong[self.role]
        for j in indices(self.known):
            if j in wrong and self.chance(probability):
                self.known &= ~(1 << j)

    def labels(self, count: int, messages: int, new: Sequence[str]) -> tuple[list[int], float]:
        """Labels the first steps of the trace.

        Args:
            count: number of steps to label.
            messages: number of messages on the page.
            new: the messages that are given now.

        Returns:
            The labels, and the time in seconds.
        """
        habits, others = self.habits, messages - 1
        for sentence in new:
            if not self.chance(min(1.0, habits.forgetting + habits.overload * others)):
                j = [fact.message for fact in self.plan.facts].index(sentence)
                self.known |= 1 << j
        fresh = range(count) if self.known != self._judged else range(len(self._labels), count)
        truth = self.plan.true_labels[self.role, :, self.known]
        self._labels = [
            int(truth[i]) ^ self.chance(habits.label_noise) if i in fresh else self._labels[i]
            for i in range(count)
        ]
        self._judged = self.known
        seconds = habits.page_seconds * self._draw_factor()
        seconds += habits.message_seconds * (
            sum(self._draw_factor() for _ in new) + (messages - len(new)) / 2 * 0.1
        )
        seconds += habits.label_seconds * sum(
            self._draw_factor() if i in fresh else 0.1 for i in range(count)
        )
        if habits.losing:  # no draw without forgetting
            self._forget(habits.losing)
        return list(self._labels), seconds * self._pace


def bot(plan: StudyPlan, habits: Habits, seed: int, number: int) -> StudyBot:
    """Makes a simulated participant; bots with different ``number`` behave independently."""
    return StudyBot(plan, habits, stream(seed, "bots", number))
