"""Prints and draws the analysis: ``python -m xplain study analyse folder``."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import TYPE_CHECKING

from xplain.errors import InputError
from xplain.study.analysis.table2 import (
    CONDITIONS,
    Analysis,
    Row,
    paper_table,
    table,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.console import Console

COLOURS = {"conformant": "#D55E00", "personalized": "#0072B2"}
MARKS = {"conformant": "s", "personalized": "o"}


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
    from rich.table import Table

    whose = {"person": "participants", "pilot": "PILOTS", "bot": "SIMULATED PARTICIPANTS"}
    measures = Table(title=f"Table 2: {whose[analysis.stream]} (conformant − personalized)")
    for heading in (
        "Measure",
        "Conformant\nmean (SD), n",
        "Personalized\nmean (SD), n",
        "Student's\np",
        "p, Holm",
        "Welch's\np",
        "Permutation\np",
        "Hedges' g [95 %]",
        "Paper: means, p",
    ):
        measures.add_column(heading, overflow="fold")
    for row in analysis.rows:
        measures.add_row(*_cells(row))
    console.print(measures)
    flow = Table(title="Flow of participants")
    for heading in ("", "all", *CONDITIONS):
        flow.add_column(heading, justify="left" if not heading else "right")
    for stage, counts in analysis.flow:
        flow.add_row(stage, *(str(counts[key]) for key in ("all", *CONDITIONS)))
    for reason, number in analysis.excluded.items():
        flow.add_row(f"excluded: {reason}", str(number), "", "")
    flow.add_row("analysed", str(len(analysis.data)), *_analysed(analysis))
    console.print(flow)


def _analysed(analysis: Analysis) -> list[str]:
    return [str(int((analysis.data["condition"] == c).sum())) for c in CONDITIONS]


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


def save(analysis: Analysis, folder: Path) -> None:
    """The table and the flow as CSV, and the plots."""
    import pandas as pd

    folder.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(table(analysis.rows)).to_csv(folder / "table2.csv", index=False)
    flow = [{"stage": stage, **counts} for stage, counts in analysis.flow]
    pd.DataFrame(flow).to_csv(folder / "flow.csv", index=False)
    draw(analysis, folder / "measures.png")


def draw(analysis: Analysis, path: Path) -> None:
    """Every participant, means with 95 % intervals, the paper's means; below, effect sizes."""
    from matplotlib.figure import Figure

    primary = [row for row in analysis.rows if row.paper]
    figure = Figure(figsize=(10.5, 5.6))
    axes = figure.subplots(2, len(primary), height_ratios=(3.2, 1))
    for column, row in enumerate(primary):
        _draw_measure(axes[0, column], analysis, row)
        _draw_effect(axes[1, column], row)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper center", ncols=3, frameon=False, fontsize=9)
    figure.tight_layout(rect=(0, 0, 1, 0.94))
    figure.savefig(path, dpi=160)


def _draw_measure(axis: Axes, analysis: Analysis, row: Row) -> None:
    import numpy as np
    from matplotlib.ticker import MaxNLocator
    from scipy import stats

    rng = np.random.default_rng(0)  # of the sideways scatter only
    for x, condition in enumerate(CONDITIONS):
        values = analysis.data.loc[analysis.data["condition"] == condition, row.measure].to_numpy()
        axis.scatter(
            x + rng.uniform(-0.18, 0.18, len(values)),
            values,
            s=16,
            alpha=0.5,
            color=COLOURS[condition],
            marker=MARKS[condition],
            linewidths=0,
        )
        half = stats.t.isf(0.025, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
        axis.errorbar(
            x + 0.28,
            values.mean(),
            half,
            fmt=MARKS[condition],
            color=COLOURS[condition],
            capsize=4,
            markersize=7,
            label="mean, 95 % interval" if condition == "personalized" else None,
        )
        assert row.paper is not None, "only the paper's measures are drawn"
        axis.plot(
            x + 0.4,
            row.paper[condition],
            "*",
            color="black",
            markersize=10,
            label="paper's mean" if condition == "personalized" else None,
        )
    if row.measure != "interaction_time_s":  # counts
        axis.yaxis.set_major_locator(MaxNLocator(integer=True))
    axis.set_xticks(range(len(CONDITIONS)), CONDITIONS)
    axis.set_xlim(-0.4, 1.6)
    axis.set_ylabel(row.title)
    axis.spines[["top", "right"]].set_visible(False)


def _draw_effect(axis: Axes, row: Row) -> None:
    from xplain.study.analysis.statistics import d_from_p, hedges

    paper = paper_table()[row.measure]
    n = int(paper["n_per_arm"])
    sign = 1 if paper["conformant"] > paper["personalized"] else -1
    published = hedges(sign * d_from_p(paper["p_value"], n) * (n / 2) ** 0.5, n, n)
    ours = (row.ours.g, row.ours.g_low, row.ours.g_high)
    for y, (name, (g, low, high), colour, mark) in enumerate(
        (("paper", published, "black", "*"), ("here", ours, "#0072B2", "o"))
    ):
        if math.isnan(g):
            continue
        axis.plot([low, high], [y, y], color=colour, linewidth=2)
        axis.plot(g, y, mark, color=colour, markersize=9 if name == "paper" else 7)
    axis.axvline(0, color="#888888", linewidth=1, linestyle=":")
    axis.set_yticks([0, 1], ["paper", "here"])
    axis.set_ylim(-0.6, 1.6)
    axis.set_xlabel("Hedges' g, 95 % interval\n(conformant − personalized)")
    axis.spines[["top", "right"]].set_visible(False)
