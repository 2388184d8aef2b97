"""The map and the robot's way as inline SVG. The drawings are in ``templates/map.svg``."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from xplain.domains.base import Item, cell_name

BADGE_LETTERS = 7
# Okabe and Ito's colours, which suit any colour vision. Every item also has
# a shape or a letter, and its name is in the legend.
COLOURS = ("#0072B2", "#D55E00", "#00795A", "#A0447E", "#8A6500", "#5B21B6", "#5B5B5B", "#704214")

Cell = tuple[int, int]
Path = Sequence[tuple[Cell, Cell]]


def _list_cells(cells: Iterable[Cell]) -> str:
    return ", ".join(cell_name(*cell) for cell in cells)


_ENVIRONMENT = Environment(
    loader=PackageLoader("xplain.people"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
_ENVIRONMENT.globals |= {"cell_name": cell_name, "listed": _list_cells}
_DRAWN: Any = _ENVIRONMENT.get_template("map.svg").module


def picture(plan: Any, path: Path | None, steps: int, gone: Sequence[str] = ()) -> Markup:
    """Draws the map after the first ``steps`` transitions, with a text version for screen readers;
    "" if the domain has no map.

    Args:
        plan: has the map (``scene``), ``icons`` by the names of items, and words.
        path: [m] (cell before, cell after) of each transition of the robot.
        steps: number of transitions to draw; 0 shows the map alone.
        gone: names of items that are no longer on the map.
    """
    if plan.scene is None or path is None:
        return Markup()
    items = [drawn for drawn in _list_looks(plan) if drawn[0].name not in gone]
    made = path[:steps]
    been = [path[0][0], *(after for _, after in made)]
    aside = any(been[-1] in item.cells for item, _, _ in items)
    words = plan.texts.words
    return Markup(_DRAWN.map(plan.scene, items, made, been, aside, _make_badges(been[1:]), words))


def legend(plan: Any) -> list[tuple[str, Markup]]:
    """Lists (name, small SVG) pairs for everything on the map, and for the robot's way."""
    if plan.scene is None:
        return []
    words = plan.texts.words
    drawn = [(look[0].name, _DRAWN.tile(*look)) for look in _list_looks(plan)]
    if plan.scene.walls:
        drawn.append((words["wall"], _DRAWN.wall_tile()))
    drawn.append((words["way"], _DRAWN.way_key()))
    return [(name, _DRAWN.key(svg)) for name, svg in drawn]


def about(plan: Any, sentence: str) -> Markup:
    """Draws the item or icon whose name comes first in a sentence; "" if the sentence has no such
    name."""
    shown = _list_looks(plan) if plan.scene else []
    names = {look[0].name for look in shown}
    shown += [
        (Item(name, "", ()), plan.icons[name], "#3B4252") for name in plan.icons.keys() - names
    ]
    found = {
        at.start(): look
        for look in sorted(shown, key=lambda look: len(look[0].name))
        if (at := re.search(rf"\b{re.escape(look[0].name)}\b", sentence, re.IGNORECASE))
    }
    return Markup(_DRAWN.key(_DRAWN.tile(*found[min(found)]))) if found else Markup()


def _list_looks(plan: Any) -> list[tuple[Item, str | None, str]]:
    """Lists (item, icon, colour) for each item of the map. The icon is None if the configuration
    has no icon for the item."""
    return [
        (item, plan.icons.get(item.name), COLOURS[index % len(COLOURS)])
        for index, item in enumerate(plan.scene.items)
    ]


def _make_badges(ended: Sequence[Cell]) -> list[tuple[Cell, str]]:
    """Makes a text for each cell in which steps ended, with the numbers of these steps. If a text
    is too long for the cell, two dots replace its first numbers.

    Args:
        ended: the cell in which each step ended.

    Returns:
        Pairs (cell, text).
    """
    texts = {
        cell: "·".join(str(number) for number, one in enumerate(ended, 1) if one == cell)
        for cell in dict.fromkeys(ended)
    }
    return [
        (
            cell,
            text
            if len(text) <= BADGE_LETTERS
            else f"··{text[1 - BADGE_LETTERS :].partition('·')[2]}",
        )
        for cell, text in texts.items()
    ]
