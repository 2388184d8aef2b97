"""A warehouse with dozens of local facts: a robot drives along aisles between shelves to the
dispatch.

Aisles and cross-aisles meet at crossings. Between two neighbouring crossings is a stretch of two
cells. A fact that people may hold wrong is about one stretch: that its floor is wet, that it is
one-way, or that it charges the battery. Each cell costs the robot 1 and nothing else, so it takes
any shortest path, and people who hold nothing wrong about these paths find them all explicable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Item, Parameter, Scene, cell_name
from xplain.domains.grid import MOVES, WALL, Cell, Grid
from xplain.domains.mdp import MDP
from xplain.errors import Discount, Positive, Range, Slip, Whole, checks

BLOCK = 3
"""Cells from one crossing to the next."""
PATTERN = ("wet", "lane", "wet", "lane", "charger")
"""How often each kind occurs: charging spots matter from far away, the others nearby."""
SYMBOLS = {"wet": "≈", "right": "←", "down": "↑", "charger": "+"}
"""On the map; of a lane the way that some think it has, by the robot's."""
BACK = {"right": "left", "down": "up"}
"""Directions to the dispatch, and the opposite ones."""


@dataclass(frozen=True)
class Stretch:
    """The two cells between two crossings.

    Attributes:
        cells: its two cells, in the direction of the dispatch.
        way: the move in that direction.
        ends: names of its crossings.
    """

    cells: tuple[Cell, ...]
    way: str
    ends: tuple[str, str]

    def __str__(self) -> str:
        return f"between {self.ends[0]} and {self.ends[1]}"


@checks("domain")
class Warehouse:
    """The warehouse task. States are cells; the dispatch, the last crossing, ends the task.

    The map is the smallest (square, or one wider than high) with a stretch for every fact. The
    stretches with a fact, and the kinds of the facts, are drawn at random by ``layout``.

    Args:
        facts: number of facts that may be held wrong, 2 … 62.
        layout: seed of the draw.
        wet, against: what people think a cell of wet floor costs, and a cell of a lane in the wrong
            direction.
        charge: what they think a cell of a charging spot gives back, less than 1.
        discount: γ of the task.
        slip: probability that a move slides to a side.
        name: of the domain.

    Raises:
        InputError: a value is not allowed.
    """

    feature_names = ("row", "column")
    actions = tuple(MOVES)

    def __init__(
        self,
        facts: Annotated[int, Range(2, 62)],
        layout: Whole = 0,
        wet: Positive = 2.0,
        against: Positive = 2.0,
        charge: Annotated[float, Range(0, 1, "()")] = 0.6,
        discount: Discount = 0.95,
        slip: Slip = 0.0,
        name: str = "warehouse",
    ) -> None:
        """Lays out the map, and draws the facts."""
        self.name = name
        self.discount = discount
        high, wide = size_for(facts)
        self.grid = Grid.parse(_map(high, wide), {"D": "dispatch"})
        rng = np.random.default_rng(layout)
        stretches = _stretches(high, wide)
        chosen = sorted(rng.permutation(len(stretches))[:facts].tolist())
        kinds = rng.permutation(np.arange(facts) % len(PATTERN)).tolist()
        worth = {"wet": -wet, "lane": -against, "charger": charge}
        self.stretches: dict[str, Stretch] = {}
        parameters = []
        for s, kind in zip(chosen, (PATTERN[k] for k in kinds), strict=True):
            count = sum(known.startswith(kind) for known in self.stretches)
            name_of = f"{kind}_{count + 1}"
            self.stretches[name_of] = stretches[s]
            parameters.append(_parameter(name_of, kind, stretches[s], worth[kind]))
        self.parameters = tuple(parameters)
        self._successor, self._probability = self.grid.outcomes(slip)
        self.dispatch = self.grid.only("D", "dispatch")
        self.state_features = self.grid.cells.astype(np.float64)
        crossings = product(range(0, BLOCK * high, BLOCK), range(0, BLOCK * wide, BLOCK))
        cells = np.array([self.grid.number[cell] for cell in crossings], dtype=np.int64)
        self.starts: NDArray[np.int64] = cells[cells != self.dispatch]
        lane = f"that some think one-way ({against:g} a cell against it)"
        self._meaning = {
            "≈": f"wet_1, …: floor that some think wet ({wet:g} more a cell)",
            "←": f"lane_1, …: lane to the left {lane}",
            "↑": f"lane_1, …: lane up {lane}",
            "+": f"charger_1, …: spot that some think charges ({charge:g} back a cell)",
        }
        self._entered = {name: self._entering(name) for name in self.stretches}

    def _entering(self, name: str) -> NDArray[np.bool_]:
        """The outcomes [S, 4, K] that a fact is about: those that enter a cell of its stretch, for
        a lane only by the move towards the dispatch."""
        stretch = self.stretches[name]
        numbers = [int(self.grid.number[cell]) for cell in stretch.cells]
        stays = self._successor == np.arange(len(self.grid.cells))[:, None, None]
        entered: NDArray[np.bool_] = np.isin(self._successor, numbers) & ~stays
        if name.startswith("lane"):
            entered &= (np.arange(4) == self.actions.index(stretch.way))[None, :, None]
        return entered

    def model(self, values: Mapping[str, Any]) -> MDP:
        """The task of somebody who holds these values."""
        reward = np.full(self._successor.shape, -1.0)
        for name, entered in self._entered.items():
            if values[name]:
                reward[entered] += float(values[name])
        terminal = np.arange(len(self.grid.cells)) == self.dispatch
        return MDP(self._successor, self._probability, reward, self.discount, terminal)

    def position(self, state: int) -> Cell:
        """The robot's cell (row, column), from 0."""
        return self.grid.position(state)

    def describe(self, transition: NDArray[np.int64]) -> str:
        """A phrase for the transition [3], such as "drives right into lane_2 at (2, 3)"."""
        state, action, after = (int(x) for x in transition)
        move, cell = self.actions[action], self.position(after)
        if after == state:
            return f"tries to drive {move} and stays at {cell}"
        if after == self.dispatch:
            return f"drives {move} into the dispatch"
        for name, stretch in self.stretches.items():
            if cell in stretch.cells:
                return f"drives {move} on {name} at {cell}"
        return f"drives {move} to {cell}"

    @property
    def scene(self) -> Scene:
        """The map with the dispatch and the stretches that facts are about, with the numbers of the
        facts."""
        by_symbol: dict[str, list[str]] = {symbol: [] for symbol in SYMBOLS.values()}
        for name, stretch in self.stretches.items():
            kind = name.split("_")[0]
            by_symbol[SYMBOLS[stretch.way if kind == "lane" else kind]].append(name)
        items = [Item("dispatch", "D", (self.position(self.dispatch),))]
        for symbol, names in by_symbol.items():
            if names:
                cells = [(cell, name) for name in names for cell in self.stretches[name].cells]
                where, whose = zip(*cells, strict=True)
                labels = tuple(symbol + name.split("_")[1] for name in whose)
                items.append(Item(self._meaning[symbol], symbol, where, labels))
        return self.grid.scene(items)


