"""A sweep's table on the terminal."""

from __future__ import annotations

import math
import sys

from rich.console import Console
from rich.table import Table

from xplain.report import tables
from xplain.report.combinations import heading
from xplain.report.paper import title
from xplain.report.regret_table import BEST, regret_table, table_caption
from xplain.report.summary import Summary
from xplain.report.tables import Entry, interval, number

WIDTH = 100
"""Columns where the output is no terminal; a wider table takes what it needs."""


def print_sweep(summary: Summary) -> None:
    """The sweep's table on standard output; Table 1 with the paper's values where it asks for
    it."""
    if summary.report == "table1":
        _print(_table1(summary), "", tables.caption(summary, difference=False))
        return
    table = regret_table(summary)
    shown = Table(box=None, pad_edge=False)
    for key in table.down:
        shown.add_column(heading(key), justify="right" if summary.is_number(key) else "left")
    for head in table.heads:
        shown.add_column(head, justify="right")
    for i, row in enumerate(table.rows):
        headings = table.headings(i)
        if i and len(headings) > 1 and headings[0]:
            shown.add_section()
        cells = []
        for cell in row.cells:
            text = "" if cell is None else cell.text
            # Marks stand below each other, beside the numbers.
            text += "" if not table.marked or (cell and cell.mark) else "  "
            cells.append(f"[bold]{text}[/]" if cell and cell.mark == BEST else text)
        shown.add_row(*headings, *cells)
    _print(shown, table.about, table_caption(summary, table))


def _print(table: Table, about: str, caption: str) -> None:
    wide = Console(highlight=False, width=10_000)
    needed = wide.measure(table).maximum
    console = Console(highlight=False, width=None if sys.stdout.isatty() else max(WIDTH, needed))
    if about:
        console.print(about)
    console.print(table)
    Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH).print(caption)


def _table1(summary: Summary) -> Table:
    """Table 1, the paper's values in parentheses."""
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
        cells = [_table1_cell(own[key]) if key in own else "" for key in keys]
        table.add_row(name, f"{trade_off:g}", *cells)
        last = domain
    return table


def _table1_cell(entry: Entry) -> str:
    lines = [number(entry.estimate.mean)]
    if entry.paper is not None:
        lines[0] += f" ({entry.paper:.2f})"
    if not math.isnan(entry.estimate.low):
        lines.append(interval(entry.estimate))
    return "\n".join(lines)
