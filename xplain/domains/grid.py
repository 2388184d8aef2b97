"""Grids from ASCII maps, for the grid domains: cells, walls, and moves that may slide to a side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import index
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Item, Parameter, Scene
from xplain.domains.mdp import find_reached
from xplain.errors import InputError, mapping, one_of, sentence

Cell = tuple[int, int]

MOVES: dict[str, Cell] = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
"""The moves as (rows, columns), in the order of the actions."""
SIDEWAYS = np.array([[2, 3], [2, 3], [0, 1], [0, 1]])
"""The two moves at right angles to each move: the directions to which a move may slide."""
WALL, FLOOR, START = "#", ".", "s"
MAP = "domain.map"
"""The map's configuration key, for errors."""


@dataclass(frozen=True)
class Grid:
    """A map. Its C free cells are numbered row by row.

    Attributes:
        shape: (rows, columns).
        cells: [C, 2] int64, (row, column) of each free cell.
        number: [rows, columns] int64, index of each cell; −1 for walls.
        where: cells of each symbol on the map.
    """

    shape: tuple[int, int]
    cells: NDArray[np.int64]
    number: NDArray[np.int64]
    where: Mapping[str, tuple[Cell, ...]]

    @classmethod
    def parse(cls, text: str, symbols: Mapping[str, str]) -> Grid:
        """Reads an ASCII map: ``#`` wall, ``.`` floor, ``s`` floor where traces may start.

        Args:
            text: one line for each row; blank lines around it are ignored.
            symbols: the other symbols of the map, and the meaning of each.

        Raises:
            InputError: no text, rows of unequal length, an unknown symbol, or walls only.
        """
        sentence(MAP, text, "an ASCII map, one line for each row")
        lines = [line.rstrip() for line in text.strip("\n").splitlines()]
        known = {WALL: "wall", FLOOR: "floor", START: "floor where traces start", **symbols}
        where: dict[str, list[Cell]] = {}
        for r, line in enumerate(lines):
            if len(line) != len(lines[0]):
                raise InputError(
                    MAP, line, f"row {r} has {len(line)} symbols, row 0 has {len(lines[0])}"
                )
            for c, symbol in enumerate(line):
                if symbol not in known:
                    legend = ", ".join(f"{s} {meaning}" for s, meaning in known.items())
                    raise InputError(
                        MAP, symbol, f"unknown symbol in row {r}, column {c}; known: {legend}"
                    )
                where.setdefault(symbol, []).append((r, c))
        wall = np.array([[symbol == WALL for symbol in line] for line in lines])
        if wall.all():
            raise InputError(MAP, text, "at least one cell that is not a wall")
        number = np.where(wall, -1, np.cumsum(~wall).reshape(wall.shape) - 1)
        return cls(wall.shape, np.argwhere(~wall), number, {s: tuple(c) for s, c in where.items()})

    def at(self, cell: Sequence[int], key: str) -> int:
        """Returns the index of a cell.

        Raises:
            InputError: the cell is outside the map, a wall, or not a pair of whole numbers.
        """
        allowed = f"(row, column) of a cell that is not a wall, from 0, in a map of {self.shape}"
        try:
            r, c = (index(x) for x in cell)
        except (TypeError, ValueError):
            raise InputError(key, cell, allowed) from None
        if not (0 <= r < self.shape[0] and 0 <= c < self.shape[1]) or self.number[r, c] < 0:
            raise InputError(key, tuple(cell), allowed)
        return int(self.number[r, c])

    def only(self, symbol: str, name: str) -> int:
        """Returns the index of the only cell with this symbol.

        Raises:
            InputError: no cell or more than one cell has this symbol.
        """
        found = self.where.get(symbol, ())
        if len(found) != 1:
            raise InputError(MAP, found, f"exactly one {name} ({symbol}) must be on the map")
        return self.at(found[0], MAP)

    @cached_property
    def neighbour(self) -> NDArray[np.int64]:
        """[C, 4] the cell at the end of each of the four moves from each cell. At a wall or the
        border the robot stays."""
        padded = np.pad(self.number, 1, constant_values=-1)
        r, c = self.cells.T + 1
        to = np.stack([padded[r + dr, c + dc] for dr, dc in MOVES.values()], axis=1)
        return np.where(to < 0, np.arange(len(self.cells))[:, None], to)

    def outcomes(self, slip: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Computes the possible results of each of the four moves from each cell.

        Args:
            slip: probability that the robot slides to a side instead, half of it for each side.

        Returns:
            The end cells [C, 4, K] and their probabilities [C, 4, K]. K, the number of results, is
            1 without slip and 3 with slip.
        """
        intended = self.neighbour[:, :, None]
        if slip == 0:
            return intended, np.ones(intended.shape)
        cells = np.concatenate([intended, self.neighbour[:, SIDEWAYS]], axis=2)
        return cells, np.broadcast_to([1 - slip, slip / 2, slip / 2], cells.shape).copy()

    def require_path(self, what: str, cell: int, goal_name: str, goal: int) -> None:
        """Checks that a cell has a path to the goal.

        Raises:
            InputError: there is no such path.
        """
        # Moves are reversible: cells that can be reached from the goal have a path to it.
        if not find_reached(np.array([goal]), len(self.cells), self.neighbour.__getitem__)[cell]:
            raise InputError(
                MAP, self.position(cell), f"no path from the {what} to the {goal_name}"
            )

    def starts(self) -> NDArray[np.int64]:
        """Returns the cells marked ``s``, or every floor cell if no cell is marked.

        Raises:
            InputError: the map has neither kind of cell.
        """
        marked = self.where.get(START) or self.where.get(FLOOR, ())
        if not marked:
            raise InputError(MAP, "no floor", "a floor cell (s or .) to start from")
        return np.array([self.number[cell] for cell in marked], dtype=np.int64)

    def position(self, cell: int) -> Cell:
        """Returns the (row, column) of a cell."""
        r, c = self.cells[cell]
        return int(r), int(c)

    def scene(self, items: Sequence[Item]) -> Scene:
        """Makes the map with these items, for pictures."""
        walls = self.where.get(WALL, ())
        return Scene(rows=self.shape[0], columns=self.shape[1], walls=walls, items=tuple(items))


def parameters_of(
    given: Mapping[str, Mapping[str, Any]], known: Sequence[str]
) -> tuple[Parameter, ...]:
    """Reads parameters from YAML, ``{name: {accurate, inaccurate, message, belief}}``.

    Raises:
        InputError: there is no parameter, an unknown one, a missing or unknown field, an empty
            message, or an inaccurate value equal to the accurate one.
    """
    if not isinstance(given, Mapping) or not given:
        raise InputError("domain.parameters", given, f"at least one of {', '.join(known)}")
    parameters = []
    for name, fields in given.items():
        key = f"domain.parameters.{name}"
        one_of("domain.parameters", name, known, "parameter")
        mapping(key, fields, "the fields accurate, inaccurate, message, belief")
        needed = {"accurate", "inaccurate", "message"}
        if missing := needed - fields.keys():
            raise InputError(key, dict(fields), f"lacks {', '.join(sorted(missing))}")
        for field in fields:
            one_of(key, field, sorted(needed | {"belief"}), "field")
        parameter = Parameter(name=name, **fields)
        sentence(f"{key}.message", parameter.message)
        if parameter.accurate == parameter.inaccurate:
            raise InputError(f"{key}.inaccurate", parameter.inaccurate, "differs from accurate")
        parameters.append(parameter)
    return tuple(parameters)
