"""The folder of a sweep: who has it, and what states its files say."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import pytest

from xplain.runs.folder import SweepFolder


def test_one_at_a_time_has_a_sweep_also_before_its_folder_is_there(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    folder = SweepFolder(tmp_path / "sweeps" / "new-1")
    order = []

    def second() -> None:
        with folder.alone("another process has it"):
            order.append("second")

    with folder.alone("nobody has it"):
        waiting = threading.Thread(target=second)
        waiting.start()
        while "another process has it" not in caplog.messages and waiting.is_alive():
            waiting.join(0.05)
        order.append("first")
    waiting.join()
    assert order == ["first", "second"]
    assert "nobody has it" not in caplog.messages
