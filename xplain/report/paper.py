"""The paper's published numbers (Table 1; values cut to two decimals there)."""

from __future__ import annotations

import csv
from functools import cache
from importlib.resources import files


@cache
def table1() -> dict[tuple[str, float], dict[str, float]]:
    """``{(domain, λ): {"oracle": cost, solver: regret, …}}``."""
    text = files("xplain.report").joinpath("paper_table1.csv").read_text(encoding="utf-8")
    rows = csv.DictReader(text.splitlines())
    return {
        (row["domain"], float(row["lambda"])): {
            name: float(value) for name, value in row.items() if name not in ("domain", "lambda")
        }
        for row in rows
    }
