"""The paper's Table 1 and its companions, the paper's values beside ours."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pandas as pd

from xplain.interaction.statistics import Estimate
from xplain.report.combinations import csv_text
from xplain.report.measure import NO_REFERENCE
from xplain.report.paper import table1, title
from xplain.report.summary import Summary
from xplain.report.table import Cell, Table

REFERENCES = ("clairvoyant", "oracle")
"""Whose costs stand before the solvers' regrets."""


def numbers(summary: Summary, by_setting: bool = False, measure: str = "regret") -> pd.DataFrame:
    """A row a number of the table: the references' costs, then the regret of each solver.

    Columns: domain, setting, lambda, column, mean, low, high, paper, difference (to the paper;
    both NaN where it has no value), episodes.

    Args:
        summary: of a sweep.
        by_setting: a domain's settings apart; else they are pooled, as in the paper.
        measure: ``regret``, as the paper, ``above_floor`` or ``cost``.
    """
    published = table1() if measure == "regret" else {}
    rows = []
    for domain, setting, trade_off, frame in _cells(summary.episodes, by_setting):
        paper = published.get((domain, trade_off), {})
        for column in (*REFERENCES, *map(str, summary.values("solver"))):
            if column in REFERENCES:
                known = summary.reference(frame, column)
            else:
                known = frame[frame["solver"] == column].dropna(subset=[measure])
            if len(known):
                found = summary.mean(known, column if column in REFERENCES else measure)
                value = paper.get(column, math.nan)
                ends = [found.mean, found.low, found.high, value, found.mean - value]
                rows.append([domain, setting, f"{trade_off:g}", column, *ends, len(known)])
    names = "domain setting lambda column mean low high paper difference episodes"
    return pd.DataFrame(rows, columns=names.split())


def _cells(
    episodes: pd.DataFrame, by_setting: bool
) -> Iterator[tuple[str, str, float, pd.DataFrame]]:
    """(domain, setting or "all", λ, episodes), in the order of the sweep and of λ."""
    frame = episodes if by_setting else episodes.assign(setting="all")
    groups: Any = frame.groupby("domain", sort=False)
    for domain, own in groups:
        for setting, part in own.groupby("setting", sort=False):
            for trade_off, cell in part.groupby("lambda"):
                yield domain, setting, trade_off, cell


def as_csv(summary: Summary, measure: str = "regret") -> str:
    """One line a number, pooled and by setting, six decimals; ``measure`` as of
    :func:`numbers`."""
    frames = [numbers(summary, measure=measure)]
    if any(len(settings) > 1 for settings in summary.settings.values()):
        frames.append(numbers(summary, by_setting=True, measure=measure))
    return csv_text(pd.concat(frames))


def table(summary: Summary, by_setting: bool = False, measure: str = "regret") -> Table:
    """The table in the paper's layout; arguments as of :func:`numbers`."""
    keys = _columns(summary)
    rows = []
    groups: Any = numbers(summary, by_setting, measure).groupby(
        ["domain", "setting", "lambda"], sort=False
    )
    for (domain, setting, trade_off), own in groups:
        cells = {
            row.column: Cell(estimate=Estimate(row.mean, row.low, row.high), paper=row.paper)
            for row in own.itertuples(index=False)
        }
        name = f"{title(domain)} {setting if by_setting else ''}".rstrip()
        rows.append((Cell(name), Cell(trade_off), *(cells.get(key, Cell()) for key in keys)))
    mark = {"oracle": f" {NO_REFERENCE}"} if summary.warning else {}
    heads = ("Domain", "λ", *(title(key) + mark.get(key, "") for key in keys))
    return Table(heads, tuple(rows), 2, _caption(summary, measure))


def _columns(summary: Summary) -> list[str]:
    known = [name for name in REFERENCES if summary.episodes[name].notna().any()]
    return [*known, *map(str, summary.values("solver"))]


def _caption(summary: Summary, measure: str) -> str:
    whose = {
        "regret": "regret (cost minus the oracle's on the same trace and user)",
        "above_floor": "cost minus the clairvoyant's on the same trace and user",
        "cost": "cost",
    }
    paper = "; in parentheses the paper's value, with a sign our difference to it"
    pooled = [
        f" {title(domain)} pools {len(settings)} settings ({'; '.join(settings)})."
        for domain, settings in summary.settings.items()
        if len(settings) > 1
    ]
    return (
        f"Costs of the references, and {whose[measure]} of each method; 95 % intervals over "
        f"{summary.unit} in brackets{paper if measure == 'regret' else ''}.{summary.told_missing}"
        + "".join(pooled)
        + (f" {summary.warning}" if summary.warning else "")
    )
