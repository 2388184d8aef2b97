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
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from xplain.domains.base import Scene
from xplain.experiment.results import EPISODES, Results
from xplain.report.plots import COLOURS, STYLE, STYLES
from xplain.report.table import count_things

Story = Mapping[str, Any]
"""One episode: a line of ``episodes.jsonl`` (:func:`xplain.experiment.results.episode_lines`)."""

ITEM_COLOURS = (*COLOURS[:6], "#F0E442", "#777777")
CELL = 0.46
"""Size of a cell in inches, on a map with more columns than LARGE."""
LARGE = 11
LONG = 30
"""Letters of an item's name above which the legend has one column."""
LETTERS = 92
"""Letters in a line below the steps."""
LINE, LETTER = 0.18, 0.082
"""Height of a line below the steps, and width of a letter in the name of a transition, in
inches."""
TYPES = 8
"""Maximum number of learned types in the plot of the belief: the most likely types at the end."""
ASKED = "#7A3F8F"
EXPLICABLE, INEXPLICABLE = "#CFE8F5", "#F5C4A1"


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
    shown, has_belief = ["steps"], len(types) > 1
    if scene is not None and len(story["positions"]) == m + 1:
        shown, width = ["map", "steps"], max(5.2, CELL * scene.columns)
        tall = width * scene.rows / scene.columns
    else:
        changes, width, tall = story.get("changes", ()), 0.0, 0.0
        lines = ["\n".join(textwrap.wrap("; ".join(own), 64)) for own in changes]
        names = ["\n".join(pair) for pair in zip(names, lines, strict=True)] if changes else names
    row = 0.21 + 0.13 * max(name.count("\n") + 1 for name in names)
    letters = max(len(line) for name in names for line in name.split("\n"))
    wide = max(2.4, 0.34 * m)
    high = max(tall + 1, row * m + 1.6 + 1.7 * has_belief) + LINE * (said.count("\n") + 2)
    figure = Figure((width + LETTER * letters + wide + 2.8, high), layout="constrained")
    rows: list[Any] = [shown, [*shown[:-1], "belief"]] if has_belief else [shown]
    ratios = [row * m + 1.2, 1.7][: len(rows)]
    widths = [width, wide][-len(shown) :]
    parts = figure.subplot_mosaic(rows, width_ratios=widths, height_ratios=ratios)
    if scene is not None and "map" in parts:
        draw_map(parts["map"], scene, story["positions"])
        parts["map"].set_title("What the robot does, step by step", loc="left", weight="bold")
    _draw_steps(parts["steps"], story, names, caption)
    if has_belief:
        _draw_belief(parts["belief"], story, types)
    figure.supxlabel(said, x=0.01, ha="left", fontsize=9)
    return figure


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
    return "\n".join(textwrap.fill(one, LETTERS, subsequent_indent="    ") for one in found)


def draw_map(axes: Axes, scene: Scene, positions: Sequence[Sequence[int]]) -> None:
    """Draws the grid, its items by letter, and the path with the number of each step."""
    for row, column in scene.walls:
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, color="#555555"))
    size = 9.0 if scene.columns <= LARGE else 6.5
    for index, item in enumerate(scene.items):
        colour = ITEM_COLOURS[index % len(ITEM_COLOURS)]
        texts = item.labels or [item.symbol] * len(item.cells)
        for (row, column), text in zip(item.cells, texts, strict=True):
            place: dict[str, Any] = {"xy": (column - 0.5, row - 0.5), "width": 1, "height": 1}
            axes.add_patch(Rectangle(**place, color=colour, alpha=0.25, linewidth=0))
            axes.text(column - 0.42, row - 0.2, text, fontsize=size, weight="bold", color="#222222")
        axes.plot([], [], "s", color=colour, alpha=0.45, label=f"{item.symbol}  {item.name}")
    arrow = {"arrowstyle": "-|>", "color": "#222222", "shrinkA": 5, "shrinkB": 5}
    visits: dict[tuple[int, ...], list[int]] = {}
    for step, cell in enumerate(positions):
        visits.setdefault(tuple(cell), []).append(step)
    for before, after in itertools.pairwise(positions):
        if before != after:
            axes.annotate("", xy=after[::-1], xytext=before[::-1], arrowprops=arrow)  # type: ignore[arg-type]
    axes.plot(*positions[0][::-1], "o", color="#222222", markersize=7)
    for (row, column), steps in visits.items():
        numbers = ",".join(str(step) for step in steps if step > 0)
        axes.text(column + 0.44, row + 0.4, numbers, ha="right", fontsize=7, color="#222222")
    # Rows and columns have the same numbers as in the phrases; lines are between cells.
    axes.set(
        xlim=(-0.5, scene.columns - 0.5),
        ylim=(scene.rows - 0.5, -0.5),
        aspect="equal",
        anchor="NW",
        xticks=range(scene.columns),
        yticks=range(scene.rows),
    )
    axes.set_xticks([column - 0.5 for column in range(1, scene.columns)], minor=True)
    axes.set_yticks([row - 0.5 for row in range(1, scene.rows)], minor=True)
    axes.grid(visible=False, which="major")
    axes.grid(visible=True, which="minor", alpha=0.25)
    axes.tick_params(which="both", length=0, labelsize=8, labelcolor="#666666")
    axes.spines[:].set_visible(True)
    if scene.items:
        columns = 1 if max(len(item.name) for item in scene.items) > LONG else 3
        axes.legend(
            loc="upper left",
            bbox_to_anchor=(0, 0),
            borderaxespad=2,  # below the numbers of the columns
            ncols=columns,
            fontsize=8,
        )


