"""The picture of one explanation: the map with the path, and step by step what was said and
answered. Drawn from a run's files alone."""

from __future__ import annotations

import itertools
import textwrap
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from xplain.domains.base import Scene
from xplain.report.plots import COLOURS, STYLE
from xplain.report.story import Story, counted, stories, typical, which

ITEM_COLOURS = (*COLOURS[:6], "#F0E442", "#777777")
CELL = 0.46
"""Inches of a cell of a large map: one of more rows or columns than LARGE."""
LARGE = 11
LONG = 30
"""Letters of an item's name, from which on the legend has one column."""
ASKED = "#7A3F8F"
LISTED = 6
"""Questions told in words below the steps."""
EXPLICABLE, INEXPLICABLE = "#CFE8F5", "#F5C4A1"


@matplotlib.rc_context(STYLE)
def draw_trace(scene: Scene | None, story: Story, caption: str) -> Figure:
    """Map and path at the left; at the right one row a transition, one column a step. Without a
    map, what each transition changes is told below it. The caption is above the steps."""
    m = len(story.phrases)
    if scene is None or len(story.positions) != m + 1:
        below = [textwrap.fill("; ".join(changes), 64) for changes in story.changes]
        row = 0.34 + 0.13 * max((text.count("\n") + 1 for text in below), default=0)
        figure = Figure(figsize=(4.6 + 0.34 * m, max(3.4, row * m + 2.6)))
        axes = figure.subplots()
        _draw_steps(axes, story, caption)
        _draw_changes(axes, below)
        return figure
    # Long phrases at the right must not make the map small: each half is laid out by itself.
    widths = [max(5.2, CELL * scene.columns), max(6.6, 3.6 + 0.34 * m)]
    high = CELL * scene.rows + 1.6 if scene.rows > LARGE else 0.0
    figure = Figure(figsize=(sum(widths), max(5.4, 0.34 * m + 2.6, high)), layout="constrained")
    halves = figure.subfigures(1, 2, width_ratios=widths, squeeze=False)
    left, right = (half.subplots() for half in halves[0])
    draw_map(left, scene, story.positions)
    left.set_title("What the robot did, step by step", loc="left", weight="bold")
    left.set_anchor("N")
    _draw_steps(right, story, caption)
    return figure


def draw_typical(folder: Path, scene: Scene | None) -> tuple[Figure, Story, str]:
    """The typical episode of a run's folder, drawn; and which it is, in words."""
    found = list(stories(folder, "solver"))
    story = typical(found)
    caption = which(story, len(found))
    return draw_trace(scene, story, caption), story, caption


def draw_map(axes: Axes, scene: Scene, positions: tuple[tuple[int, int], ...]) -> None:
    """The grid, its items by letter, and the path with the number of each step."""
    for row, column in scene.walls:
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, color="#555555", linewidth=0))
    size = 9.0 if scene.columns <= LARGE else 6.5
    for index, item in enumerate(scene.items):
        colour = ITEM_COLOURS[index % len(ITEM_COLOURS)]
        for (row, column), text in zip(
            item.cells, item.labels or [item.symbol] * len(item.cells), strict=True
        ):
            axes.add_patch(
                Rectangle((column - 0.5, row - 0.5), 1, 1, color=colour, alpha=0.25, linewidth=0)
            )
            axes.text(column - 0.42, row - 0.2, text, fontsize=size, weight="bold", color="#222222")
        axes.plot([], [], "s", color=colour, alpha=0.45, label=f"{item.symbol}  {item.name}")
    visits: dict[tuple[int, int], list[int]] = {}
    for step, cell in enumerate(positions):
        visits.setdefault(cell, []).append(step)
    for before, after in itertools.pairwise(positions):
        if before != after:
            axes.annotate(
                "",
                xy=(after[1], after[0]),
                xytext=(before[1], before[0]),
                arrowprops={"arrowstyle": "-|>", "color": "#222222", "shrinkA": 5, "shrinkB": 5},
            )
    start = positions[0]
    axes.plot(start[1], start[0], "o", color="#222222", markersize=7)
    for (row, column), steps in visits.items():
        numbers = ",".join(str(step) for step in steps if step > 0)
        axes.text(column + 0.44, row + 0.4, numbers, ha="right", fontsize=7, color="#222222")
    # Rows and columns are numbered as in the phrases; lines between cells.
    axes.set(
        xlim=(-0.5, scene.columns - 0.5),
        ylim=(scene.rows - 0.5, -0.5),
        aspect="equal",
        xticks=range(scene.columns),
        yticks=range(scene.rows),
    )
    axes.set_xticks([column - 0.5 for column in range(1, scene.columns)], minor=True)
    axes.set_yticks([row - 0.5 for row in range(1, scene.rows)], minor=True)
    axes.grid(visible=False, which="major")
    axes.grid(visible=True, which="minor", alpha=0.25)
    axes.tick_params(which="both", length=0, labelsize=8, labelcolor="#666666")
    for spine in axes.spines.values():
        spine.set_visible(True)
    if scene.items:
        long = max(len(item.name) for item in scene.items) > LONG
        axes.legend(
            loc="upper left",
            bbox_to_anchor=(0, -0.05),
            ncols=1 if long else 3,
            fontsize=8,
            handletextpad=0.3,
        )


