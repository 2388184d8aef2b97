"""The progress of a run, with a terminal and without."""

import io
import logging
import sys
import time

import pytest

from xplain.report import stages as module
from xplain.report.stages import Stages


class Screen(io.StringIO):
    """A terminal that stores its output."""

    def isatty(self) -> bool:
        return True


def test_without_a_terminal_short_stages_say_nothing_and_long_ones_a_line(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part of a long stage has no line; a stage that ends in an error prints no more."""
    caplog.set_level(logging.INFO, "xplain")
    told = Stages()
    with told.stage("short"):
        assert list(told.track("ab", "part", 2)) == ["a", "b"]
    assert caplog.messages == []
    monkeypatch.setattr(module, "EVERY", 0.1)
    with pytest.raises(KeyError), told.stage("broken"):
        raise KeyError
    with told.stage("long"), told.stage("part"):
        deadline = time.monotonic() + 20
        while not caplog.messages and time.monotonic() < deadline:
            time.sleep(0.01)
    assert caplog.messages == ["long …"]


def test_without_a_terminal_long_stages_tell_how_far_they_are(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO, "xplain")
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    told = Stages()
    for _ in told.track(range(5), "work", 5):
        now[0] += module.EVERY / 2 + 0.1
    assert caplog.messages == ["work: 2 of 5", "work: 4 of 5"]


def test_on_a_terminal_lines_move_and_the_log_is_written_above_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Afterwards the log has its old destination."""
    screen = Screen()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    handler = logging.StreamHandler(screen)
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        told = Stages()
        with told.stage("whole"):
            for item in told.track("abc", "part", 3):
                logging.getLogger("elsewhere").warning("look: %s", item)
                time.sleep(0.2)
            told.note("nearly there")
            time.sleep(0.2)
        assert handler.stream is screen
    finally:
        root.removeHandler(handler)
    text = screen.getvalue()
    for words in ("whole: part: 2 of 3", "whole: nearly there", "look: c"):
        assert words in text
    assert sys.stderr is screen
