"""Users who are too polite to say that a step puzzles them (the acquiescence of questionnaires:
Krosnick 1999). They never call a step odd that is not."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain import InputError, LabelTable, Reaction, SimulatedUser, stream
from xplain.interaction.explainees import Explainee, Person


@dataclass(frozen=True)
class Polite(Explainee):
    """Args:
    politeness: probability that somebody does not say what puzzles them about a transition.
    """

    politeness: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.politeness <= 1:
            raise InputError("explainee.politeness", self.politeness, "a probability in [0, 1]")

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """Somebody who keeps silent about some transitions, and about all of their copies."""
        drawn = stream(seed, "polite").random(len(same))[same]
        return _Silent(SimulatedUser(labels), drawn < self.politeness)


@dataclass(frozen=True)
class _Silent(Person):
    user: SimulatedUser
    about: NDArray[np.bool_]

    def hear(self, new: int) -> None:
        """Believes it; ``given`` says what was said."""

    def react(self, given: int, count: int) -> Reaction:
        thoughts = self.user.labels(count, given)
        return Reaction(thoughts, thoughts | self.about[:count].astype(np.uint8))
