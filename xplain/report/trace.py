"""The picture of one explanation, drawn from a run's files alone: the map with the path, the labels
step by step, the belief, and what the robot says."""

from __future__ import annotations

import itertools
import json
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from xplain.report.table import counted

ITEM_COLOURS = (*COLOURS[:6], "#F0E442", "#777777")
CELL = 0.46
"""Inches of a cell of a large map: one of more rows or columns than LARGE."""
LARGE = 11
LONG = 30
"""Letters of an item's name, from which on the legend has one column."""
LISTED = 14
"""Sentences and questions below the steps, at most."""
LETTERS = 92
"""Letters of a line below the steps."""
LINE, LETTER = 0.18, 0.082
"""Inches of such a line, and of a letter in the name of a transition."""
TYPES = 8
"""Learned types in the plot of the belief, at most: the likeliest at the end."""
ASKED = "#7A3F8F"
EXPLICABLE, INEXPLICABLE = "#CFE8F5", "#F5C4A1"


@dataclass(frozen=True)
class Story:
    """One episode.

    Attributes:
        solver: who explains.
        trace: its number.
        user_type: the true type of the user.
        cost: of the episode.
        phrases: the m transitions in words.
        positions: m + 1 cells, or none.
        messages: names of the new messages before each step.
        labels: row k the k + 1 labels given at step k.
        changes: what each transition changes, or none.
        questions: (what was asked about, the reply) of each question before each step; or none.
        beliefs: m + 1 rows of probabilities of the learned types: the prior, then after each step;
            or none.
    """

    solver: str
    trace: int
    user_type: str
    cost: float
    phrases: tuple[str, ...]
    positions: tuple[tuple[int, int], ...]
    messages: tuple[tuple[str, ...], ...]
    labels: tuple[tuple[int, ...], ...]
    changes: tuple[tuple[str, ...], ...] = ()
    questions: tuple[tuple[tuple[str, str], ...], ...] = ()
    beliefs: tuple[tuple[float, ...], ...] = ()

    @property
    def n_messages(self) -> int:
        """Number of messages given over all steps."""
        return sum(map(len, self.messages))

    @property
    def n_inexplicable(self) -> int:
        """Number of labels 0 over all steps."""
        return sum(row.count(0) for row in self.labels)


def stories(folder: Path, solver: str) -> Iterator[Story]:
    """The episodes of a run's folder, of one solver ("solver", "oracle" or "clairvoyant")."""
    with (folder / EPISODES).open(encoding="utf-8") as file:
        for line in file:
            if f'"solver": "{solver}"' not in line:
                continue
            content = json.loads(line)
            steps = content["steps"]
            asked = [step["questions"] for step in steps if "questions" in step]
            yield Story(
                solver=content["solver"],
                trace=content["trace"],
                user_type=content["type"],
                cost=content["cost"],
                phrases=tuple(content["transitions"]),
                positions=tuple((row, column) for row, column in content["positions"]),
                messages=tuple(tuple(step["messages"]) for step in steps),
                labels=tuple(tuple(step["labels"]) for step in steps),
                changes=tuple(map(tuple, content.get("changes", ()))),
                questions=tuple(
                    tuple((one["about"] or one["text"], one["reply"]) for one in own)
                    for own in asked
                ),
                beliefs=(tuple(content["prior"]), *(tuple(step["belief"]) for step in steps)),
            )


def typical(found: Sequence[Story]) -> Story:
    """The first episode whose cost is the median of all (of an even number, the lower middle)."""
    median = median_low(story.cost for story in found)
    return next(story for story in found if math.isclose(story.cost, median, abs_tol=1e-9))


def describe_choice(story: Story, episodes: int) -> str:
    """Which of a run's episodes a :func:`typical` one is, and by what rule it was taken."""
    return (
        f"trace {story.trace}, user of type {story.user_type}: cost {story.cost:g}, the median of "
        f"{counted(episodes, 'episode')} (the first that costs this)"
    )


def draw_typical(folder: Path, results: Results) -> tuple[Figure, Story, str]:
    """The typical episode of a run's folder, drawn; and which it is, in words."""
    found = list(stories(folder, "solver"))
    story = typical(found)
    caption, types = describe_choice(story, len(found)), results.types
    alike = dict(zip(types.true, types.behave_alike, strict=True)).get(story.user_type)
    right = [n for n, m in zip(types.found, types.matched_true_type, strict=True) if m == alike]
    names = {name: f"{name} (the user's)" if name in right else name for name in types.found}
    figure = draw_trace(results.scene, story, caption, results.messages, [*names.values()])
    return figure, story, caption