def _draw_steps(axes: Axes, story: Story, caption: str) -> None:
    m = len(story.phrases)
    for k, row in enumerate(story.labels):
        for i, label in enumerate(row):
            colour = EXPLICABLE if label else INEXPLICABLE
            axes.add_patch(Rectangle((k + 0.54, i + 0.54), 0.92, 0.92, color=colour, linewidth=0))
            if not label:
                axes.text(k + 1, i + 1, "?", ha="center", va="center", weight="bold")
    for k, new in enumerate(story.messages):
        if not new:
            continue
        axes.plot([k + 0.5, k + 0.5], [0.5, k + 1.5], color=COLOURS[1], lw=1.6)
        axes.text(
            k + 0.45,
            0.28,
            " + ".join(new).replace("_", " "),
            rotation=35,
            ha="left",
            va="bottom",
            fontsize=9,
            color=COLOURS[1],
            weight="bold",
        )
        axes.plot(k + 0.5, 0.36, "v", color=COLOURS[1], markersize=7, clip_on=False)
    told = _draw_questions(axes, story)
    axes.set(
        xlim=(0.5, m + 0.5),
        ylim=(m + 0.5, 0.5),
        xticks=range(1, m + 1),
        yticks=range(1, m + 1),
        yticklabels=[f"{i}. {phrase}" for i, phrase in enumerate(story.phrases, 1)],
        xlabel="\n".join(["step (at each, the user labels all transitions shown so far)", *told]),
    )
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.plot([], [], "s", color=EXPLICABLE, markersize=9, label="explicable")
    axes.plot([], [], "s", color=INEXPLICABLE, markersize=9, label="inexplicable (?)")
    axes.plot([], [], "v", color=COLOURS[1], label="message given before the step")
    if told:
        axes.plot([], [], "D", color=ASKED, label="question asked before the step")
    if m >= 8:  # the triangle below the diagonal is free
        axes.legend(loc="lower left", fontsize=9)
    else:
        below = -0.3 - 0.05 * len(told)
        axes.legend(loc="upper left", bbox_to_anchor=(0, below), ncols=2 + (not told), fontsize=8)
    _draw_title(axes, story, caption)


def _draw_title(axes: Axes, story: Story, caption: str) -> None:
    """Above the names of the messages, which stand upright."""
    longest = max((len(" + ".join(new)) for new in story.messages), default=0)
    title = axes.set_title(
        f"What a user of type {story.user_type} said: "
        + (f"{counted(story.n_questions, 'question')}, " if story.n_questions else "")
        + f"{counted(story.n_messages, 'message')}, "
        f"{counted(story.n_inexplicable, 'inexplicable label')}",
        loc="left",
        pad=14 + (18 + 3.2 * longest if story.n_messages else 0),
        weight="bold",
    )
    axes.annotate(
        caption,
        (0, 1),
        (0, 5),
        xycoords=title,
        textcoords="offset points",
        fontsize=9,
        color="#666666",
        annotation_clip=False,
    )


def _draw_questions(axes: Axes, story: Story) -> list[str]:
    """A mark where something was asked; returns what and the replies, in lines."""
    lines = []
    for k, asked in enumerate(story.questions):
        if asked:
            axes.plot(k + 1, 0.36, "D", color=ASKED, markersize=6, clip_on=False)
            if len(asked) > 1:
                axes.text(k + 1.2, 0.36, str(len(asked)), color=ASKED, fontsize=9, va="center")
        lines += [f"asked before step {k + 1}: “{what}”? {reply}" for what, reply in asked]
    more = len(lines) - LISTED
    return lines[:LISTED] + ([f"… and {counted(more, 'question')} more"] if more > 0 else [])


def _draw_changes(axes: Axes, told: list[str]) -> None:
    """Below each transition's phrase."""
    if not told:
        return
    for label in axes.get_yticklabels():
        label.set_verticalalignment("bottom")
    for i, text in enumerate(told, 1):
        axes.text(
            -0.012,
            i + 0.06,
            text,
            transform=axes.get_yaxis_transform(),
            ha="right",
            va="top",
            fontsize=7.5,
            color="#666666",
        )
