"""The table of a sweep: a row or a column a swept value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from xplain.report.combinations import grouped, heading, regret_apart, value_label, value_title
from xplain.report.layout import shown_keys, table_layout
from xplain.report.summary import Summary, Value
from xplain.report.table import BEST, TIE, Cell, Table

HEADS = {
    "regret": "regret",
    "oracle": "oracle's cost",
    "cost": "cost",
    "messages": "messages",
    "inexplicable labels": "inexplicable labels",
}
"""Measures that are the columns where nothing that was swept can be better or worse."""


def regret_table(summary: Summary) -> Table:
    """Regret of every combination of swept values, but for the keys that the sweep pools."""
    layout = table_layout(summary)
    across = layout.across
    ways = [tuple(values.values()) for values, _ in grouped(summary, across)]
    measures = [name for name in HEADS if summary.episodes[name].notna().any()]
    rows = []
    for values, frame in grouped(summary, layout.down):
        if across:
            own = _marked(summary, frame, across)
            cells = [own.get(way, Cell()) for way in ways]
            known = summary.reference(frame, "oracle")
            if across == ("solver",):
                oracle = summary.mean(known, "oracle") if len(known) else None
                cells = [Cell(estimate=oracle), *cells]
        else:
            cells = [Cell(estimate=summary.estimate(frame, name)) for name in measures]
        headings = (Cell(value_title(key, value) or "–") for key, value in values.items())
        rows.append((*headings, *cells))
    if across:
        heads = ["oracle's cost"] * (across == ("solver",))
        heads += [" ".join(map(_column, across, way)) for way in ways]
    else:
        heads = [HEADS[name] for name in measures]
    about = ("Regret: " if across else "") + _common(summary)
    caption = _caption(summary, [cell for row in rows for cell in row], marked=bool(across))
    names = (*map(heading, layout.down), *heads)
    return Table(names, tuple(rows), len(layout.down), caption, about, halves=True)


def _marked(
    summary: Summary, frame: pd.DataFrame, across: Sequence[str]
) -> dict[tuple[Value, ...], Cell]:
    """Regrets of one row, the least of them marked, and those that cannot be told from it."""
    groups: Any = frame.dropna(subset=["regret"]).groupby(list(across), sort=False)
    means = {way: summary.mean(own, "regret") for way, own in groups}
    best = min(means, key=lambda way: means[way].mean, default=())
    cells = {}
    for way, estimate in means.items():
        mark = BEST
        if round(estimate.mean - means[best].mean, 9) != 0:
            apart = regret_apart(summary, frame, across, way, best)
            mark = TIE if apart is not None and apart.low <= 0 <= apart.high else ""
        cells[way] = Cell(estimate=estimate, mark=mark)
    return cells


def _column(key: str, value: Value) -> str:
    return value_title(key, value) if isinstance(value, str) else value_label(key, value)


def _common(summary: Summary) -> str:
    """What was not swept, as far as a reader wants to know it."""
    keys = shown_keys(summary)
    parts = []
    for key in ("domain", "solver", "lambda"):
        values = summary.values(key)
        if key not in keys and len(values) == 1:
            parts.append(value_label(key, values[0]))
    traces = summary.episodes.groupby("seed")["trace"].nunique().max()
    parts.append(_count(int(traces), "trace"))
    parts.append(_count(summary.seeds, "seed"))
    return ", ".join(parts)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _caption(summary: Summary, cells: Sequence[Cell], marked: bool) -> str:
    """How to read the table."""
    text = "Regret is cost minus the oracle's on the same trace and user."
    if any(cell.ends for cell in cells):
        text += f" ± half-width of the 95 % interval over {summary.unit}."
        if marked:
            text += (
                f" {BEST} least regret of the row; {TIE} not told apart from it: the interval of "
                "the difference on the same traces and users holds 0."
            )
    else:
        text += " One trace and one seed: no intervals."
        if marked:
            text += f" {BEST} least regret of the row."
    if summary.pool:
        text += f" Means over {', '.join(summary.pool)}, as the sweep's file asks."
    return text + summary.told_missing


def markdown(summary: Summary) -> str:
    """The table in Markdown, with its caption."""
    return regret_table(summary).markdown()
