"""Users who are too polite to say that a step makes no sense to them (the acquiescence of
questionnaires: Krosnick 1999). If a step makes sense to them, they always say so."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain import InputError, LabelTable, Reaction, SimulatedUser, stream
from xplain.interaction.explainees import Explainee, Person


@dataclass(frozen=True)
class Polite(Explainee):
    """Args:
    politeness: probability that a user calls an inexplicable transition explicable.
    """

    politeness: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.politeness <= 1:
            raise InputError("explainee.politeness", self.politeness, "a probability in [0, 1]")

    def meet(self, labels: LabelTable, same: NDArray[np.int64], seed: int) -> Person:
        """Makes a person who calls some transitions, and all of their copies, explicable."""
        drawn = stream(seed, "polite").random(len(same))[same]
        return _Silent(SimulatedUser(labels), drawn < self.politeness)


@dataclass(frozen=True)
class _Silent(Person):
    user: SimulatedUser
    about: NDArray[np.bool_]

    def hear(self, new: int) -> None:
        """Does nothing, because ``given`` says which messages the person knows."""

    def react(self, given: int, count: int) -> Reaction:
        thoughts = self.user.labels(count, given)
        return Reaction(thoughts, thoughts | self.about[:count].astype(np.uint8))
