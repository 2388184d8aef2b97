"""A sweep's table on the terminal."""

from __future__ import annotations

import math
import sys

from rich.console import Console
from rich.table import Table

from xplain.report import tables
from xplain.report.paper import title
from xplain.report.summary import Summary
from xplain.report.tables import Entry, interval, number


def print_sweep(summary: Summary) -> None:
    """Table 1 of a sweep on standard output, the paper's values beneath ours."""
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    keys = tables.columns(summary)
    table = Table(box=None, pad_edge=False, show_lines=False)
    table.add_column("")
    table.add_column("λ", justify="right")
    for key in keys:
        table.add_column(title(key), justify="right")
    last = ""
    for domain, _, trade_off, numbers in tables.grid(summary):
        if domain != last and last:
            table.add_section()
        own = {entry.column: entry for entry in numbers}
        name = title(domain) if domain != last else ""
        cells = [_sweep_cell(own[key]) if key in own else "" for key in keys]
        table.add_row(name, f"{trade_off:g}", *cells)
        last = domain
    console.print(table)
    console.print(tables.caption(summary))


def _sweep_cell(entry: Entry) -> str:
    lines = [number(entry.estimate.mean)]
    if entry.paper is not None:
        lines[0] += f" ({entry.paper:.2f})"
    if not math.isnan(entry.estimate.low):
        lines.append(interval(entry.estimate))
    return "\n".join(lines)
