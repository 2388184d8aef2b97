"""Four rooms (Sutton, Precup & Singh 1999): reach a goal through the doors of four rooms.

People may believe five facts about the task incorrectly: the positions of the goals and of the
penalty cells, the discount, the cost of a step, and the penalty. docs/choices.md explains the
values.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Item, Scene
from xplain.domains.grid import MOVES, Cell, Grid, parameters_of
from xplain.domains.mdp import MDP
from xplain.errors import InputError, Range, Slip, checks, number, require_list

PARAMETERS = ("goals", "discount", "step_cost", "penalty_cells", "penalty")
DOORS = ((3, 6), (10, 6), (6, 2), (7, 9))
"""Doors of the published map: (row, column) from 0; row 0 and column 0 are walls."""


@checks("domain")
class FourRooms:
    """The four-rooms task. States are cells; entering a goal earns its reward and ends the task.

    Args:
        map: ASCII map of walls (#), floor (.) and optional start cells (s).
        parameters: ``{name: {accurate, inaccurate, message, belief}}``; all five are required:
            goals, a list of ``{cell: [row, column], reward}``; discount, γ in (0, 1); step_cost,
            subtracted at every move; penalty_cells, a list of [row, column]; penalty, subtracted on
            entering such a cell.
        slip: probability that a move slides to a side.
        name: name of the domain.

    Raises:
        InputError: a value is not allowed, or a start has no path to the goals.
    """

    feature_names = ("row", "column")
    actions = tuple(MOVES)

    def __init__(
        self,
        map: str,
        parameters: Mapping[str, Mapping[str, Any]],
        slip: Slip = 0.0,
        name: str = "four_rooms",
    ) -> None:
        """Reads the map and checks both values of every parameter."""
        self.name = name
        self.grid = Grid.parse(map, {})
        self.parameters = parameters_of(parameters, PARAMETERS)
        if missing := set(PARAMETERS) - {parameter.name for parameter in self.parameters}:
            raise InputError("domain.parameters", sorted(missing)[0], "missing")
        self._successor, self._probability = self.grid.outcomes(slip)
        self._moves = self._successor != np.arange(len(self.grid.cells))[:, None, None]
        accurate = {parameter.name: parameter.accurate for parameter in self.parameters}
        for parameter in self.parameters:
            self.model(accurate | {parameter.name: parameter.inaccurate})
        goals = self._read_goals(accurate["goals"])
        starts = self.grid.starts()
        # Nothing happens after a goal, so no trace starts there.
        self.starts: NDArray[np.int64] = starts[~np.isin(starts, list(goals))]
        for start in self.starts:
            for goal in goals:
                self.grid.require_path("start", int(start), "goal", goal)
        self.state_features = self.grid.cells.astype(np.float64)

    def model(self, values: Mapping[str, Any]) -> MDP:
        """Returns the task of a person who believes these values.

        Raises:
            InputError: a value is not allowed.
        """
        goals = self._read_goals(values["goals"])
        discount = number("domain.parameters.discount", values["discount"], Range(0, 1, "()"))
        reward = np.full(
            self._successor.shape, -number("domain.parameters.step_cost", values["step_cost"])
        )
        penalised = [
            self.grid.at(cell, "domain.parameters.penalty_cells")
            for cell in require_list("domain.parameters.penalty_cells", values["penalty_cells"])
        ]
        entered = self._moves & np.isin(self._successor, penalised)
        reward[entered] -= number("domain.parameters.penalty", values["penalty"])
        terminal = np.zeros(len(self.grid.cells), dtype=bool)
        for cell, value in goals.items():
            terminal[cell] = True
            reward[self._moves & (self._successor == cell)] += value
        return MDP(self._successor, self._probability, reward, discount, terminal)

    def _read_goals(self, value: Any) -> dict[int, float]:
        """Reads the goals. Returns the reward of each goal by cell number."""
        key = "domain.parameters.goals"
        goals = {}
        for goal in require_list(key, value):
            if not isinstance(goal, Mapping) or set(goal) != {"cell", "reward"}:
                raise InputError(key, goal, "{cell: [row, column], reward: a number}")
            goals[self.grid.at(goal["cell"], key)] = number(f"{key}.reward", goal["reward"])
        if not goals:
            raise InputError(key, value, "at least one goal")
        return goals

    def position(self, state: int) -> Cell:
        """Returns the robot's cell (row, column), from 0."""
        return self.grid.position(state)

    def describe(self, transition: NDArray[np.int64]) -> str:
        """Describes the transition [3] by a phrase, such as "moves right to (3, 6)"."""
        state, action, after = (int(x) for x in transition)
        move = self.actions[action]
        if after == state:
            return f"tries to move {move} and stays at {self.position(after)}"
        return f"moves {move} to {self.position(after)}"

    @property
    def scene(self) -> Scene:
        """The map with the true goals and penalty cells."""
        accurate = {parameter.name: parameter.accurate for parameter in self.parameters}
        goals = [
            Item(
                f"goal (reward {goal['reward']:g})",
                "G",
                (_to_cell(goal["cell"]),),
                shows=("goals",),
            )
            for goal in accurate["goals"]
        ]
        cells = tuple(_to_cell(cell) for cell in accurate["penalty_cells"])
        penalty = [Item("penalty", "x", cells, shows=("penalty_cells",))] if cells else []
        return self.grid.scene([*goals, *penalty])


def _to_cell(value: Sequence[int]) -> Cell:
    return int(value[0]), int(value[1])
