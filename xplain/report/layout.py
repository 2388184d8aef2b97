"""Which swept key goes where: across a table or down, on an axis, a line or a panel of its own."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

from xplain.report.measure import is_choice
from xplain.report.summary import Summary

WIDEST = 8
"""Columns of a table, lines of a plot: more cannot be read."""


@dataclass(frozen=True)
class TableLayout:
    """Keys of a table.

    Attributes:
        down: one column of row headings each, the outermost first.
        across: at most two; none where nothing that was swept can be better or worse: then the
            measures are the columns.
    """

    down: tuple[str, ...]
    across: tuple[str, ...]


@dataclass(frozen=True)
class PlotLayout:
    """Keys of a plot.

    Attributes:
        x: on the horizontal axis; None where nothing was swept.
        numeric: whether its values are numbers, in the sense of an axis.
        lines: a line a combination of these.
        panels: a small plot a combination of these.
    """

    x: str | None
    numeric: bool
    lines: tuple[str, ...]
    panels: tuple[str, ...]


def shown_keys(summary: Summary) -> tuple[str, ...]:
    """The dimensions of tables and plots: the swept keys but for those pooled, and for those
    whose value an earlier one decides."""
    keys = [key for key in summary.keys if len(summary.values(key)) > 1]
    keys = [key for key in keys if key not in summary.pool]
    frame = summary.episodes
    return tuple(
        key
        for i, key in enumerate(keys)
        if not any(frame.groupby(before)[key].nunique().max() == 1 for before in keys[:i])
    )


def table_layout(summary: Summary) -> TableLayout:
    """Ways to solve the problem go across, where they can be compared; the problems down."""
    keys = shown_keys(summary)
    choices = sorted((key for key in keys if is_choice(key)), key=lambda key: key != "solver")
    across: list[str] = []
    for key in choices:
        if len(across) < 2 and prod(_count(summary, k) for k in (*across, key)) <= WIDEST:
            across.append(key)
    down = [key for key in keys if key not in across]
    # The main key changes from row to row; what it is seen under stands still.
    main = _main(summary, down)
    return TableLayout((*(k for k in down if k != main), *([main] if main else [])), tuple(across))


def plot_layout(summary: Summary) -> PlotLayout:
    """The main key on the axis; a line a solver or other choice; a panel a value of what is
    left."""
    keys = shown_keys(summary)
    x = _main(summary, keys)
    numeric = x is not None
    if x is None and keys:
        x = min(keys, key=lambda key: (is_choice(key), -_count(summary, key)))
    rest = [key for key in keys if key != x]
    rest.sort(key=lambda key: (not is_choice(key), key != "solver"))
    lines: list[str] = []
    for key in rest:
        allowed = is_choice(key) or not lines
        if allowed and prod(_count(summary, k) for k in (*lines, key)) <= WIDEST:
            if key == "domain" and not is_choice(key):
                continue  # tasks differ in scale: a panel each
            lines.append(key)
    panels = [key for key in keys if key != x and key not in lines]
    return PlotLayout(x, numeric, tuple(lines), tuple(panels))


def _main(summary: Summary, keys: tuple[str, ...] | list[str]) -> str | None:
    """The key of numbers with most values, λ before others; None where there is none."""
    numbers = [key for key in keys if summary.is_number(key)]
    return max(numbers, key=lambda key: (_count(summary, key), key == "lambda"), default=None)


def _count(summary: Summary, key: str) -> int:
    return len(summary.values(key))
