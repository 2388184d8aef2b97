"""The map and the robot's way on it as inline SVG: attributes only, no styles, no scripts."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import Any

from xplain.domains.base import Item, Scene, cell_name

CELL, RULER = 64, 26
"""Side of a cell, and width of the margin with the numbers of rows and columns, in SVG units."""
BADGE_LETTERS = 7
# Okabe and Ito's colours, which people with any colour vision can tell apart; every item also has
# a shape or a letter, and is named in the legend.
COLOURS = ("#0072B2", "#D55E00", "#00795A", "#A0447E", "#8A6500", "#5B21B6", "#5B5B5B", "#704214")
FLOOR, WALL, WAY, INK = "#FBFAF7", "#3B4252", "#1B5FA7", "#1F2933"


Path = Sequence[tuple[tuple[int, int], tuple[int, int]]]


def picture(plan: Any, path: Path | None, steps: int, gone: Sequence[str] = ()) -> str:
    """The map after the first ``steps`` transitions; "" where the domain has no map.

    Args:
        plan: with the map (``scene``), ``icons`` by the names of items, and words.
        path: [m] the robot's way, (cell before, cell after).
        steps: how much of the way is drawn; 0 shows the map alone.
        gone: names of items that are no longer on the map.
    """
    scene: Scene | None = plan.scene
    if scene is None or path is None:
        return ""
    words = plan.texts.words
    width, height = scene.columns * CELL, scene.rows * CELL
    where = words["map_step"].format(step=steps) if steps else words["map_alone"]
    here = path[steps - 1][1] if steps else path[0][0]
    items = [
        (cell, icon(plan.icons, item, index))
        for index, item in enumerate(scene.items)
        if item.name not in gone
        for cell in item.cells
    ]
    parts = [
        f'<svg class="map" viewBox="{-RULER} {-RULER} {width + RULER} {height + RULER}" role="img" '
        f'aria-label="{escape(where)}" aria-describedby="map-in-words">',
        f'<rect width="{width}" height="{height}" rx="6" fill="{FLOOR}"/>',
        *_rulers(scene),
        *_grid(scene),
        *(
            _cell(cell, f'<rect width="{CELL}" height="{CELL}" fill="{WALL}"/>')
            for cell in scene.walls
        ),
    ]
    parts += [_cell(cell, drawn) for cell, drawn in items]
    if steps:
        parts += _way(path[:steps])
    parts.append(_robot(here, aside=here in [cell for cell, _ in items]))
    if steps:
        parts += _badges(path[:steps])
    said = " ".join(_in_words(plan, path, steps, gone))
    return "".join([*parts, f'</svg><p class="unseen" id="map-in-words">{escape(said)}</p>'])


def _in_words(plan: Any, path: Path, steps: int, gone: Sequence[str]) -> Iterator[str]:
    """What :func:`picture` shows, in sentences."""
    scene, words = plan.scene, plan.texts.words
    yield words["map_size"].format(rows=scene.rows, columns=scene.columns)
    things = [(one.name, one.cells) for one in scene.items if one.name not in gone]
    for name, cells in [*things, (words["wall"], scene.walls)]:
        if cells:
            yield words["map_item"].format(name=name, cells=_listed(cells))
    if steps:
        way = [path[0][0], *(after for _, after in path[:steps])]
        yield words["map_way"].format(cells=_listed(way))
    here = path[steps - 1][1] if steps else path[0][0]
    yield words["map_robot"].format(cell=cell_name(*here))


def _listed(cells: Iterable[tuple[int, int]]) -> str:
    return ", ".join(cell_name(*cell) for cell in cells)


def legend(plan: Any, way: bool) -> list[tuple[str, str]]:
    """(name, small SVG) of everything on the map, and of the robot's way."""
    if plan.scene is None:
        return []
    words = plan.texts.words
    drawn = [
        (item.name, icon(plan.icons, item, index)) for index, item in enumerate(plan.scene.items)
    ]
    if plan.scene.walls:
        wall = f'<rect width="{CELL}" height="{CELL}" fill="{WALL}"/>'
        drawn.append((words["wall"], wall))
    if way:
        step = f'<path d="M6 32H58" stroke="{WAY}" stroke-width="6"/>{_badge("1")}'
        drawn.append((words["way"], step))
    return [
        (name, f'<svg class="key" viewBox="0 0 {CELL} {CELL}" aria-hidden="true">{svg}</svg>')
        for name, svg in drawn
    ]


