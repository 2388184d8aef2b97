"""A robot drives to the dispatch of a warehouse; people may believe dozens of local facts."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from xplain import MDP, InputError, Item, Parameter, Scene

BLOCK = 3  # cells from one crossing of aisles to the next
MOVES = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
KINDS = ("wet", "lane", "wet", "lane", "charger")  # kinds of the facts, in turn
BACK = {"right": "left", "down": "up"}


class Warehouse:
    """A state is a cell of an aisle; the dispatch, the last crossing, ends the task. Each fact is
    about the two cells between two crossings. The robot's value of each parameter is 0: the
    incorrect beliefs are not true."""

    name = "warehouse"
    actions = tuple(MOVES)
    feature_names = ("row", "column")

    def __init__(self, facts: int, layout: int, wet: float, against: float, charge: float) -> None:
        if not isinstance(facts, int) or not 2 <= facts <= 62:
            raise InputError("domain.facts", facts, "a whole number from 2 to 62")
        high, wide = 2, 2  # crossings of the smallest map with enough stretches
        while high * (wide - 1) + (high - 1) * wide < facts:
            high, wide = (high, wide + 1) if wide == high else (high + 1, wide)
        self.size = BLOCK * (high - 1) + 1, BLOCK * (wide - 1) + 1
        every = list(np.ndindex(self.size))
        self.cells = [cell for cell in every if cell[0] % BLOCK == 0 or cell[1] % BLOCK == 0]
        self.walls = tuple(cell for cell in every if cell not in self.cells)
        self.number = {cell: s for s, cell in enumerate(self.cells)}
        self.state_features = np.array(self.cells, dtype=float)
        crossings = [s for s, (r, c) in enumerate(self.cells) if r % BLOCK == c % BLOCK == 0]
        self.starts = np.array(crossings[:-1])
        stretches = [
            (way, tuple(self.step(cell, way, i) for i in range(1, BLOCK)))
            for cell in (self.cells[s] for s in crossings)
            for way in ("right", "down")
            if self.step(cell, way) in self.number
        ]
        rng = np.random.default_rng(layout)
        chosen = sorted(rng.permutation(len(stretches))[:facts].tolist())
        kinds = rng.permutation(np.arange(facts) % len(KINDS)).tolist()
        worth = {"wet": -wet, "lane": -against, "charger": charge}
        self.stretches: dict[str, Any] = {}
        parameters = []
        for s, kind in zip(chosen, (KINDS[k] for k in kinds), strict=True):
            name = f"{kind}_{1 + sum(known.startswith(kind) for known in self.stretches)}"
            self.stretches[name] = way, cells = stretches[s]
            message, belief = sentences(kind, way, cells, abs(worth[kind]))
            parameters.append(Parameter(name, 0.0, worth[kind], message, belief))
        self.parameters = tuple(parameters)

    @staticmethod
    def step(cell: tuple[int, ...], way: str, count: int = 1) -> tuple[int, int]:
        """Returns the cell that is ``count`` cells ahead."""
        return cell[0] + count * MOVES[way][0], cell[1] + count * MOVES[way][1]

    def model(self, values: Mapping[str, Any]) -> MDP:
        """Makes the task of a person who believes these values: each drive costs 1, plus the costs
        that the person believes in."""
        shape = (len(self.cells), len(MOVES), 1)  # states, actions, outcomes of an action
        successor, reward = np.empty(shape, np.int64), np.full(shape, -1.0)
        about = {cell: name for name, (_, cells) in self.stretches.items() for cell in cells}
        for s, cell in enumerate(self.cells):
            for action, move in enumerate(MOVES):
                after = self.step(cell, move)
                successor[s, action] = self.number.get(after, s)
                name = about.get(after)
                if name and (not name.startswith("lane") or move == self.stretches[name][0]):
                    reward[s, action] += values[name]
        last = np.arange(len(self.cells)) == len(self.cells) - 1
        return MDP(successor, np.ones(shape), reward, discount=0.95, terminal=last)

    def describe(self, transition: np.ndarray) -> str:
        """Describes a transition, such as "drives right on lane_2 at (2, 3)"."""
        _, action, after = (int(x) for x in transition)
        on = [name for name, (_, cells) in self.stretches.items() if self.cells[after] in cells]
        where = f"on {on[0]} at" if on else "to"
        return f"drives {self.actions[action]} {where} {self.cells[after]}"

    def position(self, state: int) -> tuple[int, ...]:
        """Returns the cell on the map."""
        return self.cells[state]

    @property
    def scene(self) -> Scene:
        """The map; stretches with facts show the numbers of these facts."""
        items = [Item("dispatch", "D", (self.cells[-1],))]
        for kind in sorted(set(KINDS)):
            own = [
                (cell, kind[0] + name.split("_")[1])
                for name, (_, cells) in self.stretches.items()
                if name.startswith(kind)
                for cell in cells
            ]
            if own:
                cells, labels = zip(*own, strict=True)
                items.append(Item(f"{kind}_1, ...", kind[0], cells, labels))
        return Scene(*self.size, walls=self.walls, items=tuple(items))


def sentences(kind: str, way: str, cells: tuple[Any, ...], worth: float) -> tuple[str, str]:
    """Returns two sentences about a stretch: the truth, and the incorrect belief."""
    where = f"from {cells[0]} to {cells[-1]}"
    if kind == "wet":
        return (
            f"The floor {where} is dry; it costs the robot nothing extra.",
            f"The floor {where} is wet; each cell of it costs the robot {worth:g} more.",
        )
    if kind == "lane":
        return (
            f"The robot may drive {where} in both directions.",
            f"The lane {where} is one-way, {BACK[way]}; against it a cell costs {worth:g} more.",
        )
    return (
        f"The charging spots {where} are switched off.",
        f"The floor {where} charges the robot; each cell gives {worth:g} back.",
    )
