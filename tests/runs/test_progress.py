"""How far a sweep is: what a watch of its jobs' folders tells, whom, and where."""

from __future__ import annotations

import json
import logging
import sys
import time
from pathlib import Path

import pytest

from tests.runs.sweeps import planned, put
from xplain.experiment.results import RESULTS
from xplain.report import stages
from xplain.runs import progress
from xplain.runs.folder import FAILURE, STARTED, SweepFolder
from xplain.runs.progress import duration, watched


@pytest.fixture
def folder(tmp_path: Path) -> SweepFolder:
    return planned(tmp_path, 4)[1]


def test_every_failure_is_told_once_and_the_last_look_misses_none(
    folder: SweepFolder, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(progress, "POLL", 60)  # no look but the last
    monkeypatch.setattr(stages, "EVERY", 0)
    _, first, second, third = folder.jobs()
    with watched(folder, (first, second, third), done=1):
        put(folder, first, RESULTS)
        put(folder, second, FAILURE, json.dumps({"error": "no memory", "traceback": ""}))
        put(folder, third, STARTED)
    assert f"failed: {second.label}: no memory" in caplog.messages
    assert caplog.messages[-1].startswith("sweep: 3 of 4 jobs done, 1 failed, about ")


def test_a_terminal_sees_a_bar_and_standard_output_nothing(
    folder: SweepFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(progress, "POLL", 0.01)
    jobs = folder.jobs()
    with watched(folder, jobs[2:], done=2):
        put(folder, jobs[2], RESULTS)
        put(folder, jobs[3], RESULTS)
        time.sleep(0.5)  # terminals are drawn on ten times a second
    seen = capsys.readouterr()
    assert "4 of 4 jobs done, 0 failed" in seen.err
    assert seen.out == ""


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.2, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (185, "3 min 05 s"),
        (3599.7, "1 h 00 min"),
        (7500, "2 h 05 min"),
    ],
)
def test_times_are_told_as_people_say_them(seconds: float, words: str) -> None:
    assert duration(seconds) == words
