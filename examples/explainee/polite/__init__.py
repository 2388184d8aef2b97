"""Users who are too polite to say that a step makes no sense to them (the acquiescence of
questionnaires: Krosnick 1999). If a step makes sense to them, they always say so."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xplain import InputError, SimulatedUser, stream
from xplain.interaction.explainees import Explainee


@dataclass(frozen=True)
class Polite(Explainee):
    """Args:
    politeness: probability that a user calls an inexplicable transition explicable.
    """

    politeness: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.politeness <= 1:
            raise InputError("explainee.politeness", self.politeness, "a probability in [0, 1]")

    def say(
        self,
        user: SimulatedUser,
        thoughts: NDArray[np.uint8],
        rows: NDArray[np.int64],
        given: int,
        *when: int | str,
    ) -> NDArray[np.uint8]:
        """Returns answers that call some transitions, and all of their copies, explicable."""
        drawn = stream(user.seed, "polite").random(len(user.same))[user.same[rows]]
        return thoughts | (drawn < self.politeness)
