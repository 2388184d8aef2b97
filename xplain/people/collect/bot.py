"""Simulated observers. They read the page, answer according to their incorrect beliefs, and
sometimes make errors, lose attention, or leave.

The same observer can use HTTP or a real browser.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from xplain.errors import Probability, Range, checks
from xplain.explanation.message_sets import indices
from xplain.people import bots
from xplain.people.bots import Page
from xplain.people.collect.plan import CollectPlan
from xplain.people.flow import Fields
from xplain.randomness import stream


@checks("habits")
@dataclass(frozen=True)
class Habits(bots.BotHabits):
    """Assumptions about observers.

    Attributes:
        error: probability of a wrong label for each step.
        lapse: probability that all labels of a page are random.
        forgetting: probability that a message on a page is missed.
        losing: probability, for each page, that a message that stays valid is forgotten.
        seconds: median time to read and label a step; σ of its logarithm is 0.4.
    """

    error: Probability = 0.05
    lapse: Probability = 0.0
    forgetting: Probability = 0.0
    losing: Probability = 0.0
    seconds: Annotated[float, Range(0)] = 6.0


class Observer(bots.Bot[CollectPlan, Habits]):
    """One simulated observer.

    Args:
        plan: has the sentences, and the labels of people of each role.
        held: bitmask of the facts that the observer believes incorrectly; a briefing changes it.
        habits: the assumed behaviour.
        rng: random stream.
    """

    def __init__(
        self, plan: CollectPlan, held: int, habits: Habits, rng: np.random.Generator
    ) -> None:
        super().__init__(plan, habits, rng)
        self.held = held

    def at_task(self, page: Page) -> None:
        """Learns the facts of a briefing, if there is one."""
        self.learn(page, [role.briefing for role in self.plan.roles])
        self.held = self.plan.roles[self.role].held if self.told else self.held

    def at_clips(self, page: Page) -> tuple[Fields, float]:
        """Gives a label for each step."""
        return self.labels(page.steps, self.heard(page.messages))

    def at_listening(self, page: Page) -> tuple[Fields, float]:
        """Gives a label for each step. The bot knows a message that it accepted until it forgets
        the message."""
        self.known |= self.heard(page.messages)
        answer = self.labels(page.steps, self.known)
        for j in indices(self.known if self.habits.losing else 0):
            self.known &= ~(self.chance(self.habits.losing) << j)
        return answer

    def at_beliefs(self, page: Page) -> Fields:
        """States the observer's belief about each fact."""
        facts = [int(name.removeprefix("fact_")) for name in page.fields]
        return [(f"fact_{j}", str(self.held >> j & 1)) for j in facts]

    def heard(self, told: Sequence[str]) -> int:
        """Returns the messages on a page that the bot notices, as a bitmask."""
        sentences, missing = [fact.message for fact in self.plan.facts], self.habits.forgetting
        # No draw without forgetting, so that the stream stays the same.
        heard = [said for said in told if not (missing and self.chance(missing))]
        return sum(1 << sentences.index(sentence) for sentence in heard)

    def labels(self, transitions: Sequence[int], right: int) -> tuple[Fields, float]:
        """Labels a clip's transitions as a person who believes the facts ``right`` (a bitmask)
        correctly. Without transitions, labels the obvious step. Also returns the time in
        seconds."""
        known = self.plan.hypotheses
        row = int(known.row(np.array(self.held & ~right)))
        true = [int(known.labels[row, t]) for t in transitions] or [0]
        if self.chance(self.habits.lapse):
            labels = self.rng.integers(0, 2, len(true)).tolist()
        else:
            labels = [label ^ self.chance(self.habits.error) for label in true]
        seconds = self.habits.seconds * self.rng.lognormal(0, 0.4, len(true)).sum()
        return [(f"label_{i}", str(label)) for i, label in enumerate(labels)], float(seconds)


def bot(plan: CollectPlan, habits: Habits, seed: int, number: int) -> Observer:
    """Makes the simulated observer with a number. Consecutive numbers have different roles."""
    held = plan.roles[number % len(plan.roles)].held
    return Observer(plan, held, habits, stream(seed, "bots", number))
