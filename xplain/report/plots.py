"""Plots: one function draws lines with intervals in panels, from a table of points.

Axes are labelled; colours, markers and line styles differ for colour-blind people and printers.
Figures are made without pyplot, which keeps every figure until the figure is closed.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from xplain.explanation.message_sets import bits_of
from xplain.learning.data.dataset import Dataset
from xplain.learning.prediction import CalibrationBin
from xplain.learning.types import Clustering
from xplain.report.compare import (
    estimate,
    find_published,
    group_episodes,
    heading,
    label,
    layout,
    main_key,
    select_rows,
    value_title,
)
from xplain.report.frame import TITLES, Summary, Value
from xplain.report.paper import group_title
from xplain.storage import open_atomic

# Okabe and Ito's palette, with grey instead of yellow.
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
STYLES = ("-", "--", "-.", ":", "-", "--", "-.", ":")

AXES = {
    "lambda": "λ, cost of a message in inexplicable labels",
    "users.count": "number of user types (users.count)",
    "observers.label_noise": "share of wrong labels (observers.label_noise)",
    "ask.cost": "κ, cost of a question (ask.cost)",
    "points": "labels an observer (points)",
}
"""Labels of axes by key; the label of any other key is the key itself."""

MOST_PANELS = 24

STYLE: dict[Any, Any] = {
    "figure.dpi": 150,
    "savefig.bbox": "tight",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.titlelocation": "left",
    "axes.titlesize": "medium",
    "axes.titleweight": "bold",
    "figure.labelsize": "medium",
    "figure.titlesize": "medium",
    "figure.titleweight": "bold",
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "svg.hashsalt": "xplain",
}
"""Style of plots. It is set only while a plot is drawn, so a program's own figures do not
change."""


def series_style(index: int) -> dict[str, Any]:
    """Returns colour, marker and line of the series with this index."""
    return {
        "color": COLOURS[index % len(COLOURS)],
        "marker": MARKERS[index % len(MARKERS)],
        "linestyle": STYLES[index % len(STYLES)],
    }


@matplotlib.rc_context(STYLE)
def draw(
    points: pd.DataFrame, x_label: str, y_label: str, per_row: int = 4, hollow: str = "the paper's"
) -> Figure:
    """Draws lines with intervals, in panels.

    Args:
        points: a row for each point, with columns ``panel``, ``line``, ``x`` and ``mean``. If ``x``
            has texts, the axis shows them at equal distances. Optional columns: ``low`` and
            ``high``, the ends of the interval; and ``hollow``, the height of a second, hollow
            marker (NaN for no marker).
        x_label, y_label: labels of the axes.
        per_row: number of panels in a row; the panels of a row have one scale.
        hollow: text of the legend for hollow markers.
    """
    points = points.reindex(columns=[*["panel", "line", "x", "mean", "low", "high", "hollow"]])
    panels, lines, ticks = ([*dict.fromkeys(points[key])] for key in ("panel", "line", "x"))
    is_numeric = not any(isinstance(tick, str) for tick in ticks)
    place = {tick: tick if is_numeric else i for i, tick in enumerate(ticks)}
    at = sorted(place.values())  # a point stays at its tick
    apart = min(0.12 * min(np.diff(at), default=0.0), 0.03 * np.ptp(at))
    apart *= points["low"].notna().any()
    columns = min(per_row, len(panels))
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.2 * columns + 1.4, 3.4 * rows), layout="constrained")
    every = figure.subplots(rows, columns, squeeze=False, sharey="row").ravel()
    texts = [tick if isinstance(tick, str) else f"{tick:g}" for tick in ticks]
    slope: dict[str, Any] = {"rotation": 30, "ha": "right"} if len("".join(texts)) > 32 else {}
    hole: dict[str, Any] = {"mfc": "white", "ls": "none", "ms": 8}
    for number, (axes, panel) in enumerate(zip(every, panels, strict=False)):
        # The axis begins at 0, or below 0 if a value is below 0.
        axes.axhline(0, color="#222222").sticky_edges.y.append(0)
        for index, line in enumerate(lines):
            own = points[(points["panel"] == panel) & (points["line"] == line)]
            at = own["x"].map(place).to_numpy(float) + apart * (index - (len(lines) - 1) / 2)
            style = series_style(index) | ({} if is_numeric else {"linestyle": "none"})
            ends = np.nan_to_num([own["mean"] - own["low"], own["high"] - own["mean"]]).clip(0)
            many = dict[str, Any](markevery=max(1, len(own) // 12), capsize=2.5)
            axes.errorbar(at, own["mean"], ends, label=line, **many, **style)
            look = {name: style[name] for name in ("color", "marker")} | hole
            axes.plot(at, own["hollow"], zorder=1, **look)
        axes.set(xlabel=x_label, ylabel="" if number % columns else y_label)
        axes.set_title(panel)
        if len(ticks) <= 8 or not is_numeric:  # only the values of the runs
            axes.set_xticks([*place.values()], texts, **slope)
        else:
            axes.xaxis.set_major_locator(MaxNLocator(6, integer=all(t == int(t) for t in ticks)))
    for axes in every[len(panels) :]:
        axes.set_visible(False)
    handles, labels = every[0].get_legend_handles_labels()
    if points["hollow"].notna().any():
        handles.append(Line2D([], [], color="#666666", marker="o", **hole))
        labels.append(hollow)
    if handles:
        figure.legend(handles, labels, loc="outside right center")
    return figure


def plot_keys(summary: Summary) -> tuple[str | None, list[str], list[str]]:
    """Returns which swept keys a plot shows: the key on its horizontal axis (None if nothing was
    swept), the keys whose values have a line each, and the keys whose values have a panel each."""
    down, grouping, across = layout(summary)
    keys = [*down, *grouping, *across]
    x = main_key(summary, keys) or next(iter([*down[-1:], *across, *grouping]), None)
    lines, panels = ([k for k in own if k != x] for own in (across, [*down, *grouping]))
    if not lines and panels and panels[-1] != "domain":  # tasks differ in scale
        lines = [panels.pop()]
    return x, lines, panels


def _list_panels(
    summary: Summary, keys: Sequence[str], frame: pd.DataFrame | None = None
) -> list[tuple[str, pd.DataFrame]]:
    """Returns the name and the rows of each panel. A panel has one combination of the keys'
    values. ``frame`` is a part of the sweep; None takes its episodes."""
    _, grouping, _ = layout(summary)
    found = []
    for values, own in group_episodes(summary, keys, frame)[:MOST_PANELS]:
        group = {key: values[key] for key in grouping if key in values}
        rest = {key: value for key, value in values.items() if key not in group}
        name = [label(rest), group_title(group, label(group))]
        found.append((": ".join(filter(None, name)), own))
    return found


def _count_per_row(summary: Summary, keys: Sequence[str]) -> int:
    """Returns the number of panels in a row, at most 4. All panels of a row have the same
    domain, so they can share a scale."""
    counts = [len(summary.values(key)) for key in keys if key != "domain"]
    return min(4, int(np.prod(counts)))


def against_main_key(summary: Summary, measure: str) -> Figure | None:
    """Draws a measure, with intervals, against the swept key of :func:`plot_keys`. In Table 1,
    also draws the paper's values. Returns None if nothing was swept, or no episode has the
    measure."""
    x, lines, panels = plot_keys(summary)
    if x is None or not summary.episodes[measure].notna().any():
        return None
    rows = []
    for panel, frame in _list_panels(summary, panels):
        for values, own in group_episodes(summary, [*lines, x], frame):
            at, line = values[x], {key: values[key] for key in lines}
            published = find_published(summary, own) if measure == "regret" else {}
            tick = at if isinstance(at, float) else value_title(x, at)
            names: dict[str, Any] = {"panel": panel, "line": label(line), "x": tick}
            names["hollow"] = published.get(str(line.get("solver")))
            rows.append(names | vars(estimate(summary, own, measure)))
    points = pd.DataFrame(rows).astype({"hollow": float}).dropna(subset=["mean"])
    return draw(points, AXES.get(x, heading(x)), TITLES[measure], _count_per_row(summary, panels))


def belief_over_steps(summary: Summary) -> Figure | None:
    """Draws the belief in the user's true type after each step: the mean over the episodes that
    have this step. The other plots have a key, such as λ, on the horizontal axis. This plot shows
    only one value of this key: λ = 1 if the key is λ and has this value, otherwise the middle one
    of its values. Returns None if there is no belief to draw."""
    x, lines, panels = plot_keys(summary)
    fixed: dict[str, Value] = {}
    if x is not None:
        values = summary.values(x)
        fixed = {x: 1.0 if x == "lambda" and 1.0 in values else values[len(values) // 2]}
    steps, rows = select_rows(summary.steps, fixed), []
    steps = steps[steps["solver"] != "baseline"]  # it has no belief
    if steps.empty:
        return None
    for panel, frame in _list_panels(summary, panels, steps):
        for line, own in group_episodes(summary, lines, frame):
            weighed = own.assign(belief=own["belief"] * own["episodes"]).groupby("step")
            sums = weighed[["belief", "episodes"]].sum()
            names = {"panel": panel, "line": label(line), "x": sums.index}
            rows.append(pd.DataFrame(names | {"mean": sums["belief"] / sums["episodes"]}))
    words = ", ".join(filter(None, ["belief in the true type", label(fixed)]))
    return draw(pd.concat(rows), "steps explained", words, _count_per_row(summary, panels))


def disagreements(curve: Sequence[float], found: int, rule: str) -> Figure:
    """Draws disagreements against the number of types, with the chosen number."""
    points, words = dict(enumerate(curve, 1)), f"chosen: {found} ({rule})"
    return _draw_choice(points, min(found, len(points)), "disagreements (pairs of labels)", words)


def posterior(probability: Mapping[int, float], found: int) -> Figure:
    """Draws P(number of types | labels), with the chosen number."""
    points = {k: probability.get(k, 0.0) for k in range(1, max(*probability, found) + 2)}
    return _draw_choice(points, found, "posterior probability", f"taken: {found}")


def _draw_choice(curve: Mapping[int, float], chosen: int, y_label: str, words: str) -> Figure:
    """Draws a curve over the number of types, with a mark at the chosen number."""
    rows = [
        {"panel": "", "line": "", "x": k, "mean": y, "hollow": y if k == chosen else None}
        for k, y in curve.items()
    ]
    return draw(pd.DataFrame(rows), "number of user types", y_label, hollow=words)


def effects(dataset: Dataset, clustering: Clustering, names: Sequence[str]) -> Figure:
    """Draws the share of labels 1 with a message minus the share without it, with a panel for each
    type. There is no point if one of the two shares is unknown."""
    given = pd.DataFrame(bits_of(dataset.message_set, dataset.n_messages).astype(bool))
    labels = given.assign(label=dataset.label, panel=clustering.assignment[dataset.observer])
    one = labels.melt(["panel", "label"], var_name="x", value_name="given")
    shares = one.pivot_table("label", ["panel", "x"], "given", sort=False)
    shares = shares.reindex(columns=[False, True])  # a message may be in all answers, or in none
    gain = 100 * (shares[True] - shares[False])
    points = gain.rename("mean").reset_index().assign(line="").sort_values("panel", kind="stable")
    for key, texts in (("panel", names), ("x", dataset.messages)):
        points[key] = points[key].map(dict(enumerate(texts)))
    return draw(points, "message", "explicable labels in %:\ngiven − not given")


def calibration(bins: Sequence[CalibrationBin]) -> Figure:
    """Draws the share of held-out labels that are 1 against their predicted probability, with
    intervals."""
    found = pd.DataFrame(bins).rename(columns={"said": "x", "ones": "mean"})
    ideal = pd.DataFrame({"x": [0.0, 1.0], "mean": [0.0, 1.0], "line": "as predicted"})
    points = pd.concat([found.assign(line="held-out labels"), ideal]).assign(panel="")
    parts = f"{len(bins)} parts of at least {found['labels'].min()} labels"
    return draw(points, f"predicted probability of label 1\n({parts})", "share of labels 1")


@matplotlib.rc_context(STYLE)
def save(figure: Figure, path: Path) -> None:
    """Writes a figure atomically, in the format of the path's suffix.

    Raises:
        OSError: the file cannot be written; the error names the path.
    """
    # Without dates and random ids the same figure gives the same file.
    metadata = {"Date": None} if path.suffix == ".svg" else None
    with open_atomic(path, "wb") as file:
        figure.savefig(file, format=path.suffix[1:], metadata=metadata)
