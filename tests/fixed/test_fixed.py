"""The reference runs give their stored results."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from tests.fixed.commands import RUNS


def differences(kept: Any, now: Any, where: str = "") -> list[str]:
    """Lists the differences of two results: any difference of text and whole numbers, and
    differences above 1e-9 of other numbers."""
    if isinstance(kept, dict) and isinstance(now, dict) and kept.keys() == now.keys():
        pairs = [(f"{where}/{key}", kept[key], now[key]) for key in kept]
    elif isinstance(kept, list) and isinstance(now, list) and len(kept) == len(now):
        pairs = [(f"{where}[{i}]", *both) for i, both in enumerate(zip(kept, now, strict=True))]
    else:
        return [] if alike(kept, now) else [f"{where}: {kept!r} was kept, now {now!r}"]
    return [line for at, a, b in pairs for line in differences(a, b, at)]


def alike(kept: Any, now: Any) -> bool:
    """True if two values are equal, or numbers (also as text in a table) within 1e-9, or missing in
    both."""
    if kept == now:
        return True
    try:
        a, b = float(kept), float(now)
        return math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9) or (math.isnan(a) and math.isnan(b))
    except (TypeError, ValueError):
        return False


LONG = ("rescue", "paper")
"""Runs that take a minute or more."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in RUNS]
)
def test_a_run_comes_out_as_it_is_kept(name: str, tmp_path: Path) -> None:
    if name not in ("collection", "study"):
        pytest.importorskip("sklearn", "1.9")  # older trees break ties between splits differently
    kept = json.loads(Path(__file__).with_name(f"{name}.json").read_text(encoding="utf-8"))
    found = differences(kept, json.loads(json.dumps(RUNS[name](tmp_path))))
    assert not found, f"{len(found)} values differ: " + "; ".join(found[:5])


def test_differences_are_seen() -> None:
    kept = {"cost": 2.5, "messages": [["fire"], []], "rows": [["a", "0.25"]], "none": math.nan}
    assert not differences(kept, kept | {"cost": 2.5 + 1e-12, "none": math.nan})
    for other in (
        {"cost": 2.5001},
        {"messages": [[], ["fire"]]},
        {"rows": [["a", "0.250001"]]},
        {"rows": [["a"]]},
        {"cost": math.nan},
        {"more": 1},
    ):
        assert differences(kept, kept | other), other
