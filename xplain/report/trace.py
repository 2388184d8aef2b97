"""The picture of one explanation, drawn from a run's files alone: the map with the path, the labels
at each step, the belief, and the robot's messages."""

import itertools
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median_low
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba, to_rgba_array
from matplotlib.figure import Figure

from xplain.domains.base import Scene
from xplain.experiment.results import EPISODES, Results
from xplain.report.plots import COLOURS, STYLE, series_style
from xplain.report.table import count_things

Story = Mapping[str, Any]
"""One episode: a line of ``episodes.jsonl`` (:func:`xplain.experiment.results.episode_lines`)."""

ITEM_COLOURS = (*COLOURS[:6], "#F0E442", "#777777")
LINE = 0.2
"""Height of a line of text, and width of two letters, in inches. A cell is two lines wide."""
AROUND = 14, 8
"""Lines for legends on the right, and for titles and the numbers of columns."""
TYPES = 8
"""Maximum number of learned types in the plot of the belief: the most likely types at the end."""
DARK, SAID, ASKED = "#222222", COLOURS[1], "#7A3F8F"
INEXPLICABLE, EXPLICABLE = "#F5C4A1", "#CFE8F5"
BESIDE: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1, 1)}
"""Place of a legend: on the right of its axes."""


def stories(folder: Path, solver: str) -> list[Story]:
    """Reads the episodes of one solver ("solver", "oracle" or "clairvoyant") in a run's folder."""
    lines = (folder / EPISODES).read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines if f'"solver": "{solver}"' in line]


def typical(found: Sequence[Story]) -> Story:
    """Returns the first episode with the median cost (for an even number, the lower middle)."""
    median = median_low(story["cost"] for story in found)
    return next(story for story in found if math.isclose(story["cost"], median, abs_tol=1e-9))


def describe_choice(story: Story, episodes: int) -> str:
    """Describes which of a run's episodes :func:`typical` chose, and by which rule."""
    return (
        f"trace {story['trace']}, user of type {story['type']}: cost {story['cost']:g}, the median "
        f"of {count_things(episodes, 'episode')} (the first with this cost)"
    )


def draw_typical(folder: Path, results: Results) -> tuple[Figure, Story, str]:
    """Draws the typical episode of a run's folder. Returns the figure, the episode, and a
    description."""
    found = stories(folder, "solver")
    story = typical(found)
    caption, types = describe_choice(story, len(found)), results.types
    alike = dict(zip(types.true, types.behave_alike, strict=True)).get(story["type"])
    right = [n for n, m in zip(types.found, types.matched_true_type, strict=True) if m == alike]
    names = [f"{name} (the user's)" if name in right else name for name in types.found]
    return draw_trace(results.scene, story, caption, results.messages, names), story, caption


@matplotlib.rc_context(STYLE)
def draw_trace(
    scene: Scene | None,
    story: Story,
    caption: str,
    sentences: Mapping[str, str],
    types: Sequence[str] = (),
) -> Figure:
    """Draws an episode. The map with the path is on the left. The labels are on the right, with a
    row for each transition and a column for each step. The belief is below the labels, and the
    robot's messages are at the bottom. Without a map, a row also names the effects of its
    transition.

    Args:
        scene: the map, or None.
        story: the episode.
        caption: text below the title.
        sentences: texts of the messages, by name.
        types: names of the learned types, in the order of the belief.
    """
    m, said = len(story["transitions"]), list_said(story, sentences)
    names = [f"{i}. {phrase}" for i, phrase in enumerate(story["transitions"], 1)]
    place = scene if len(story["positions"]) == m + 1 else None
    if place is None and (changes := story.get("changes")):
        lines = [textwrap.fill("; ".join(own)) for own in changes]
        names = ["\n".join(pair) for pair in zip(names, lines, strict=True)]
    words, widths = "\n".join(names).split("\n"), [2 * m]
    heights = [m * (2 + max(name.count("\n") for name in names))]
    if place is not None:
        widths.insert(
            0, 2 * place.columns + max((len(i.name) for i in place.items), default=0) // 2
        )
    if len(types) > 1:
        heights.append(8)
    parts: list[list[Any]] = [["map", "steps"], ["map", "belief"]]
    figure = Figure(layout="constrained")
    axes = figure.subplot_mosaic(
        [row[-len(widths) :] for row in parts[: len(heights)]],
        width_ratios=widths,
        height_ratios=heights,
    )
    tall = max(sum(heights), 2 * place.rows if place is not None else 0) + said.count("\n")
    wide = sum(widths) + max(map(len, words)) / 2
    figure.set_size_inches(LINE * (wide + AROUND[0]), LINE * (tall + AROUND[1]))
    if place is not None:
        draw_map(axes["map"], place, story["positions"])
    _draw_steps(axes["steps"], story, names)
    if len(types) > 1:
        axes["belief"].sharex(axes["steps"])
        _draw_belief(axes["belief"], story, types)
    axes["steps"].set_title(textwrap.fill(caption, 2 * (2 * m + AROUND[0])), weight="normal")
    figure.suptitle(textwrap.fill(_describe(story), int(2 * wide)), x=0, ha="left")
    figure.supxlabel(said, x=0, ha="left")
    figure.draw_without_rendering()  # the layout of a map follows from its size after a layout
    return figure


def _describe(story: Story) -> str:
    """Describes what the robot says, and to whom, in the picture's title."""
    steps = story["steps"]
    said = [count_things(sum(len(step["messages"]) for step in steps), "message")]
    if asked := sum(len(step.get("questions", ())) for step in steps):
        said.insert(0, count_things(asked, "question"))
    labels = count_things(sum(step["labels"].count(0) for step in steps), "inexplicable label")
    return f"What the robot says to a user of type {story['type']}: {', '.join(said)}; {labels}"