def icon(icons: Mapping[str, str], item: Item, index: int) -> str:
    """A tile with the item's icon, or with its symbol where the configuration has no icon."""
    colour = COLOURS[index % len(COLOURS)]
    tile = (
        f'<rect x="4" y="4" width="{CELL - 8}" height="{CELL - 8}" rx="8" fill="{colour}" '
        f'fill-opacity="0.13" stroke="{colour}" stroke-width="1.5"/>'
    )
    if path := icons.get(item.name):
        return (
            f'{tile}<path transform="translate(31 29) scale(1.1)" d="{escape(path)}" fill="none" '
            f'stroke="{colour}" stroke-width="2" stroke-linecap="round" stroke-linejoin="round"/>'
        )
    return (
        f'{tile}<text x="44" y="50" text-anchor="middle" font-size="22" '
        f'font-weight="700" fill="{colour}">{escape(item.symbol)}</text>'
    )


def _rulers(scene: Scene) -> list[str]:
    """Numbers of the rows and letters of the columns, which the phrases of the steps refer to."""
    marks = [(-RULER / 2, (r + 0.5) * CELL + 6, f"{r + 1}") for r in range(scene.rows)]
    marks += [
        ((c + 0.5) * CELL, -RULER / 2 + 6, cell_name(0, c)[:-1]) for c in range(scene.columns)
    ]
    texts = [f'<text x="{x:g}" y="{y:g}">{mark}</text>' for x, y, mark in marks]
    return [f'<g font-size="17" fill="#4A5763" text-anchor="middle">{"".join(texts)}</g>']


def _grid(scene: Scene) -> list[str]:
    lines = [f'<path d="M{c * CELL} 0V{scene.rows * CELL}"/>' for c in range(1, scene.columns)] + [
        f'<path d="M0 {r * CELL}H{scene.columns * CELL}"/>' for r in range(1, scene.rows)
    ]
    return [f'<g stroke="#D9DCE1" stroke-width="1">{"".join(lines)}</g>']


def _cell(cell: tuple[int, int], content: str) -> str:
    return f'<g transform="translate({cell[1] * CELL} {cell[0] * CELL})">{content}</g>'


def _centre(cell: tuple[int, int]) -> tuple[float, float]:
    return (cell[1] + 0.5) * CELL, (cell[0] + 0.5) * CELL


def _way(path: Path) -> list[str]:
    """The old way thin, the newest step thick and dashed."""
    old = " ".join(f"{x:g},{y:g}" for x, y in (_centre(a) for a, _ in path))
    (x0, y0), (x1, y1) = _centre(path[-1][0]), _centre(path[-1][1])
    return [
        f'<polyline points="{old}" fill="none" stroke="{WAY}" stroke-width="4" '
        'stroke-opacity="0.45" stroke-linejoin="round" stroke-linecap="round"/>',
        f'<path d="M{x0:g} {y0:g}L{x1:g} {y1:g}" stroke="{WAY}" stroke-width="6" '
        'stroke-dasharray="2 9" stroke-linecap="round"/>',
        f'<circle cx="{_centre(path[0][0])[0]:g}" cy="{_centre(path[0][0])[1]:g}" r="6" '
        f'fill="#fff" stroke="{WAY}" stroke-width="3"/>',
    ]


def _badges(path: Path) -> list[str]:
    """The numbers of the steps where they ended, at the top of the cell, which has room for the
    last few; two dots stand for those before."""
    ended: dict[tuple[int, int], list[int]] = {}
    for number, (_, after) in enumerate(path, 1):
        ended.setdefault(after, []).append(number)
    parts = []
    for cell, numbers in ended.items():
        shown = [str(number) for number in numbers]
        text = "·".join(shown)
        while len(text) > BADGE_LETTERS:
            shown = shown[1:]
            text = "··" + "·".join(shown)
        parts.append(_cell(cell, _badge(text)))
    return parts


def _badge(text: str) -> str:
    width = 8 + 7.5 * len(text)
    return (
        f'<rect x="1" y="1" width="{width:g}" height="19" rx="6" fill="{WAY}"/>'
        f'<text x="{1 + width / 2:g}" y="15.5" text-anchor="middle" font-size="13" '
        f'font-weight="700" fill="#fff">{text}</text>'
    )


def _robot(cell: tuple[int, int], aside: bool) -> str:
    """A small robot's head, below the numbers; to the left where something else is in the cell."""
    left = -8 if aside else 8
    return _cell(
        cell,
        f'<g transform="translate({left} 24)" stroke="{INK}" stroke-width="2" '
        'stroke-linecap="round">'
        f'<path d="M24 12V7"/><circle cx="24" cy="6" r="2" fill="{INK}"/>'
        '<rect x="11" y="13" width="26" height="21" rx="6" fill="#FFD95A"/>'
        f'<circle cx="19" cy="22" r="2.4" fill="{INK}"/><circle cx="29" cy="22" r="2.4" '
        f'fill="{INK}"/><path d="M19 29H29" fill="none"/></g>',
    )
