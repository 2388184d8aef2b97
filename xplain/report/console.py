"""A sweep's table on the terminal."""

from __future__ import annotations

import sys

from rich.console import Console

from xplain.experiment.progress import is_terminal
from xplain.report.comparison import answer, main_table, undecided
from xplain.report.story import counted
from xplain.report.summary import Summary

WIDTH = 100
"""Columns where the output is no terminal; a wider table takes what it needs."""


def print_sweep(summary: Summary) -> None:
    """The sweep's table on standard output, and who costs least."""
    table = main_table(summary)
    shown = table.shown()
    needed = Console(width=10_000).measure(shown).maximum
    count = len(undecided(summary).rows)
    more = f"{counted(count, 'undecided difference')}: the report says what would decide each."
    below = ((answer(summary), WIDTH), (more if count else "", WIDTH), (table.caption, WIDTH))
    for text, width in ((table.about, needed), (shown, needed), *below):
        columns = None if is_terminal(sys.stdout) else max(WIDTH, width)
        if text:
            Console(highlight=False, markup=False, width=columns).print(text)
