"""Which finished results are found, and in which order."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from xplain.experiment.results import RESULTS
from xplain.runs.reuse import finished_below, finished_elsewhere


def finished(folder: Path, stamp: str) -> Path:
    folder.mkdir(parents=True)
    (folder / RESULTS).write_text(json.dumps({"stamp": stamp}))
    return folder


def test_the_oldest_path_is_found_first_whatever_order_the_disk_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    days = [f"2026-{month:02d}-{day:02d}" for month in (3, 1, 2) for day in (9, 1, 5)]
    made = {finished(tmp_path / "runs" / day, "same") for day in days}
    finished(tmp_path / "cache" / "2025-01-01", "same")  # a copy
    (tmp_path / "runs" / "2026-01-00").mkdir()
    (tmp_path / "runs" / "2026-01-00" / RESULTS).write_text("cut sho")
    real = os.walk

    def backwards(top: Path) -> Iterator[tuple[str, list[str], list[str]]]:
        for place, folders, files in real(top):
            folders.sort(reverse=True)
            yield place, folders, files

    for walk in (real, backwards):
        monkeypatch.setattr(os, "walk", walk)
        found: list[Any] = list(finished_below(tmp_path))
        assert found == [("same", folder) for folder in sorted(made)]
        assert finished_elsewhere(tmp_path, {"same", "other"}) == {"same": min(made)}
