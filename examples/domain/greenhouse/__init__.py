"""A robot on its way along the beds of a greenhouse: it walks, takes the rail, waters a dry bed."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from xplain import MDP, InputError, Item, Parameter, Scene

WALK, RAIL, WATER = range(3)


class Greenhouse:
    """A state is 2 · bed + (1 if the dry bed is watered); the last bed ends the task."""

    name = "greenhouse"
    actions = ("walk", "take_the_rail", "water")
    feature_names = ("bed", "watered")

    def __init__(
        self, beds: int, dry: int, harvest: float, parameters: Mapping[str, Mapping[str, Any]]
    ) -> None:
        if not 0 < dry < beds - 1:
            raise InputError("domain.dry", dry, f"a bed between the first and the last, {beds - 1}")
        self.beds, self.dry, self.harvest = beds, dry, harvest
        self.parameters = tuple(Parameter(name, **facts) for name, facts in parameters.items())
        self.state_features = np.array([[s // 2, s % 2] for s in range(2 * beds)], dtype=float)
        self.starts = 2 * np.arange(dry)

    def model(self, values: Mapping[str, Any]) -> MDP:
        """The task of someone who holds these values: what each action costs or earns."""
        shape = (2 * self.beds, 3, 1)  # states, actions, outcomes of an action
        successor, possible, reward = np.zeros(shape, np.int64), np.zeros(shape), np.zeros(shape)
        for state in range(2 * self.beds):
            bed, watered = divmod(state, 2)
            for action, after, earned in (
                (WALK, bed + 1, values["walk"]),
                (RAIL, bed + 2, values["rail"]),
            ):
                if after < self.beds:
                    successor[state, action] = 2 * after + watered
                    possible[state, action] = 1
                    reward[state, action] = earned + self.harvest * (after == self.beds - 1)
            if bed == self.dry and not watered:
                successor[state, WATER], possible[state, WATER] = state + 1, 1
                reward[state, WATER] = values["water"]
        last = np.arange(2 * self.beds) >= 2 * (self.beds - 1)
        return MDP(successor, possible, reward, discount=0.97, terminal=last)

    def describe(self, transition: np.ndarray) -> str:
        """Such as "takes the rail to bed 4"."""
        _, action, after = transition
        words = ("walks", "takes the rail", "waters bed")[action]
        return f"{words} {after // 2}" if action == WATER else f"{words} to bed {after // 2}"

    def position(self, state: int) -> tuple[int, int]:
        """The cell on the map."""
        return 0, state // 2

    @property
    def scene(self) -> Scene:
        """One row of beds."""
        return Scene(1, self.beds, items=(Item("dry bed", "D", ((0, self.dry),)),))
