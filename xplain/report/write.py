"""Writes the report of a sweep: tables, plots, pictures, one page."""

from __future__ import annotations

from pathlib import Path

from xplain.report import tables
from xplain.report.sweep import Summary
from xplain.storage import write_atomically

REPORT = "report"


def write_report(folder: Path) -> tuple[Summary, Path]:
    """Makes everything below ``<sweep>/report`` anew from the finished jobs.

    Raises:
        OSError, ValueError: this is no sweep's folder, or it cannot be written.
    """
    summary = Summary(folder)
    report = folder / REPORT
    report.mkdir(exist_ok=True)
    if summary.results:
        write_atomically(report / "table1.md", tables.markdown(summary))
        write_atomically(report / "table1.tex", tables.latex(summary))
        write_atomically(report / "table1.csv", tables.as_csv(summary))
        write_atomically(report / "differences.csv", tables.differences_csv(summary))
    return summary, report
