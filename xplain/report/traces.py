"""The picture of one explanation: the map with the path, and step by step what was said and
answered."""

from __future__ import annotations

import itertools
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from xplain.domains.base import Scene
from xplain.evaluation.results import Record
from xplain.experiment import Case, Prepared
from xplain.message_sets import names_of
from xplain.report.plots import COLOURS, save

EXPLICABLE, INEXPLICABLE = "#CFE8F5", "#F5C4A1"


def draw_trace(prepared: Prepared, record: Record) -> Figure:
    """Map and path at the left; at the right one row a transition, one column a step."""
    case = prepared.cases[record.trace]
    m = len(case.transitions)
    has_map = prepared.scene is not None and len(case.positions) == m + 1
    height = max(4.2, 0.32 * m + 2.6)
    figure, axes = plt.subplots(
        1,
        2 if has_map else 1,
        figsize=((5.2 if has_map else 0) + 3.6 + 0.34 * m, height),
        width_ratios=[5.2, 3.6 + 0.34 * m] if has_map else [1],
        squeeze=False,
    )
    if has_map and prepared.scene is not None:
        draw_map(axes[0, 0], prepared.scene, case.positions)
        axes[0, 0].set_title("what the robot did", loc="left")
    _draw_steps(axes[0, -1], prepared, case, record)
    figure.tight_layout()
    return figure


def save_trace(path: Path, prepared: Prepared, record: Record) -> None:
    """Draws :func:`draw_trace` into a file."""
    save(draw_trace(prepared, record), path)


def draw_map(axes: Axes, scene: Scene, positions: tuple[tuple[int, int], ...]) -> None:
    """The grid, its items by letter, and the path with the number of each step."""
    for row, column in scene.walls:
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, color="#555555", linewidth=0))
    for index, item in enumerate(scene.items):
        colour = COLOURS[index % (len(COLOURS) - 1)]
        for row, column in item.cells:
            axes.add_patch(
                Rectangle((column - 0.5, row - 0.5), 1, 1, color=colour, alpha=0.25, linewidth=0)
            )
            axes.text(
                column - 0.42, row - 0.2, item.symbol, fontsize=9, weight="bold", color="#222222"
            )
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
    axes.set_xlim(-0.5, scene.columns - 0.5)
    axes.set_ylim(scene.rows - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xticks([column - 0.5 for column in range(1, scene.columns)], labels=[])
    axes.set_yticks([row - 0.5 for row in range(1, scene.rows)], labels=[])
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(True)
    if scene.items:
        axes.legend(
            loc="upper left", bbox_to_anchor=(0, -0.02), ncols=3, fontsize=8, handletextpad=0.3
        )


def _draw_steps(axes: Axes, prepared: Prepared, case: Case, record: Record) -> None:
    episode, m = record.episode, len(case.transitions)
    for k in range(m):
        for i in range(k + 1):
            explicable = episode.labels[k, i] == 1
            axes.add_patch(
                Rectangle(
                    (k + 0.54, i + 0.54),
                    0.92,
                    0.92,
                    color=EXPLICABLE if explicable else INEXPLICABLE,
                    linewidth=0,
                )
            )
            if not explicable:
                axes.text(k + 1, i + 1, "?", ha="center", va="center", weight="bold")
        new = names_of(int(episode.messages[k]), prepared.messages)
        if new:
            axes.text(
                k + 1,
                0.38,
                "message: " + ", ".join(new).replace("_", " "),
                rotation=40,
                ha="left",
                va="bottom",
                fontsize=9,
                color=COLOURS[1],
                weight="bold",
            )
            axes.plot(k + 1, 0.42, "v", color=COLOURS[1], markersize=6, clip_on=False)
    axes.set_xlim(0.5, m + 0.5)
    axes.set_ylim(m + 0.5, 0.5)
    axes.set_yticks(
        range(1, m + 1), labels=[f"{i}. {phrase}" for i, phrase in enumerate(case.phrases, 1)]
    )
    axes.set_xticks(range(1, m + 1))
    axes.set_xlabel("step of the explanation (the user labels all transitions shown so far)")
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.plot([], [], "s", color=EXPLICABLE, label="explicable")
    axes.plot([], [], marker="$?$", linestyle="none", color="#222222", label="inexplicable")
    axes.legend(loc="lower left", fontsize=8)
    wrong = prepared.types[record.user_type]
    axes.set_title(
        f"a user of type {wrong}: cost {episode.cost:g} = λ · {episode.communication:g} + "
        f"{episode.inexplicability:g}",
        loc="left",
        pad=14 + (52 if episode.n_messages else 0),
        fontsize=10,
    )
