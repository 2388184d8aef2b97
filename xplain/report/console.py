"""A sweep's table on the terminal."""

from __future__ import annotations

import sys

from rich.console import Console

from xplain.report import paper_table
from xplain.report.regret_table import regret_table
from xplain.report.summary import Summary

WIDTH = 100
"""Columns where the output is no terminal; a wider table takes what it needs."""


def print_sweep(summary: Summary) -> None:
    """The sweep's table on standard output; Table 1 with the paper's values where it asks for
    it."""
    of = paper_table.table if summary.report == "table1" else regret_table
    table = of(summary)
    shown = table.shown()
    needed = Console(width=10_000).measure(shown).maximum
    for text, width in ((table.about, needed), (shown, needed), (table.caption, WIDTH)):
        columns = None if sys.stdout.isatty() else max(WIDTH, width)
        if text:
            Console(highlight=False, markup=False, width=columns).print(text)