@matplotlib.rc_context(STYLE)
def draw_trace(
    scene: Scene | None,
    story: Story,
    caption: str,
    sentences: Mapping[str, str],
    types: Sequence[str] = (),
) -> Figure:
    """Map and path at the left; at the right one row a transition, one column a step, the belief
    below, and below it what the robot says. Without a map, the text under each transition says what
    it changes.

    Args:
        scene: the map; None if there is none.
        story: the episode.
        caption: below the title.
        sentences: of the messages, by name.
        types: names of the learned types, of which the belief is shown.
    """
    m, said = len(story.phrases), said_in(story, sentences)
    has_map = scene is not None and len(story.positions) == m + 1
    below = [] if has_map else [textwrap.fill("; ".join(own), 64) for own in story.changes]
    row = 0.34 + 0.13 * max((text.count("\n") + 1 for text in below), default=0)
    has_belief = bool(types) and len(story.beliefs) == m + 1 and len(story.beliefs[0]) > 1
    map_width = max(5.2, CELL * scene.columns) if has_map and scene else 0.0
    map_height = map_width * scene.rows / scene.columns if has_map and scene else 0.0
    # Inches: each part has a place of its own, whatever words are in it.
    left = (
        map_width
        + 0.5
        + LETTER * (4 + max(map(len, (*story.phrases, *"\n".join(below).split("\n")))))
    )
    steps: dict[str, float] = {
        "left": left,
        "top": 0.9,
        "width": max(2.4, 0.34 * m),
        "height": row * m,
    }
    belief = {**steps, "top": 1.6 + row * m, "height": 1.1}
    bottom = 1.5 + row * m + 1.5 * has_belief
    high = max(bottom + LINE * (said.count("\n") + 2), map_height + 1.6)
    figure = Figure(figsize=(left + steps["width"] + 2.4, high))
    if has_map and scene:
        axes = _add_axes(figure, left=0.3, top=0.9, width=map_width, height=map_height)
        draw_map(axes, scene, story.positions)
        axes.set_title("What the robot does, step by step", loc="left", weight="bold")
    _draw_steps(_add_axes(figure, **steps), story, caption, below)
    if has_belief:
        _draw_belief(_add_axes(figure, **belief), story, types)
    wide = figure.get_figwidth()
    figure.text((map_width + 0.5) / wide, 1 - bottom / high, said, va="top", fontsize=9)
    return figure


