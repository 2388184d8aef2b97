"""A small domain whose types can be computed by hand."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain import MDP, Parameter

SIZE = 6


class Corridor:
    """Six cells in a row with a reward at the right end. People may believe that it is at the left
    end, or that the middle costs a toll."""

    name = "corridor"
    parameters = (
        Parameter("end", "right", "left", "It is at the right."),
        Parameter("toll", 0.0, -5.0, "The way is free."),
    )
    actions = ("left", "right")
    feature_names = ("cell",)
    scene = None

    def __init__(self, starts: Sequence[int] = range(1, SIZE - 1)) -> None:
        self.state_features = np.arange(SIZE, dtype=np.float64)[:, None]
        self.starts = np.array(starts)

    def model(self, values: Mapping[str, Any]) -> MDP:
        successor = np.stack([np.arange(SIZE) - 1, np.arange(SIZE) + 1], axis=1).clip(0, SIZE - 1)
        reward = np.zeros((SIZE, 2, 1))
        goal = SIZE - 1 if values["end"] == "right" else 0
        reward[successor == goal] = 1.0
        reward[(successor == 3) & (np.arange(SIZE) == 2)[:, None]] += values["toll"]
        terminal = np.isin(np.arange(SIZE), [0, SIZE - 1])
        return MDP(successor[:, :, None], np.ones((SIZE, 2, 1)), reward, 0.9, terminal)

    def describe(self, transition: NDArray[np.int64]) -> str:
        return str(transition)

    def position(self, state: int) -> None:
        return None


class Painted(Corridor):
    """The corridor with a fact that changes nothing."""

    name = "painted"
    parameters = (*Corridor.parameters, Parameter("colour", "red", "blue", "It is red."))


class Padded(Corridor):
    """The corridor with an outcome of probability 0, which would lead back to cell 1."""

    name = "padded"

    def model(self, values: Mapping[str, Any]) -> MDP:
        plain = super().model(values)
        return MDP(
            np.concatenate([plain.successor, np.ones_like(plain.successor)], axis=2),
            np.concatenate([plain.probability, np.zeros_like(plain.probability)], axis=2),
            np.concatenate([plain.reward, np.zeros_like(plain.reward)], axis=2),
            plain.discount,
            plain.terminal,
        )
