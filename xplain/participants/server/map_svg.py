"""The map and the robot's way on it as inline SVG: attributes only, no styles, no scripts."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Protocol

from xplain.domains.base import Item, Scene

CELL, RULER = 48, 22
"""Side of a cell, and width of the margin with the numbers of rows and columns, in SVG units."""
# Okabe and Ito's colours, which people with any colour vision can tell apart; every item also has
# a shape or a letter, and is named in the legend.
COLOURS = ("#0072B2", "#D55E00", "#00795A", "#A0447E", "#8A6500", "#2F7EA8", "#5B5B5B", "#704214")
FLOOR, WALL, WAY, INK = "#FBFAF7", "#3B4252", "#1B5FA7", "#1F2933"


class Drawn(Protocol):
    """What is drawn: a map, or none, the robot's way on it, and icons by the names of items."""

    @property
    def scene(self) -> Scene | None: ...
    @property
    def path(self) -> tuple[tuple[tuple[int, int], tuple[int, int]], ...] | None: ...
    @property
    def icons(self) -> Mapping[str, str]: ...


def picture(plan: Drawn, steps: int) -> str:
    """The map after the first ``steps`` transitions; "" where the domain has no map.

    Args:
        plan: with scene and path.
        steps: how much of the way is drawn; 0 shows the map alone.
    """
    scene, path = plan.scene, plan.path
    if scene is None or path is None:
        return ""
    width, height = scene.columns * CELL, scene.rows * CELL
    where = "the map" if not steps else f"the map and the robot's way after step {steps}"
    parts = [
        f'<svg class="map" viewBox="{-RULER} {-RULER} {width + RULER} {height + RULER}" role="img" '
        f'aria-label="{escape(where)}; the list of steps says the same in words">',
        f'<rect width="{width}" height="{height}" rx="6" fill="{FLOOR}"/>',
        *_rulers(scene),
        *_grid(scene),
        *(
            _cell(cell, f'<rect width="{CELL}" height="{CELL}" fill="{WALL}"/>')
            for cell in scene.walls
        ),
    ]
    for index, item in enumerate(scene.items):
        parts += [_cell(cell, icon(plan, item, index)) for cell in item.cells]
    if steps:
        parts += _way(path[:steps])
    else:
        parts.append(_robot(path[0][0]))
    return "".join([*parts, "</svg>"])


def legend(plan: Drawn) -> list[tuple[str, str]]:
    """(name, small SVG) of everything on the map."""
    if plan.scene is None:
        return []
    return [
        (
            item.name,
            f'<svg class="key" viewBox="0 0 {CELL} {CELL}" aria-hidden="true">'
            f"{icon(plan, item, index)}</svg>",
        )
        for index, item in enumerate(plan.scene.items)
    ]


def icon(plan: Drawn, item: Item, index: int) -> str:
    """A tile with the item's icon, or with its symbol where the configuration has no icon."""
    colour = COLOURS[index % len(COLOURS)]
    tile = (
        f'<rect x="4" y="4" width="{CELL - 8}" height="{CELL - 8}" rx="8" fill="{colour}" '
        f'fill-opacity="0.13" stroke="{colour}" stroke-width="1.5"/>'
    )
    if path := plan.icons.get(item.name):
        return (
            f'{tile}<path transform="translate(12 12)" d="{escape(path)}" fill="none" '
            f'stroke="{colour}" stroke-width="2" stroke-linecap="round" stroke-linejoin="round"/>'
        )
    return (
        f'{tile}<text x="{CELL // 2}" y="{CELL // 2 + 7}" text-anchor="middle" font-size="20" '
        f'font-weight="700" fill="{colour}">{escape(item.symbol)}</text>'
    )


def _rulers(scene: Scene) -> list[str]:
    """Numbers of rows and columns, which the phrases of the steps refer to."""
    marks = [(-RULER / 2, (r + 0.5) * CELL + 5, r) for r in range(scene.rows)]
    marks += [((c + 0.5) * CELL, -RULER / 2 + 5, c) for c in range(scene.columns)]
    texts = [f'<text x="{x:g}" y="{y:g}">{number}</text>' for x, y, number in marks]
    return [f'<g font-size="14" fill="#5F6C7B" text-anchor="middle">{"".join(texts)}</g>']


def _grid(scene: Scene) -> list[str]:
    lines = [f'<path d="M{c * CELL} 0V{scene.rows * CELL}"/>' for c in range(1, scene.columns)] + [
        f'<path d="M0 {r * CELL}H{scene.columns * CELL}"/>' for r in range(1, scene.rows)
    ]
    return [f'<g stroke="#D9DCE1" stroke-width="1">{"".join(lines)}</g>']


def _cell(cell: tuple[int, int], content: str) -> str:
    return f'<g transform="translate({cell[1] * CELL} {cell[0] * CELL})">{content}</g>'


def _centre(cell: tuple[int, int]) -> tuple[float, float]:
    return (cell[1] + 0.5) * CELL, (cell[0] + 0.5) * CELL


def _way(path: tuple[tuple[tuple[int, int], tuple[int, int]], ...]) -> list[str]:
    """The old way thin, the newest step thick and dashed, the step numbers where they ended."""
    old = " ".join(f"{x:g},{y:g}" for x, y in (_centre(a) for a, _ in path))
    (x0, y0), (x1, y1) = _centre(path[-1][0]), _centre(path[-1][1])
    parts = [
        f'<polyline points="{old}" fill="none" stroke="{WAY}" stroke-width="4" '
        'stroke-opacity="0.45" stroke-linejoin="round" stroke-linecap="round"/>',
        f'<path d="M{x0:g} {y0:g}L{x1:g} {y1:g}" stroke="{WAY}" stroke-width="6" '
        'stroke-dasharray="2 9" stroke-linecap="round"/>',
        f'<circle cx="{_centre(path[0][0])[0]:g}" cy="{_centre(path[0][0])[1]:g}" r="6" '
        f'fill="#fff" stroke="{WAY}" stroke-width="3"/>',
        _robot(path[-1][1]),
    ]
    ended: dict[tuple[int, int], list[int]] = {}
    for number, (_, after) in enumerate(path, 1):
        ended.setdefault(after, []).append(number)
    for cell, numbers in ended.items():
        text = "·".join(str(number) for number in numbers)
        width = 9 + 8 * len(text)
        parts.append(
            _cell(
                cell,
                f'<rect x="1" y="1" width="{width}" height="17" rx="6" fill="{WAY}"/>'
                f'<text x="{1 + width / 2:g}" y="14" text-anchor="middle" font-size="12.5" '
                f'font-weight="700" fill="#fff">{text}</text>',
            )
        )
    return parts


def _robot(cell: tuple[int, int]) -> str:
    """A small robot's head."""
    return _cell(
        cell,
        f'<g stroke="{INK}" stroke-width="2" stroke-linecap="round">'
        f'<path d="M24 12V7"/><circle cx="24" cy="6" r="2" fill="{INK}"/>'
        '<rect x="11" y="13" width="26" height="21" rx="6" fill="#FFD95A"/>'
        f'<circle cx="19" cy="22" r="2.4" fill="{INK}"/><circle cx="29" cy="22" r="2.4" '
        f'fill="{INK}"/><path d="M19 29H29" fill="none"/></g>',
    )
