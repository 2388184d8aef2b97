"""A robot leaves a corridor of eight cells by one of its two doors."""

import numpy as np

from xplain import MDP, Parameter

CELLS = np.arange(8)  # the first and the last cell are doors


class Corridor:
    """A state is a cell. Each drive costs 1, plus the costs that a person believes in."""

    name, actions, feature_names = "corridor", ("left", "right"), ("cell",)
    parameters = (
        Parameter("wet", 0.0, -3.0, "Cell 5 is dry.", "Cell 5 is wet."),
        Parameter("stairs", 0.0, -3.0, "Cell 2 is flat.", "There are stairs in cell 2."),
        Parameter("lock", 0.0, -2.0, "The left door is open.", "The left door is locked."),
    )
    state_features = CELLS[:, None].astype(float)  # what a labeler may know of a state
    starts = CELLS[1:-1]
    scene = None  # no map

    def model(self, values):
        """Makes the task of a person who believes these values: [states, actions, outcomes]."""
        successor = np.clip(CELLS[:, None, None] + [[-1], [1]], 0, 7)
        reward = np.full(successor.shape, -1.0)
        for name, cell in (("wet", 5), ("stairs", 2), ("lock", 0)):
            reward += values[name] * (successor == cell)
        return MDP(successor, np.ones(successor.shape), reward, 0.95, np.isin(CELLS, (0, 7)))

    def describe(self, transition):
        """Describes a transition (state, action, next state) in words."""
        return f"drives {self.actions[transition[1]]} to cell {transition[2]}"

    def position(self, state):
        """Returns None, because there is no map."""
