"""Plots: labelled axes, intervals, colours that colour-blind people and printers can tell apart.

Figures are made without pyplot: it keeps each until it is closed, and a run would wait for its
import.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from xplain.report.paper import table1, title

if TYPE_CHECKING:
    from xplain.report.summary import Summary

# Okabe and Ito's palette; each series also has a marker and a line style of its own.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
STYLES = ("-", "--", "-.", ":", "-", "--", "-.")

matplotlib.rcParams.update(
    {
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
    figure = Figure(figsize=(5, 3.2))
    axes = figure.subplots()
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


def against_trade_off(summary: Summary, measure: str, label: str) -> Figure:
    """A measure against λ, one panel a domain, with intervals; regret beside the paper's."""
    figure, panels = _panels(len(summary.domains))
    published = table1()
    width = _least_gap(summary.trade_offs)
    for axes, domain in zip(panels, summary.domains, strict=True):
        for index, method in enumerate(summary.methods):
            cells = [
                cell
                for trade_off in summary.trade_offs
                if (cell := summary.estimate(measure, domain, trade_off, method)) is not None
            ]
            # Side by side, so that intervals do not hide each other.
            shift = 0.12 * width * (index - (len(summary.methods) - 1) / 2)
            x = np.array([cell.trade_off for cell in cells]) + shift
            mean, low, high = np.array(
                [(c.estimate.mean, c.estimate.low, c.estimate.high) for c in cells]
            ).T
            errors = np.nan_to_num([mean - low, high - mean])
            style = series_style(index)
            axes.errorbar(x, mean, errors, capsize=2.5, lw=1.4, ms=5, label=title(method), **style)
            paper = [
                (trade_off + shift, published[domain, trade_off][method])
                for trade_off in summary.trade_offs
                if measure == "regret" and method in published.get((domain, trade_off), {})
            ]
            if paper:
                look = {"color": style["color"], "marker": style["marker"], "mfc": "white"}
                axes.plot(*zip(*paper, strict=True), ls="none", ms=5, **look)
        axes.set_title(title(domain), loc="left", weight="bold")
        axes.set_xlabel("λ, cost of communication against inexplicability")
        _scale(axes, measure)
    panels[0].set_ylabel(label)
    if measure == "regret":
        panels[-1].plot([], [], "o", color="#666666", mfc="white", label="paper")
    _legend_right(panels[-1])
    return figure


def belief_over_steps(summary: Summary) -> Figure | None:
    """Belief in the user's true type after each step, pooled over settings, at one λ."""
    trade_off = middle(summary.trade_offs)
    methods = [method for method in summary.methods if not method.startswith("baseline")]
    figure, panels = _panels(len(summary.domains))
    for axes, domain in zip(panels, summary.domains, strict=True):
        for index, method in enumerate(methods):
            belief = summary.by_step("belief_in_true_type", domain, trade_off, method)
            if len(belief):
                axes.plot(
                    belief, lw=1.4, ms=4, markevery=2, label=title(method), **series_style(index)
                )
        axes.set_ylim(0, 1.02)
        axes.set_title(title(domain), loc="left", weight="bold")
        axes.set_xlabel("steps explained")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0].set_ylabel(f"belief in the true type (λ = {trade_off:g})")
    _legend_right(panels[-1])
    return figure


def elbows(summary: Summary) -> Figure | None:
    """Disagreements against k, one line a setting (mean over seeds), with the k chosen."""
    domains = [domain for domain in summary.domains if summary.elbows(domain)]
    if not domains:
        return None
    figure, panels = _panels(len(domains))
    for axes, domain in zip(panels, domains, strict=True):
        curves = summary.elbows(domain)
        few = len(curves) <= len(COLOURS) - 3
        for index, (setting, (curve, chosen)) in enumerate(curves.items()):
            style = series_style(index) if few else {"color": "#888888", "alpha": 0.5}
            words = ", ".join(
                f"{k}" + (f" ({times} seeds)" if len(chosen) > 1 else "")
                for k, times in sorted(chosen.items())
            )
            text = f"{setting}: chosen {words}" if setting else f"chosen: {words}"
            k = np.arange(1, len(curve) + 1)
            axes.plot(k, curve, lw=1.3, ms=4, label=text if few else None, **style)
            found = [number for number in sorted(chosen) if number <= len(curve)]
            axes.plot(
                found,
                curve[np.array(found, dtype=int) - 1],
                ls="none",
                marker="o",
                ms=12,
                mfc="none",
                mec=style["color"],
                mew=1.6,
            )
        axes.set_title(title(domain), loc="left", weight="bold")
        axes.set_xlabel("number of clusters k")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.legend(fontsize=8)
    panels[0].set_ylabel("disagreements (pairs of labels)")
    return figure


def middle(trade_offs: list[float]) -> float:
    """λ = 1 where it was run, else the one in the middle."""
    return 1.0 if 1.0 in trade_offs else trade_offs[len(trade_offs) // 2]


def _panels(count: int, height: float = 3.4, width: float = 4.2) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width * count + 1.2, height), layout="constrained")
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def _scale(axes: Axes, measure: str) -> None:
    """Regrets of the baseline and of the others differ tenfold: square roots show both."""
    if measure != "regret":
        axes.set_ylim(bottom=0)
        return
    axes.set_yscale(
        "function",
        functions=(lambda y: np.sign(y) * np.abs(y) ** 0.5, lambda y: np.sign(y) * y**2),
    )
    axes.axhline(0, color="#222222", lw=0.8)


def _legend_right(axes: Axes) -> None:
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))


def _least_gap(values: list[float]) -> float:
    gaps = np.diff(values)
    return float(gaps.min()) if len(gaps) else 1.0


def save(figure: Figure, path: Path) -> None:
    """Writes a figure in the format of the path's suffix."""
    # Without dates and random ids the same figure is the same file.
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)
