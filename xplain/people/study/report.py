"""Prints and draws the analysis: ``python -m xplain study analyse folder``."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Column, Table
from scipy import stats

from xplain.people.study.analysis import CONDITIONS, MEASURES, SECONDARY, Analysis

TITLES = {**MEASURES, **SECONDARY}
LOOKS = {
    "conformant": ("#D55E00", "s"),
    "personalized": ("#0072B2", "o"),
    "asking": ("#00795A", "^"),
}
"""Colour and mark of a condition."""
WHOSE = {"person": "participants", "pilot": "PILOTS", "bot": "SIMULATED PARTICIPANTS"}


def show(analysis: Analysis, console: Console) -> None:
    """Prints the tables on a terminal."""
    first, second = analysis.conditions
    published = analysis.conditions == CONDITIONS
    means = [f"{one.capitalize()}\nmean (SD), n" for one in analysis.conditions]
    tests = ("Student's\np", "p, Holm", "Welch's\np", "Permutation\np", "Hedges' g [95 %]")
    paper = ("Paper: means, p",) * published
    title = "Table 2" if published else "Questions in between"
    measures = Table(
        *(Column(heading, overflow="fold") for heading in ("Measure", *means, *tests, *paper)),
        title=f"{title}: {WHOSE[analysis.stream]} ({first} − {second})",
    )
    for measure, row in analysis.measures.iterrows():
        measures.add_row(TITLES[str(measure)], *_cells(row, analysis.conditions))
    flow = Table(title="Flow of participants")
    for heading in ("", *analysis.flow.columns):
        flow.add_column(heading, justify="right" if heading else "left")
    for stage, counts in analysis.flow.iterrows():
        flow.add_row(str(stage), *map(str, counts))
    console.print(measures, flow)


def _cells(row: pd.Series[float], conditions: tuple[str, str]) -> list[str]:
    """What stands beside a measure's title."""
    shown = ((row[f"mean_{c}"], row[f"sd_{c}"], row[f"n_{c}"]) for c in conditions)
    cells = [f"{mean:.2f} ({sd:.2f}), {count:.0f}" for mean, sd, count in shown]
    every = row[["student_p", "student_p_holm", "welch_p", "permutation_p"]]
    cells += ["–" if math.isnan(p) else "< 0.001" if p < 0.001 else f"{p:.3f}" for p in every]
    g = f"{row['hedges_g']:.2f} [{row['g_low']:.2f}, {row['g_high']:.2f}]"
    cells.append("–" if math.isnan(row["hedges_g"]) else g)
    if row.name in MEASURES and conditions == CONDITIONS:
        means = ", ".join(f"{row[f'paper_{c}']:g}" for c in CONDITIONS)
        cells.append(f"{means}, p = {row['paper_p_value']:g}")
    return cells


def save(analysis: Analysis, folder: Path, name: str = "table2") -> list[str]:
    """Writes the table and the flow as CSV, and the plot; names of the files."""
    folder.mkdir(parents=True, exist_ok=True)
    analysis.measures.to_csv(folder / f"{name}.csv")
    analysis.flow.to_csv(folder / "flow.csv")
    drawn = "measures.png" if name == "table2" else f"{name}.png"
    draw(analysis, folder / drawn)
    return [f"{name}.csv", "flow.csv", drawn]


def draw(analysis: Analysis, path: Path) -> None:
    """Draws every participant, means with 95 % intervals, and the paper's means."""
    figure = Figure(figsize=(10.5, 4.2))
    rng = np.random.default_rng(0)
    for axis, measure in zip(figure.subplots(1, len(MEASURES)), MEASURES, strict=True):
        row = analysis.measures.loc[measure]
        for x, condition in enumerate(analysis.conditions):
            values = analysis.data.loc[analysis.data["condition"] == condition, measure].dropna()
            colour, mark = LOOKS[condition]
            aside = x + rng.uniform(-0.15, 0.15, len(values))
            look = {"color": colour, "marker": mark}
            axis.scatter(aside, values, s=16, alpha=0.5, linewidths=0, label="participants", **look)
            half = stats.t.ppf(0.975, max(len(values) - 1, 1)) * stats.sem(values)
            style = {"color": colour, "markersize": 8, "capsize": 4, "label": "mean, 95 % interval"}
            axis.errorbar(x + 0.3, values.mean(), half, fmt=mark, **style)
            if analysis.conditions == CONDITIONS:
                axis.plot(x + 0.45, row[f"paper_{condition}"], "*", color="black", label="paper")
        title = f"Hedges' g {row['hedges_g']:.2f} [{row['g_low']:.2f}, {row['g_high']:.2f}]"
        axis.set_title(title, fontsize=9)
        axis.set_xticks(range(2), analysis.conditions)
        axis.set(xlim=(-0.4, 1.6), ylabel=TITLES[measure])
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    of_each = dict(zip(labels, handles, strict=True))
    figure.legend(of_each.values(), of_each, loc="upper center", ncols=3, frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 0.93))
    figure.savefig(path, dpi=160)
