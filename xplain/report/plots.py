"""Plots: labelled axes, intervals, colours that colour-blind people and printers can tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg", force=False)
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

# Okabe and Ito's palette; each series also has a marker and a line style of its own.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
STYLES = ("-", "--", "-.", ":", "-", "--", "-.")

plt.rcParams.update(
    {
        "figure.dpi": 150,
        "savefig.bbox": "tight",
        "font.size": 10,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.alpha": 0.25,
        "legend.frameon": False,
    }
)


def series_style(index: int) -> dict[str, Any]:
    """Colour, marker and line of the series with this index."""
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": STYLES[index % len(STYLES)],
    }


def disagreements(curve: Sequence[float], found: int, rule: str) -> Figure:
    """Disagreements against the number of clusters, with the number that was chosen."""
    figure, axes = plt.subplots(figsize=(5, 3.2))
    k = np.arange(1, len(curve) + 1)
    axes.plot(k, curve, **series_style(0))
    axes.plot(
        found,
        curve[min(found, len(k)) - 1],
        marker="o",
        markersize=13,
        markerfacecolor="none",
        markeredgecolor=COLOURS[1],
        markeredgewidth=2,
        linestyle="none",
        label=f"chosen: {found} ({rule})",
    )
    axes.set_xlabel("number of clusters k")
    axes.set_ylabel("disagreements (pairs of labels)")
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()
    return figure


def save(figure: Figure, path: Path) -> None:
    """Writes a figure and frees it."""
    figure.savefig(path)
    plt.close(figure)