def _add_axes(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes at a place in inches from the left and the top."""
    wide, high = figure.get_size_inches()
    return figure.add_axes((left / wide, 1 - (top + height) / high, width / wide, height / high))


def said_in(story: Story, sentences: Mapping[str, str]) -> str:
    """What the robot says and asks, with the steps before which it does, in lines."""
    found = []
    for k, new in enumerate(story.messages, 1):
        asked = story.questions[k - 1] if story.questions else ()
        found += [f"before step {k} it asks: “{what}” – {reply}" for what, reply in asked]
        found += [f"before step {k}: “{sentences.get(name, name)}” ({name})" for name in new]
    more = len(found) - LISTED
    found = ["The robot says:", *found[:LISTED]] if found else ["The robot says nothing."]
    found += [f"… and {more} more"] if more > 0 else []
    return "\n".join(textwrap.fill(one, LETTERS, subsequent_indent="    ") for one in found)


def draw_map(axes: Axes, scene: Scene, positions: tuple[tuple[int, int], ...]) -> None:
    """The grid, its items by letter, and the path with the number of each step."""
    for row, column in scene.walls:
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, color="#555555", linewidth=0))
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
    visits: dict[tuple[int, int], list[int]] = {}
    for step, cell in enumerate(positions):
        visits.setdefault(cell, []).append(step)
    for before, after in itertools.pairwise(positions):
        if before != after:
            axes.annotate("", xy=after[::-1], xytext=before[::-1], arrowprops=arrow)
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
    axes.spines[:].set_visible(True)
    if scene.items:
        columns = 1 if max(len(item.name) for item in scene.items) > LONG else 3
        axes.legend(loc="upper left", bbox_to_anchor=(0, -0.05), ncols=columns, fontsize=8)


def _draw_steps(axes: Axes, story: Story, caption: str, below: Sequence[str]) -> None:
    """The labels, with a mark at each step before which the robot says or asks something."""
    m = len(story.phrases)
    for k, row in enumerate(story.labels):
        for i, label in enumerate(row):
            colour = EXPLICABLE if label else INEXPLICABLE
            axes.add_patch(Rectangle((k + 0.54, i + 0.54), 0.92, 0.92, color=colour, linewidth=0))
            if not label:
                axes.text(k + 1, i + 1, "?", ha="center", va="center", weight="bold")
    for k, new in enumerate(story.messages):
        if new:
            axes.plot([k + 0.5, k + 0.5], [0.5, k + 1.5], color=COLOURS[1], lw=1.6)
            axes.plot(k + 0.5, 0.36, "v", color=COLOURS[1], markersize=7, clip_on=False)
    asked = [k for k, own in enumerate(story.questions) if own]
    axes.plot([k + 1 for k in asked], [0.36] * len(asked), "D", color=ASKED, ms=6, clip_on=False)
    axes.set(
        xlim=(0.5, m + 0.5),
        ylim=(m + 0.5, 0.5),
        xticks=range(1, m + 1),
        yticks=range(1, m + 1),
        yticklabels=[f"{i}. {phrase}" for i, phrase in enumerate(story.phrases, 1)],
        xlabel="step (at each, the user labels all transitions shown so far)",
    )
    axes.grid(visible=False)
    axes.tick_params(length=0)
    axes.plot([], [], "s", color=EXPLICABLE, markersize=9, label="explicable")
    axes.plot([], [], "s", color=INEXPLICABLE, markersize=9, label="inexplicable (?)")
    axes.plot([], [], "v", color=COLOURS[1], label="messages before the step")
    if asked:
        axes.plot([], [], "D", color=ASKED, label="question before the step")
    # From 8 steps on the triangle below the diagonal is free.
    place: dict[str, Any] = (
        {"loc": "lower left"} if m >= 8 else {"loc": "upper left", "bbox_to_anchor": (1.02, 1)}
    )
    axes.legend(fontsize=8.5, **place)
    for tick in axes.get_yticklabels() if below else ():
        tick.set_verticalalignment("bottom")
    place = {"transform": axes.get_yaxis_transform(), "ha": "right", "va": "top"}
    for i, text in enumerate(below, 1):
        axes.text(-0.012, i + 0.06, text, fontsize=7.5, color="#666666", **place)
    counts = [counted(sum(map(len, story.questions)), "question")] if asked else []
    counts.append(counted(story.n_messages, "message"))
    title = (
        f"What the robot says to a user of type {story.user_type}: {', '.join(counts)}; the user "
        f"gives {counted(story.n_inexplicable, 'inexplicable label')}"
    )
    # Both begin where the names of the transitions do.
    figure: Any = axes.figure
    wide, high = figure.get_size_inches()
    start = axes.get_position().x0 - LETTER * (2 + max(map(len, story.phrases))) / wide
    top = axes.get_position().y1
    figure.text(start, top + 0.45 / high, title, weight="bold", fontsize=10.5)
    figure.text(start, top + 0.22 / high, caption, fontsize=9, color="#666666")


def _draw_belief(axes: Axes, story: Story, types: Sequence[str]) -> None:
    """A line a learned type, from the prior to the last step."""
    last = story.beliefs[-1]
    shown = sorted(range(len(types)), key=lambda t: (-last[t], t))[:TYPES]
    for index, t in enumerate(sorted(shown)):
        style: dict[str, Any] = {
            "color": COLOURS[index % len(COLOURS)],
            "linestyle": STYLES[index % len(STYLES)],
        }
        line = [belief[t] for belief in story.beliefs]
        axes.plot([0.5, *range(1, len(line))], line, lw=1.6, label=f"type {types[t]}", **style)
    steps = len(story.phrases)
    axes.set(ylim=(-0.02, 1.02), ylabel="belief after it", xlim=(0.5, steps + 0.5))
    axes.set_xticks(range(1, steps + 1))
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.02, 1))
