"""Plots: labelled axes, intervals, colours that colour-blind people and printers can tell apart.

Figures are made without pyplot: it keeps each until it is closed, and a run would wait for its
import.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from xplain.report.learning import elbows as curves_of
from xplain.report.paper import title
from xplain.report.summary import Summary
from xplain.storage import written_whole

# Okabe and Ito's palette, grey for their yellow; each series has a marker and a line style, too.
COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#8C8C8C",
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
CLUSTERS, DISAGREEMENTS = "number of clusters k", "disagreements (pairs of labels)"
STYLES = ("-", "--", "-.", ":", "-", "--", "-.", ":")

STYLE: dict[Any, Any] = {
    "figure.dpi": 150,
    "savefig.bbox": "tight",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "svg.hashsalt": "xplain",
}
"""How plots look. It holds while one is drawn: a program's own figures stay as they are."""


def series_style(index: int) -> dict[str, Any]:
    """Colour, marker and line of the series with this index."""
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": STYLES[index % len(STYLES)],
    }


@matplotlib.rc_context(STYLE)
def disagreements(curve: Sequence[float], found: int, rule: str) -> Figure:
    """Disagreements against the number of clusters, with the number that was chosen."""
    figure = Figure(figsize=(5, 3.2))
    axes = figure.subplots()
    axes.plot(np.arange(1, len(curve) + 1), curve, **series_style(0))
    _draw_rings(axes, curve, [found], COLOURS[1], f"chosen: {found} ({rule})")
    axes.set(xlabel=CLUSTERS, ylabel=DISAGREEMENTS, ylim=(0, None))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()
    return figure


def _draw_rings(
    axes: Axes, curve: Sequence[float], chosen: Sequence[int], colour: str, name: str | None = None
) -> None:
    """Rings around the numbers of clusters that were chosen."""
    heights = [curve[min(k, len(curve)) - 1] for k in chosen]
    axes.plot(chosen, heights, "o", ms=13, mfc="none", mec=colour, mew=2, label=name)


@matplotlib.rc_context(STYLE)
def elbows(summary: Summary) -> Figure | None:
    """Disagreements against k, one line a setting (mean over seeds), with the k chosen."""
    domains = [domain for domain in summary.domains if curves_of(summary, domain)]
    if not domains:
        return None
    figure, panels = figure_of_panels(len(domains))
    for axes, domain in zip(panels, domains, strict=True):
        curves = curves_of(summary, domain)
        few = len(curves) <= len(COLOURS) - 3
        for index, (setting, (curve, chosen)) in enumerate(curves.items()):
            style = series_style(index) if few else dict[str, Any](color="#888888", alpha=0.5)
            words = ", ".join(
                f"{k}" + (f" ({times} seed{'s' * (times > 1)})" if len(chosen) > 1 else "")
                for k, times in sorted(chosen.items())
            )
            text = f"{setting}: chosen {words}" if setting else f"chosen: {words}"
            k = np.arange(1, len(curve) + 1)
            axes.plot(k, curve, lw=1.3, ms=4, label=text if few else None, **style)
            found = [number for number in sorted(chosen) if number <= len(curve)]
            _draw_rings(axes, curve.tolist(), found, style["color"])
        axes.set_title(title(domain), loc="left", weight="bold")
        axes.set_xlabel(CLUSTERS)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(fontsize=8)
    panels[0].set_ylabel(DISAGREEMENTS)
    return figure


def figure_of_panels(count: int) -> tuple[Figure, list[Axes]]:
    """A figure of small plots, at most four beside each other, with room for a legend."""
    columns = min(count, 4)
    rows = -(-count // columns)
    figure = Figure(figsize=(4.2 * columns + 1.4, 3.4 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for left in axes[count:]:
        left.set_visible(False)
    return figure, axes[:count]


@matplotlib.rc_context(STYLE)
def save(figure: Figure, path: Path) -> None:
    """Writes a figure in the format of the path's suffix, whole or not at all.

    Raises:
        OSError: with the path.
    """
    # Without dates and random ids the same figure is the same file.
    metadata = {"Date": None} if path.suffix == ".svg" else None
    with written_whole(path, "wb") as file:
        figure.savefig(file, format=path.suffix[1:], metadata=metadata)
