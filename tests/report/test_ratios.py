"""Ratios of costs by kind of people, computed by hand."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from xplain.report.ratios import compute_ratios

COSTS = {
    ("exact", "qmdp"): 2.0,
    ("exact", "say_all"): 6.0,
    ("exact", "conformant"): 4.0,
    ("coin", "qmdp"): 9.0,
    ("coin", "say_all"): 6.0,
    ("coin", "conformant"): 3.0,
}


def test_a_ratio_is_to_the_best_other_way() -> None:
    rows = [
        {"domain": "rescue", "lambda": 1.0, "explainee": kind, "solver": solver, "seed": seed,
         "trace": trace, "type": "A", "cost": cost * (1 + seed)}
        for (kind, solver), cost in COSTS.items()
        for seed, trace in product(range(3), range(2))
    ]  # fmt: skip
    frame = pd.DataFrame(rows)
    summary: Any = SimpleNamespace(
        posed=["domain", "explainee"],
        ways=["solver"],
        pool=(),
        replicate="seed",
        episodes=frame,
        values=lambda key: list(dict.fromkeys(frame[key])),
    )
    found = compute_ratios(summary).frame.set_index("explainee")
    assert found.columns.tolist()[:2] == ["Domain", "QMDP"]
    ratio = {kind: [float(cell.split()[0]) for cell in found.loc[kind][1:]] for kind in found.index}
    assert ratio["exact"] == pytest.approx([0.5, 3, 2])
    assert ratio["coin"] == pytest.approx([3, 2, 0.5])
    assert ratio["all"] == pytest.approx([1.22, 2.45, 1.0])