def _draw_steps(axes: Axes, story: Story, names: Sequence[str], caption: str) -> None:
    """Draws the labels, with a mark at each step that has messages or questions."""
    m, steps = len(names), story["steps"]
    for k, step in enumerate(steps):
        for i, label in enumerate(step["labels"]):
            colour = EXPLICABLE if label else INEXPLICABLE
            axes.add_patch(Rectangle((k + 0.54, i + 0.54), 0.92, 0.92, color=colour))
            if not label:
                axes.text(k + 1, i + 1, "?", ha="center", va="center", weight="bold")
        if step["messages"]:
            axes.plot([k + 0.5, k + 0.5], [0.5, k + 1.5], color=COLOURS[1], lw=1.6)
            axes.plot(k + 0.5, 0.36, "v", color=COLOURS[1], markersize=7, clip_on=False)
        if step.get("questions"):
            axes.plot(k + 1, 0.36, "D", color=ASKED, ms=6, clip_on=False)
    axes.set(xlim=(0.5, m + 0.5), ylim=(m + 0.5, 0.5), xticks=range(1, m + 1))
    axes.set_yticks(range(1, m + 1), names)
    axes.set_xlabel("step (at each, the user labels all transitions shown so far)")
    axes.grid(visible=False)
    axes.tick_params(length=0)
    counts = {
        "question": sum(len(step.get("questions", ())) for step in steps),
        "message": sum(len(step["messages"]) for step in steps),
        "inexplicable label": sum(step["labels"].count(0) for step in steps),
    }
    marks = [
        ("s", EXPLICABLE, "explicable"),
        ("s", INEXPLICABLE, "inexplicable (?)"),
        ("v", COLOURS[1], "messages before the step"),
        *([("D", ASKED, "question before the step")] if counts["question"] else []),
    ]
    for mark, colour, label in marks:
        axes.plot([], [], mark, color=colour, markersize=8, label=label)
    axes.legend(fontsize=8.5, loc="upper left", bbox_to_anchor=(1.02, 1))
    *said, labels = (count_things(n, what) for what, n in counts.items() if n or what != "question")
    title = f"What the robot says to a user of type {story['type']}: {', '.join(said)}; {labels}"
    axes.annotate(title, (0, 1), (0, 24), textcoords="offset points", weight="bold", **CORNER)
    axes.annotate(caption, (0, 1), (0, 10), textcoords="offset points", color="#666666", **CORNER)


CORNER: dict[str, Any] = {"xycoords": "axes fraction", "fontsize": 9.5, "annotation_clip": False}


def _draw_belief(axes: Axes, story: Story, types: Sequence[str]) -> None:
    """Draws the belief in each learned type as a line, from the prior to the last step. Draws at
    most TYPES types: the most likely types at the end."""
    beliefs = [story["prior"], *(step["belief"] for step in story["steps"])]
    shown = sorted(range(len(types)), key=lambda t: (-beliefs[-1][t], t))[:TYPES]
    for index, t in enumerate(sorted(shown)):
        colour, style = COLOURS[index % len(COLOURS)], STYLES[index % len(STYLES)]
        line, at = [belief[t] for belief in beliefs], [0.5, *range(1, len(beliefs))]
        axes.plot(at, line, color=colour, ls=style, lw=1.6, label=types[t])
    axes.set(ylim=(-0.02, 1.02), ylabel="belief after the step", xlim=(0.5, len(beliefs) - 0.5))
    axes.set_xticks(range(1, len(beliefs)))
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1))
