"""Prints and draws the analysis: ``python -m xplain study analyse folder``."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Column, Table
from scipy import stats

from xplain.errors import InputError
from xplain.people.study.statistics import hedges
from xplain.people.study.table2 import CONDITIONS, MEASURES, TITLES, Analysis, paper_effect

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
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.DictReader(file)
        if set(rows.fieldnames or ()) != {"participant", "reason"}:
            raise InputError("exclude", rows.fieldnames, "the columns participant, reason")
        return {row["participant"]: row["reason"] for row in rows}


def show(analysis: Analysis, console: Console) -> None:
    """The tables, on a terminal."""
    whose = {"person": "participants", "pilot": "PILOTS", "bot": "SIMULATED PARTICIPANTS"}
    first, second = analysis.conditions
    means = [f"{one.capitalize()}\nmean (SD), n" for one in analysis.conditions]
    tests = ("Student's\np", "p, Holm", "Welch's\np", "Permutation\np", "Hedges' g [95 %]")
    paper = ("Paper: means, p",) * _as_published(analysis)
    measures = Table(
        *(Column(heading, overflow="fold") for heading in ("Measure", *means, *tests, *paper)),
        title=f"{_title(analysis)}: {whose[analysis.stream]} ({first} − {second})",
    )
    for measure, row in analysis.measures.iterrows():
        measures.add_row(TITLES[str(measure)], *_cells(row, analysis))
    console.print(measures)
    columns = [*analysis.flow.columns]
    counted = [Column(heading, justify="right") for heading in columns]
    flow = Table("", *counted, title="Flow of participants")
    for stage, counts in analysis.flow.iterrows():
        flow.add_row(str(stage), *map(str, counts))
    console.print(flow)


def _as_published(analysis: Analysis) -> bool:
    return analysis.conditions == CONDITIONS


def _title(analysis: Analysis) -> str:
    return "Table 2" if _as_published(analysis) else "Questions in between"


def _cells(row: pd.Series[float], analysis: Analysis) -> Iterator[str]:
    for c in analysis.conditions:
        yield f"{row[f'mean_{c}']:.2f} ({row[f'sd_{c}']:.2f}), {row[f'n_{c}']:.0f}"
    for test in ("student_p", "student_p_holm", "welch_p", "permutation_p"):
        yield _p(row[test])
    known = not math.isnan(row["hedges_g"])
    yield f"{row['hedges_g']:.2f} [{row['g_low']:.2f}, {row['g_high']:.2f}]" if known else "–"
    if _as_published(analysis) and row.name in MEASURES:
        means = ", ".join(f"{row[f'paper_{c}']:g}" for c in CONDITIONS)
        yield f"{means}, p = {row['paper_p_value']:g}"


def _p(value: float) -> str:
    if math.isnan(value):
        return "–"
    return "< .001" if value < 0.001 else f"{value:.3f}"


def save(analysis: Analysis, folder: Path, name: str = "table2") -> list[str]:
    """The table and the flow as CSV, and the plots; names of the files."""
    folder.mkdir(parents=True, exist_ok=True)
    analysis.measures.to_csv(folder / f"{name}.csv")
    analysis.flow.to_csv(folder / "flow.csv")
    drawn = "measures.png" if _as_published(analysis) else f"{name}.png"
    draw(analysis, folder / drawn)
    return [f"{name}.csv", "flow.csv", drawn]


def figure_of(width: float, height: float, rows: int, columns: int, **subplots: Any) -> Any:
    """A figure of that many inches, and its axes [rows, columns] without the frame's upper half."""
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
    figure, axes = figure_of(10.5, 5.6, 2, len(MEASURES), height_ratios=(3.2, 1))
    for column, (_, row) in enumerate(analysis.measures.loc[[*MEASURES]].iterrows()):
        _draw_measure(axes[0, column], analysis, row)
        _draw_effect(axes[1, column], analysis, row)
    saved(figure, path, columns=3)


def _draw_measure(axis: Axes, analysis: Analysis, row: pd.Series[float]) -> None:
    measure = str(row.name)
    rng = np.random.default_rng(0)  # of the sideways scatter only
    for x, condition in enumerate(analysis.conditions):
        values = analysis.data.loc[analysis.data["condition"] == condition, measure].to_numpy()
        aside = x + rng.uniform(-0.18, 0.18, len(values))
        look: dict[str, Any] = {"color": COLOURS[condition], "marker": MARKS[condition]}
        axis.scatter(aside, values, s=16, alpha=0.5, linewidths=0, **look)
        half = stats.t.isf(0.025, len(values) - 1) * stats.sem(values)
        said = ("mean, 95 % interval", "paper's mean") if x else (None, None)
        mean: dict[str, Any] = {"linestyle": "", "capsize": 4, "markersize": 7, "label": said[0]}
        axis.errorbar(x + 0.28, values.mean(), half, **mean, **look)
        if _as_published(analysis):
            paper = row[f"paper_{condition}"]
            axis.plot(x + 0.4, paper, "*", color="black", markersize=10, label=said[1])
    if measure != "interaction_time_s":
        axis.locator_params(axis="y", integer=True)  # counts
    axis.set_xticks(range(len(analysis.conditions)), analysis.conditions)
    axis.set(xlim=(-0.4, 1.6), ylabel=TITLES[measure])


def _draw_effect(axis: Axes, analysis: Analysis, row: pd.Series[float]) -> None:
    effects = {}
    if _as_published(analysis):
        n = int(row["paper_n_per_arm"])
        published = hedges(paper_effect(str(row.name)) * (n / 2) ** 0.5, n, n)
        effects["paper"] = (0, published, "black", "*", 9)
    ours = (row["hedges_g"], row["g_low"], row["g_high"])
    effects["here"] = (1, ours, "#0072B2", "o", 7)
    for y, (g, low, high), colour, mark, size in effects.values():
        if not math.isnan(g):
            axis.plot([low, high], [y, y], linewidth=2, color=colour)
            axis.plot(g, y, mark, color=colour, markersize=size)
    axis.axvline(0, color="#888888", linewidth=1, linestyle=":")
    axis.set_yticks([one[0] for one in effects.values()], [*effects])
    said = " − ".join(analysis.conditions)
    axis.set(ylim=(-0.6, 1.6), xlabel=f"Hedges' g, 95 % interval\n({said})")
