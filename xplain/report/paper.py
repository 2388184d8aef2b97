"""The paper's published numbers (Table 1; values cut to two decimals there) and its names."""

from __future__ import annotations

import csv
from functools import cache
from importlib.resources import files

NAMES = {
    "oracle": "Oracle's cost",
    "clairvoyant": "Clairvoyant's cost",
    "qmdp": "QMDP",
    "pomcp_paper": "POMCP (d = 2)",
    "pomcp": "POMCP (ours)",
    "certified": "Certified",
    "qhr": "QHR",
    "baseline": "Baseline",
    "conformant": "Conformant",
    "silent": "Silent",
    "say_all": "Say all",
    "four_rooms": "Four rooms",
    "rescue": "Disaster rescue",
}
"""What people call columns and domains. The paper's POMCP looks two steps ahead and backs up means,
so its values stand beside ``pomcp_paper``, not beside our tuned search."""


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


def title(key: str) -> str:
    """A column's or domain's name for people."""
    name, _, rest = key.partition(" ")
    return " ".join(filter(None, [NAMES.get(name, name), rest]))