def list_said(story: Story, sentences: Mapping[str, str]) -> str:
    """Returns a text with a line for each of the robot's messages and questions, with its step."""
    found = []
    for k, step in enumerate(story["steps"], 1):
        found += [
            f"before step {k} it asks: “{one['about'] or one['text']}” – {one['reply']}"
            for one in step.get("questions", ())
        ]
        found += [f"before step {k}: “{sentences.get(n, n)}” ({n})" for n in step["messages"]]
    found = ["The robot says:", *found] if found else ["The robot says nothing."]
    return "\n".join(textwrap.fill(one, subsequent_indent="    ") for one in found)


def _draw_cells(
    axes: Axes, rows: int, columns: int, colours: Mapping[tuple[int, int], Any]
) -> None:
    """Draws a grid whose cell (row, column) is around the point (column, row). The first row is at
    the top. Cells without a colour are transparent."""
    found = to_rgba_array([colours.get(cell, "none") for cell in np.ndindex(rows, columns)])
    edges = [np.arange(count + 1) - 0.5 for count in (columns, rows)]
    axes.pcolormesh(*edges, found.reshape(rows, columns, -1), edgecolors="#DDDDDD")
    axes.invert_yaxis()
    axes.set(xticks=range(columns), yticks=range(rows))
    axes.grid(visible=False)
    axes.tick_params(length=0)


def draw_map(axes: Axes, scene: Scene, positions: Sequence[Sequence[int]]) -> None:
    """Draws the grid, its items by letter, and the path with the number of each step."""
    colours: dict[tuple[int, int], Any] = dict.fromkeys(scene.walls, "#555555")
    for item, colour in zip(scene.items, itertools.cycle(ITEM_COLOURS), strict=False):
        pale = to_rgba(colour, 0.25)
        colours |= dict.fromkeys(item.cells, pale)
        texts = item.labels or [item.symbol] * len(item.cells)
        for (row, column), text in zip(item.cells, texts, strict=True):
            axes.text(column - 0.42, row - 0.42, text, va="top", weight="bold", color=DARK)
        axes.plot([], [], "s", color=pale, label=f"{item.symbol}  {item.name}")
    # Rows and columns have the same numbers as in the phrases.
    _draw_cells(axes, scene.rows, scene.columns, colours)
    axes.set(aspect="equal", anchor="NW")
    axes.set_title("What the robot does, step by step")
    for before, after in itertools.pairwise(positions):
        if before != after:
            arrow = {"arrowstyle": "-|>", "color": DARK}
            axes.annotate("", xy=after[::-1], xytext=before[::-1], arrowprops=arrow)  # type: ignore[arg-type]
    axes.plot(*positions[0][::-1], "o", color=DARK)
    visits: dict[tuple[int, ...], list[str]] = {}
    for step, cell in enumerate(positions[1:], 1):
        visits.setdefault(tuple(cell), []).append(str(step))
    look: dict[str, Any] = {"ha": "right", "va": "bottom", "fontsize": "x-small", "color": DARK}
    for (row, column), steps in visits.items():
        axes.text(column + 0.44, row + 0.44, ",".join(steps), **look)
    if scene.items:
        axes.legend(**BESIDE)


def _draw_steps(axes: Axes, story: Story, names: Sequence[str]) -> None:
    """Draws the labels, with a mark at each step that has messages or questions."""
    m, steps = len(names), story["steps"]
    labels = {(i, k): own for k, step in enumerate(steps) for i, own in enumerate(step["labels"])}
    look = (INEXPLICABLE, EXPLICABLE)
    _draw_cells(axes, m, m, {cell: look[label] for cell, label in labels.items()})
    for row, column in (cell for cell, label in labels.items() if not label):
        axes.text(column, row, "?", ha="center", va="center", weight="bold")
    axes.set_xticks(range(m), map(str, range(1, m + 1)))
    axes.set_yticks(range(m), names)
    axes.set_xlabel("step (the user labels all transitions shown so far)", loc="left")
    said = np.array([k - 0.5 for k, step in enumerate(steps) if step["messages"]])
    axes.vlines(said, -0.5, said + 1, color=SAID)
    for colour, text in ((EXPLICABLE, "explicable"), (INEXPLICABLE, "inexplicable (?)")):
        axes.plot([], [], "s", color=colour, label=text)
    asked = [k for k, step in enumerate(steps) if step.get("questions")]
    above: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "clip_on": False}
    for mark, what, at, colour in (("v", "messages", said, SAID), ("D", "question", asked, ASKED)):
        if len(at):
            text = f"{what} before the step"
            axes.plot(at, np.ones(len(at)), mark, color=colour, label=text, **above)
    axes.legend(**BESIDE)


def _draw_belief(axes: Axes, story: Story, types: Sequence[str]) -> None:
    """Draws the belief in each learned type as a line, from the prior to the last step. Draws at
    most TYPES types: the most likely types at the end."""
    rows = [story["prior"], *(step["belief"] for step in story["steps"])]
    beliefs = pd.DataFrame(rows, columns=[*types])
    shown = beliefs[beliefs.iloc[-1].nlargest(TYPES).index]
    for index, (name, line) in enumerate(shown.items()):
        axes.plot([-0.5, *range(len(story["steps"]))], line, label=name, **series_style(index))
    axes.set(ylim=(-0.05, 1.05), ylabel="belief after the step")
    axes.legend(**BESIDE)