def size_for(facts: int) -> tuple[int, int]:
    """Crossings (high, wide) of the smallest map with so many stretches."""
    high = wide = 2
    while high * (wide - 1) + (high - 1) * wide < facts:
        high, wide = (high, wide + 1) if wide == high else (high + 1, wide)
    return high, wide


def _map(high: int, wide: int) -> str:
    rows, columns = BLOCK * (high - 1) + 1, BLOCK * (wide - 1) + 1
    lines = [
        "".join("." if r % BLOCK == 0 or c % BLOCK == 0 else WALL for c in range(columns))
        for r in range(rows)
    ]
    lines[-1] = lines[-1][:-1] + "D"
    return "\n".join(lines)


def _stretches(high: int, wide: int) -> Sequence[Stretch]:
    """Stretches row by row; from each crossing first the one to the right, then the one down."""
    found = []
    for r, c in product(range(high), range(wide)):
        for way, dr, dc in (("right", 0, 1), ("down", 1, 0)):
            if r + dr < high and c + dc < wide:
                cells = tuple((BLOCK * r + i * dr, BLOCK * c + i * dc) for i in range(1, BLOCK))
                ends = cell_name(r, c), cell_name(r + dr, c + dc)
                found.append(Stretch(cells, way, ends))
    return found


def _parameter(name: str, kind: str, stretch: Stretch, worth: float) -> Parameter:
    """The robot's value is 0: what the fact says is not true."""
    cost = f"{abs(worth):g}"
    message, belief = {
        "wet": (
            f"The floor {stretch} is dry; it costs the robot nothing extra.",
            f"The floor {stretch} is wet; each cell of it costs the robot {cost} more.",
        ),
        "lane": (
            f"The robot may drive {stretch} in both directions.",
            f"The lane {stretch} is one-way, {BACK[stretch.way]}; driving against it costs the "
            f"robot {cost} a cell.",
        ),
        "charger": (
            f"The charging spots {stretch} are switched off.",
            f"The floor {stretch} charges the robot; each cell gives {cost} back.",
        ),
    }[kind]
    return Parameter(name, 0.0, worth, message, belief)
