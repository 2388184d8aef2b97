"""Disaster rescue (paper, "Illustrative example"): a robot brings a victim to a shelter.

On its way it may pick up first aid, extinguish a fire and refuel; each of these actions gives a
reward once. Rubble, puddles and fences cost it nothing, but people may believe otherwise.
docs/choices.md explains what the paper does not specify.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Item, Scene
from xplain.domains.grid import MOVES, Cell, Grid, parameters_of
from xplain.domains.mdp import MDP
from xplain.errors import Discount, InputError, Positive, Slip, checks, number

SHELTER, VICTIM = "S", "V"
BONUSES = {"first_aid": "A", "fire": "F", "refuel": "U"}
"""Parameters that are the reward of an action, with the symbol of the required item."""
OBSTACLES = {"rubble": "r", "puddle": "p", "fence": "f"}
"""Parameters that are the reward of entering cells, with the symbol of these cells."""
ITEM_NAMES = {"first_aid": "first aid", "fire": "fire", "refuel": "fuel station"}
ACTIONS = {"first_aid": "pick_up_first_aid", "fire": "extinguish_fire", "refuel": "refuel"}
DONE = {
    "first_aid": "picks up the first aid",
    "fire": "extinguishes the fire",
    "refuel": "refuels",
}
SINCE = {
    "first_aid": "The robot has picked up the first aid.",
    "fire": "The fire is out.",
    "refuel": "The robot has refuelled.",
}
ENTERS = {"rubble": "over the rubble", "puddle": "through the puddle", "fence": "over the fence"}
SYMBOLS = {
    SHELTER: "shelter",
    VICTIM: "victim",
    **{symbol: ITEM_NAMES[name] for name, symbol in BONUSES.items()},
    **{symbol: name for name, symbol in OBSTACLES.items()},
}


@checks("domain")
class Rescue:
    """The rescue task. A state is a cell, one flag for each bonus (done or not), and "carries the
    victim".

    Args:
        map: ASCII map with one S (shelter), one V (victim); A first aid, F fire, U fuel station
            (one each, if ``parameters`` name them); r rubble, p puddle, f fence; # wall, . floor, s
            start cells of traces (every floor cell if there is no s).
        parameters: ``{name: {accurate, inaccurate, message, belief}}``; the values are rewards. For
            first_aid, fire and refuel it is the reward of the action; for rubble, puddle and fence
            it is the reward of entering a cell.
        rescue_reward: reward for bringing the victim into the shelter, which ends the task.
        slip: probability that a move slides to a side.
        discount: γ of the task, for the robot and all people.
        name: name of the domain.

    Raises:
        InputError: a value is not allowed; the map contradicts the description above, or has no
            path from a start, the victim or an item to the shelter.
    """

    feature_names = ("row", "column")

    def __init__(
        self,
        map: str,
        parameters: Mapping[str, Mapping[str, Any]],
        rescue_reward: Positive,
        discount: Discount,
        slip: Slip = 0.0,
        name: str = "rescue",
    ) -> None:
        """Reads the map and numbers the states: cell · 2^(bonuses + 1) + flags."""
        self.name = name
        self.parameters = parameters_of(parameters, [*BONUSES, *OBSTACLES])
        for parameter in self.parameters:
            number(f"domain.parameters.{parameter.name}.accurate", parameter.accurate)
            number(f"domain.parameters.{parameter.name}.inaccurate", parameter.inaccurate)
        self.rescue_reward, self.discount = rescue_reward, discount
        self.grid = Grid.parse(map, SYMBOLS)
        named = [parameter.name for parameter in self.parameters]
        for kind, symbol in {**BONUSES, **OBSTACLES}.items():
            if (symbol in self.grid.where) != (kind in named):
                raise InputError(
                    "domain.map", symbol, f"on the map if and only if {kind} is a parameter"
                )
        self.bonuses = {
            kind: self.grid.only(BONUSES[kind], kind) for kind in BONUSES if kind in named
        }
        self.shelter = self.grid.only(SHELTER, "shelter")
        self.victim = self.grid.only(VICTIM, "victim")
        cells = self.grid.starts()
        for what, cell in [
            ("victim", self.victim),
            *((ITEM_NAMES[kind], cell) for kind, cell in self.bonuses.items()),
            *(("start", int(cell)) for cell in cells),
        ]:
            self.grid.require_path(what, cell, "shelter", self.shelter)
        self.actions = (*MOVES, *(ACTIONS[kind] for kind in self.bonuses), "pick_up_victim")
        self._carrying = 1 << len(self.bonuses)
        self._flags = 2 * self._carrying
        self.starts: NDArray[np.int64] = cells * self._flags
        self.state_features = np.repeat(self.grid.cells, self._flags, axis=0).astype(np.float64)
        self._compute_outcomes(slip)

    def _compute_outcomes(self, slip: float) -> None:
        """Computes successors and probabilities, which do not depend on the parameters."""
        to, chance = self.grid.outcomes(slip)
        flags = np.arange(self._flags)
        n_cells, _, slots = to.shape
        shape = (n_cells, self._flags, len(self.actions), slots)
        successor = np.zeros(shape, dtype=np.int64)
        probability = np.zeros(shape)
        successor[:, :, :4] = to[:, None] * self._flags + flags[None, :, None, None]
        probability[:, :, :4] = chance[:, None]
        items = [*self.bonuses.values(), self.victim]
        for bit, cell in enumerate(items):
            todo = flags[flags >> bit & 1 == 0]
            successor[cell, todo, 4 + bit, 0] = cell * self._flags + (todo | 1 << bit)
            probability[cell, todo, 4 + bit, 0] = 1.0
        states = n_cells * self._flags
        self._successor = successor.reshape(states, len(self.actions), slots)
        self._probability = probability.reshape(self._successor.shape)
        self._terminal = np.zeros(states, dtype=bool)
        carried = flags[flags & self._carrying > 0]
        self._terminal[self.shelter * self._flags + carried] = True
        # An outcome enters a cell unless the robot stays where it is.
        before = np.arange(states)[:, None, None] // self._flags
        after = self._successor // self._flags
        entered = np.where((after != before) & (self._probability > 0), after, -1)
        self._entered = {
            kind: np.isin(entered, [self.grid.number[cell] for cell in self.grid.where[symbol]])
            for kind, symbol in OBSTACLES.items()
            if symbol in self.grid.where
        }
        self._delivered = self._terminal[self._successor] & (self._probability > 0)

    def model(self, values: Mapping[str, Any]) -> MDP:
        """Returns the task of a person who believes these rewards."""
        reward = np.where(self._delivered, self.rescue_reward, 0.0)
        for kind, entered in self._entered.items():
            reward[entered] += float(values[kind])
        for bit, kind in enumerate(self.bonuses):
            reward[:, 4 + bit, 0] = float(values[kind])
        return MDP(self._successor, self._probability, reward, self.discount, self._terminal)

    def position(self, state: int) -> Cell:
        """Returns the robot's cell (row, column), from 0."""
        return self.grid.position(state // self._flags)

    def describe(self, transition: NDArray[np.int64]) -> str:
        """Describes the transition [3] by a phrase, such as "moves right through the puddle at (2,
        3)"."""
        state, action, after = (int(x) for x in transition)
        if action >= 4:
            return [*(DONE[kind] for kind in self.bonuses), "picks up the victim"][action - 4]
        cell = self.position(after)
        move = list(MOVES)[action]
        carrying = after % self._flags & self._carrying > 0
        verb = f"carries the victim {move}" if carrying else f"moves {move}"
        if cell == self.position(state):
            return f"tries to move {move} and stays at {cell}"
        for kind, symbol in OBSTACLES.items():
            if cell in self.grid.where.get(symbol, ()):
                return f"{verb} {ENTERS[kind]} at {cell}"
        return f"{verb} into the shelter" if self._terminal[after] else f"{verb} to {cell}"

    def situation(self, state: int) -> tuple[str, ...]:
        """Returns sentences about earlier events that the map does not show."""
        flags = state % self._flags
        done = [SINCE[kind] for bit, kind in enumerate(self.bonuses) if flags >> bit & 1]
        return (*done, *(["The robot carries the victim."] if flags & self._carrying else []))

    def gone(self, state: int) -> tuple[str, ...]:
        """Returns the names of the items that are no longer on the map in this state. A fuel
        station stays on the map."""
        flags = state % self._flags
        taken = [ITEM_NAMES[kind] for bit, kind in enumerate(self.bonuses) if flags >> bit & 1]
        victim = [SYMBOLS[VICTIM]] if flags & self._carrying else []
        return tuple(name for name in [*taken, *victim] if name != ITEM_NAMES["refuel"])

    @property
    def scene(self) -> Scene:
        """The map for people: walls, and the cells of each item."""
        return self.grid.scene(
            [
                Item(name, symbol, self.grid.where[symbol])
                for symbol, name in SYMBOLS.items()
                if symbol in self.grid.where
            ]
        )
