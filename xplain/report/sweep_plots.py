"""Plots of a sweep: the main swept key on the axis, a line a way to solve, small multiples for the
rest, intervals over seeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from xplain.report.combinations import (
    grouped,
    heading,
    label,
    plain_text,
    value_title,
    where,
)
from xplain.report.layout import PlotLayout, plot_layout
from xplain.report.paper import table1
from xplain.report.plots import STYLE, figure_of_panels, series_style
from xplain.report.summary import Summary, Value

AXES = {
    "lambda": "λ, cost of communication against inexplicability",
    "users.count": "number of user types (users.count)",
    "observers.label_noise": "share of wrong labels (observers.label_noise)",
    "ask.cost": "κ, cost of a question (ask.cost)",
    "points": "labels an observer (points)",
}
"""What a key means, on its axis; any other stands there by its name."""

MOST_PANELS = 24


@matplotlib.rc_context(STYLE)
def against_main_key(summary: Summary, measure: str, title: str) -> Figure | None:
    """A measure against the main swept key, with intervals; None where nothing was swept.

    Regrets in a report of Table 1 stand beside the paper's (open markers).
    """
    layout = plot_layout(summary)
    if layout.x is None or not summary.episodes[measure].notna().any():
        return None
    panels = grouped(summary, layout.panels)[:MOST_PANELS]
    ticks = summary.values(layout.x)
    place = _places(ticks, layout)
    lines = [values for values, _ in grouped(summary, layout.lines)]
    figure, axes = figure_of_panels(len(panels))
    gap = min(np.diff(sorted(place.values())), default=1.0)
    for panel, (values, frame) in zip(axes, panels, strict=True):
        for index, line in enumerate(lines):
            points = _points(summary, where(frame, line), layout.x, measure)
            if not points:
                continue
            shift = 0.12 * gap * (index - (len(lines) - 1) / 2)
            x = np.array([place[value] for value in points]) + shift
            mean, low, high = np.array(list(points.values())).T
            errors = np.nan_to_num([mean - low, high - mean])
            style = series_style(index) | ({} if layout.numeric else {"linestyle": "none"})
            name = label(line)
            panel.errorbar(x, mean, errors, capsize=2.5, lw=1.4, ms=5, label=name or None, **style)
            if summary.report == "table1" and measure == "regret":
                _draw_paper(panel, summary, {**values, **line}, shift, style)
        _name_axes(panel, layout, ticks, place)
        panel.set_title(label(values), loc="left", weight="bold", fontsize=10)
    for panel in axes:
        if measure == "regret":
            panel.axhline(0, color="#222222", lw=0.8)
        else:
            panel.set_ylim(bottom=0)
    _share_scale(axes, layout)
    axes[0].set_ylabel(title)
    if summary.report == "table1" and measure == "regret":
        axes[len(panels) - 1].plot([], [], "o", color="#666666", mfc="white", label="paper")
    legend_right(figure, axes)
    return figure


@matplotlib.rc_context(STYLE)
def belief_over_steps(summary: Summary) -> Figure | None:
    """Belief in the user's true type after each step, mean over the episodes that last so long,
    at the middle of the main key."""
    layout = plot_layout(summary)
    fixed = {} if layout.x is None else {layout.x: middle(summary, layout.x)}
    panels = grouped(summary, layout.panels)[:MOST_PANELS]
    lines = [values for values, _ in grouped(summary, layout.lines)]
    figure, axes = figure_of_panels(len(panels))
    drawn = False
    for panel, (values, _) in zip(axes, panels, strict=True):
        for index, line in enumerate(lines):
            if line.get("solver") == "baseline":
                continue  # it believes nothing
            belief, episodes = by_step(summary, "belief_in_true_type", {**fixed, **values, **line})
            if len(belief):
                drawn = True
                if episodes[-1] < episodes[0]:
                    left = f" {episodes[-1]:.0f} of {episodes[0]:.0f} last so long"
                    panel.annotate(left, (len(belief) - 1, belief[-1]), fontsize=7, va="center")
                name = label(line) or None
                style = series_style(index)
                panel.plot(belief, lw=1.4, ms=4, markevery=2, label=name, **style)
        panel.set_ylim(0, 1.02)
        panel.set_title(label(values), loc="left", weight="bold", fontsize=10)
        panel.set_xlabel("steps explained")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    at = label(fixed)
    axes[0].set_ylabel("belief in the true type" + (f" ({at})" if at else ""))
    legend_right(figure, axes)
    return figure if drawn else None


def middle(summary: Summary, key: str) -> Value:
    """λ = 1 where it was run; of any key else the value in the middle."""
    values = summary.values(key)
    return 1.0 if key == "lambda" and 1.0 in values else values[len(values) // 2]


def legend_right(figure: Figure, axes: list[Axes]) -> None:
    """One legend for all panels, at the right of the figure."""
    named: dict[str, Any] = {}
    for panel in axes:
        for handle, name in zip(*panel.get_legend_handles_labels(), strict=True):
            named.setdefault(name, handle)
    if named:
        figure.legend(list(named.values()), list(named), loc="outside right center")


def _points(
    summary: Summary, frame: pd.DataFrame, x: str, measure: str
) -> dict[Value, tuple[float, float, float]]:
    """``{value of x: (mean, low, high)}``."""
    found = {at: summary.estimate(frame[frame[x] == at], measure) for at in summary.values(x)}
    return {at: (own.mean, own.low, own.high) for at, own in found.items() if own is not None}


def _places(ticks: list[Value], layout: PlotLayout) -> dict[Value, float]:
    """Where each value stands on the axis."""
    if layout.numeric:
        return {value: value for value in ticks if isinstance(value, float)}
    return {value: float(i) for i, value in enumerate(ticks)}


def _name_axes(
    panel: Axes, layout: PlotLayout, ticks: list[Value], place: Mapping[Value, float]
) -> None:
    assert layout.x is not None
    panel.set_xlabel(AXES.get(layout.x, heading(layout.x)))
    if len(place) <= 8:  # the values that were run, and no others
        panel.xaxis.set_major_locator(FixedLocator(list(place.values())))
        panel.xaxis.set_minor_locator(NullLocator())
        words = [
            plain_text(value) if layout.numeric else value_title(layout.x, value) for value in place
        ]
        panel.set_xticks(list(place.values()), words)
    if not layout.numeric:
        panel.set_xlim(-0.5, len(ticks) - 0.5)


def _draw_paper(
    panel: Axes,
    summary: Summary,
    values: Mapping[str, Value],
    shift: float,
    style: Mapping[str, Any],
) -> None:
    """The paper's regrets of a domain and solver as open markers."""
    domain = str(values.get("domain", summary.domains[0]))
    solver = str(values.get("solver", summary.values("solver")[0]))
    published = table1()
    paper = [
        (trade_off + shift, published[domain, trade_off][solver])
        for trade_off in map(float, summary.values("lambda"))
        if solver in published.get((domain, trade_off), {})
    ]
    if paper:
        look: dict[str, Any] = {"color": style["color"], "marker": style["marker"], "mfc": "white"}
        panel.plot(*zip(*paper, strict=True), ls="none", ms=5, **look)


def _share_scale(axes: list[Axes], layout: PlotLayout) -> None:
    """The same vertical axis for all panels; tasks differ in scale, so theirs are their own."""
    if "domain" not in layout.panels:
        low, high = zip(*(panel.get_ylim() for panel in axes), strict=True)
        for panel in axes:
            panel.set_ylim(min(low), max(high))


def by_step(
    summary: Summary, name: str, wanted: Mapping[str, Value]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean at each step over all episodes of these values that last so long, and how many do."""
    rows = [
        (step, count * mean, count)
        for job, results in summary.results
        if wanted.items() <= summary.values_of(job, results).items() and name in results.steps
        for step, (mean, count) in enumerate(
            zip(results.steps[name], results.steps["episodes"], strict=False)
        )
    ]
    sums = pd.DataFrame(rows, columns=["step", "total", "count"]).groupby("step").sum()
    return (sums["total"] / sums["count"]).to_numpy(), sums["count"].to_numpy(float)
