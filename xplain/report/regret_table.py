"""The table of a sweep: a row or a column a swept value, for the terminal, Markdown and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from xplain.evaluation.statistics import Estimate
from xplain.report.combinations import (
    combinations,
    difference,
    grouped,
    heading,
    value_label,
    value_title,
)
from xplain.report.layout import shown_keys, table_layout
from xplain.report.summary import Summary, Value
from xplain.report.tables import number, tex

BEST, TIE = "*", "≈"
HEADS = {
    "regret": "regret",
    "oracle": "oracle's cost",
    "cost": "cost",
    "messages": "messages",
    "inexplicable labels": "inexplicable labels",
}
"""Measures that are the columns where nothing that was swept can be better or worse."""


@dataclass(frozen=True)
class Cell:
    """An estimate, with BEST, TIE or nothing."""

    estimate: Estimate
    mark: str = ""

    @property
    def text(self) -> str:
        """``0.52 ± 0.21 *``: the mean and half of its 95 % interval."""
        parts = [number(self.estimate.mean)]
        if not math.isnan(self.estimate.low):
            parts.append(f"± {number(self.estimate.high - self.estimate.mean)}")
        return " ".join([*parts, self.mark]).rstrip()


@dataclass(frozen=True)
class Row:
    """Values of the keys that go down, and the cells beside them."""

    values: tuple[Value, ...]
    cells: tuple[Cell | None, ...]


@dataclass(frozen=True)
class RegretTable:
    """A table that a person reads.

    Attributes:
        about: what all of it has in common, in words.
        down: keys of the row headings.
        heads: of the columns beside them.
        rows: in the order of the values.
        marked: whether BEST marks the best of each row.
    """

    about: str
    down: tuple[str, ...]
    heads: tuple[str, ...]
    rows: tuple[Row, ...]
    marked: bool

    def headings(self, row: int) -> list[str]:
        """Row headings, without what stands in the row above already."""
        values = self.rows[row].values
        before = self.rows[row - 1].values if row else ()
        same = 0
        while same < len(values) - 1 and before[: same + 1] == values[: same + 1]:
            same += 1
        words = [
            value_title(key, value) or "–" for key, value in zip(self.down, values, strict=True)
        ]
        return [""] * same + words[same:]


def regret_table(summary: Summary) -> RegretTable:
    """Regret of every combination of swept values, but for the keys that the sweep pools."""
    layout = table_layout(summary)
    if not layout.across:
        return _by_measure(summary, layout.down)
    columns = [values for values, _ in grouped(summary, layout.across)]
    oracle = layout.across == ("solver",)
    rows = []
    for values, frame in grouped(summary, layout.down):
        own = _cells(summary, frame, layout.across)
        cells = [own.get(tuple(column.values())) for column in columns]
        first = [_oracle(summary, frame)] if oracle else []
        rows.append(Row(tuple(values.values()), (*first, *cells)))
    heads = [" ".join(_column(key, value) for key, value in c.items()) for c in columns]
    return RegretTable(
        f"Regret: {_common(summary)}",
        layout.down,
        (*(["oracle's cost"] if oracle else []), *heads),
        tuple(rows),
        marked=True,
    )


def _cells(
    summary: Summary, frame: pd.DataFrame, across: Sequence[str]
) -> dict[tuple[Value, ...], Cell]:
    """Regrets of one row, the least of them marked, and those that cannot be told from it."""
    frames: dict[tuple[Any, ...], pd.DataFrame] = {
        tuple(key): own.dropna(subset=["regret"])
        for key, own in frame.groupby(list(across), sort=False)
    }
    means = {key: summary.mean(own, "regret") for key, own in frames.items() if len(own)}
    if not means:
        return {}
    best = min(means, key=lambda key: means[key].mean)
    cells = {}
    for key, estimate in means.items():
        mark = ""
        if round(estimate.mean - means[best].mean, 9) == 0:
            mark = BEST
        else:
            apart = difference(summary, frames[key], frames[best])
            if apart is not None and apart.low <= 0 <= apart.high:
                mark = TIE
        cells[key] = Cell(estimate, mark)
    return cells


def _oracle(summary: Summary, frame: pd.DataFrame) -> Cell | None:
    """The oracle's cost: it is the same in every job of a row, so one solver's will do."""
    for _, own in frame.groupby("solver", sort=False):
        known = own.dropna(subset=["oracle"])
        if len(known):
            return Cell(summary.mean(known, "oracle"))
    return None


def _by_measure(summary: Summary, down: tuple[str, ...]) -> RegretTable:
    found = combinations(summary, down)
    measures = [name for name in HEADS if any(name in c.estimates for c in found)]
    rows = [
        Row(
            tuple(c.values.values()),
            tuple(Cell(c.estimates[m]) if m in c.estimates else None for m in measures),
        )
        for c in found
    ]
    heads = tuple(HEADS[name] for name in measures)
    return RegretTable(_common(summary), down, heads, tuple(rows), marked=False)


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


def table_caption(summary: Summary, table: RegretTable, brackets: bool = False) -> str:
    """How to read the table.

    Args:
        summary, table: of the sweep.
        brackets: whether intervals stand in brackets, or as half of their widths.
    """
    text = "Regret is cost minus the oracle's on the same trace and user."
    if any(cell and not math.isnan(cell.estimate.low) for row in table.rows for cell in row.cells):
        unit = "seeds" if summary.seeds > 1 else "traces"
        what = "In brackets the" if brackets else "± half-width of the"
        text += f" {what} 95 % interval over {unit}."
        if table.marked:
            text += (
                f" {BEST} least regret of the row; {TIE} not told apart from it: the interval of "
                "the difference on the same traces and users holds 0."
            )
    else:
        text += " One trace and one seed: no intervals."
        if table.marked:
            text += f" {BEST} least regret of the row."
    if summary.pool:
        text += f" Means over {', '.join(summary.pool)}, as the sweep's file asks."
    if summary.missing:
        text += f" {summary.missing} of {len(summary.jobs)} jobs are missing."
    return text


def markdown(summary: Summary) -> str:
    """The table in Markdown, with its caption."""
    table = regret_table(summary)
    heads = [*(heading(key) for key in table.down), *table.heads]
    lines = [table.about, "", "| " + " | ".join(heads) + " |"]
    lines.append("|" + "---|" * len(table.down) + "---:|" * len(table.heads))
    for row in table.rows:
        words = [
            value_title(key, value) or "–"
            for key, value in zip(table.down, row.values, strict=True)
        ]
        words += ["" if cell is None else cell.text for cell in row.cells]
        lines.append("| " + " | ".join(words).replace("*", r"\*") + " |")
    return "\n".join([*lines, "", table_caption(summary, table).replace("*", r"\*"), ""])


def latex(summary: Summary) -> str:
    """The table for a paper (booktabs), the best of each row in bold."""
    table = regret_table(summary)
    heads = [*(heading(key) for key in table.down), *table.heads]
    lines = [
        r"% \usepackage{booktabs}",
        rf"\begin{{tabular}}{{{'l' * len(table.down)}{'r' * len(table.heads)}}}",
        r"\toprule",
        " & ".join(tex(head) for head in heads) + r" \\",
        r"\midrule",
    ]
    for i, row in enumerate(table.rows):
        cells = ["" if cell is None else _tex_cell(cell) for cell in row.cells]
        lines.append(" & ".join([*map(tex, table.headings(i)), *cells]) + r" \\")
    about = f"% {table.about}. {table_caption(summary, table)}"
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", about]) + "\n"


def _tex_cell(cell: Cell) -> str:
    text = cell.text.removesuffix(BEST).removesuffix(TIE).rstrip().replace("±", r"\pm")
    if cell.mark == BEST:
        return rf"$\mathbf{{{text}}}$"
    return rf"${text}$" + (r" $\approx$" if cell.mark == TIE else "")
