"""Prints and draws the analysis: ``python -m xplain study analyse folder``."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.errors import InputError
from xplain.people.study.statistics import hedges
from xplain.people.study.table2 import (
    CONDITIONS,
    MEASURES,
    Analysis,
    Row,
    paper_effect,
    table,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.console import Console

COLOURS = {"conformant": "#D55E00", "personalized": "#0072B2", "asking": "#00795A"}
MARKS = {"conformant": "s", "personalized": "o", "asking": "^"}


def exclusions(path: Path | None) -> dict[str, str]:
    """{participant: reason} of a CSV with these two columns.

    Raises:
        InputError: no such file, or other columns.
    """
    if path is None:
        return {}
    if not path.is_file():
        raise InputError("exclude", str(path), "a CSV file with the columns participant, reason")
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        if set(rows.fieldnames or ()) != {"participant", "reason"}:
            raise InputError("exclude", rows.fieldnames, "the columns participant, reason")
        return {row["participant"]: row["reason"] for row in rows}


def show(analysis: Analysis, console: Console) -> None:
    """The tables, on a terminal."""
    from rich.table import Column, Table

    whose = {"person": "participants", "pilot": "PILOTS", "bot": "SIMULATED PARTICIPANTS"}
    first, second = analysis.conditions
    means = [f"{one.capitalize()}\nmean (SD), n" for one in analysis.conditions]
    headings = (
        *("Measure", *means, "Student's\np"),
        *("p, Holm", "Welch's\np", "Permutation\np", "Hedges' g [95 %]"),
        *(("Paper: means, p",) * (analysis.conditions == CONDITIONS)),
    )
    measures = Table(
        *(Column(heading, overflow="fold") for heading in headings),
        title=f"{_title(analysis)}: {whose[analysis.stream]} ({first} − {second})",
    )
    for row in analysis.rows:
        measures.add_row(*_cells(row)[: len(headings)])
    console.print(measures)
    columns = [*analysis.flow[0][1]]
    counted = [Column(heading, justify="right") for heading in columns]
    flow = Table("", *counted, title="Flow of participants")
    for stage, counts in analysis.flow:
        flow.add_row(stage, *(str(counts[key]) for key in columns))
    for reason, number in analysis.excluded.items():
        flow.add_row(f"excluded: {reason}", str(number))
    each = {"all": len(analysis.data), **analysis.data["condition"].value_counts()}
    flow.add_row("analysed", *(str(each.get(key, "")) for key in columns))
    console.print(flow)


def _title(analysis: Analysis) -> str:
    return "Table 2" if analysis.conditions == CONDITIONS else "Questions in between"


def _cells(row: Row) -> list[str]:
    c, paper = row.ours, row.paper
    published = ""
    if paper:
        published = f"{paper['conformant']:g}, {paper['personalized']:g}, p = {paper['p_value']:g}"
    return [
        row.title,
        *(f"{group.mean:.2f} ({group.sd:.2f}), {group.n}" for group in (c.a, c.b)),
        _p(c.student.p),
        _p(row.holm_p),
        _p(c.welch.p),
        _p(c.permutation_p),
        "–" if math.isnan(c.g) else f"{c.g:.2f} [{c.g_low:.2f}, {c.g_high:.2f}]",
        published,
    ]


def _p(value: float) -> str:
    if math.isnan(value):
        return "–"
    return "< .001" if value < 0.001 else f"{value:.3f}"


def save(analysis: Analysis, folder: Path, name: str = "table2") -> list[str]:
    """The table and the flow as CSV, and the plots; names of the files."""
    import pandas as pd

    folder.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(table(analysis)).to_csv(folder / f"{name}.csv", index=False)
    flow = [{"stage": stage, **counts} for stage, counts in analysis.flow]
    pd.DataFrame(flow).to_csv(folder / "flow.csv", index=False)
    drawn = "measures.png" if analysis.conditions == CONDITIONS else f"{name}.png"
    draw(analysis, folder / drawn)
    return [f"{name}.csv", "flow.csv", drawn]


def figure_of(width: float, height: float, rows: int, columns: int, **subplots: Any) -> Any:
    """A figure of that many inches, and its axes [rows, columns] without the frame's upper half."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    axes = figure.subplots(rows, columns, **subplots)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def saved(figure: Figure, path: Path, columns: int) -> None:
    """Writes a figure, the legend of its first axes above all of them."""
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=columns, frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 0.93))
    figure.savefig(path, dpi=160)


def draw(analysis: Analysis, path: Path) -> None:
    """Every participant, means with 95 % intervals, the paper's means; below, effect sizes."""
    primary = [row for row in analysis.rows if row.measure in MEASURES]
    figure, axes = figure_of(10.5, 5.6, 2, len(primary), height_ratios=(3.2, 1))
    for column, row in enumerate(primary):
        _draw_measure(axes[0, column], analysis, row)
        _draw_effect(axes[1, column], analysis, row)
    saved(figure, path, columns=3)


def _draw_measure(axis: Axes, analysis: Analysis, row: Row) -> None:
    import numpy as np
    from scipy import stats

    rng, paper = np.random.default_rng(0), row.paper or {}  # of the sideways scatter only
    for x, condition in enumerate(analysis.conditions):
        values = analysis.data.loc[analysis.data["condition"] == condition, row.measure].to_numpy()
        aside = x + rng.uniform(-0.18, 0.18, len(values))
        look: dict[str, Any] = {"color": COLOURS[condition], "marker": MARKS[condition]}
        axis.scatter(aside, values, s=16, alpha=0.5, linewidths=0, **look)
        half = stats.t.isf(0.025, len(values) - 1) * stats.sem(values)
        said = ("mean, 95 % interval", "paper's mean") if x else (None, None)
        mean: dict[str, Any] = {"linestyle": "", "capsize": 4, "markersize": 7, "label": said[0]}
        axis.errorbar(x + 0.28, values.mean(), half, **mean, **look)
        if paper:
            axis.plot(x + 0.4, paper[condition], "*", color="black", markersize=10, label=said[1])
    if row.measure != "interaction_time_s":
        axis.locator_params(axis="y", integer=True)  # counts
    axis.set_xticks(range(len(analysis.conditions)), analysis.conditions)
    axis.set(xlim=(-0.4, 1.6), ylabel=row.title)


def _draw_effect(axis: Axes, analysis: Analysis, row: Row) -> None:
    published = (math.nan,) * 3
    if row.paper:
        n = int(row.paper["n_per_arm"])
        published = hedges(paper_effect(row.measure) * (n / 2) ** 0.5, n, n)
    ours = (row.ours.g, row.ours.g_low, row.ours.g_high)
    for y, (g, low, high), colour, mark, size in (
        (0, published, "black", "*", 9),
        (1, ours, "#0072B2", "o", 7),
    ):
        if not math.isnan(g):
            axis.plot([low, high], [y, y], linewidth=2, color=colour)
            axis.plot(g, y, mark, color=colour, markersize=size)
    axis.axvline(0, color="#888888", linewidth=1, linestyle=":")
    axis.set_yticks(*([0, 1], ["paper", "here"]) if row.paper else ([1], ["here"]))
    said = " − ".join(analysis.conditions)
    axis.set(ylim=(-0.6, 1.6), xlabel=f"Hedges' g, 95 % interval\n({said})")
