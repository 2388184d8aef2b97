"""What the tests share: commands run as a user runs them, in folders of their own."""

from __future__ import annotations

import logging
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tests import forked

ROOT = Path(__file__).parent.parent
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's background job ignores Ctrl-C, and so would all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)

Command = Callable[..., subprocess.CompletedProcess[str]]

LONGEST = (
    "runs/test_sweep.py",
    "runs/test_kill.py",
    "participants/test_browser.py",
    "participants/test_dry_runs.py",
    "participants/test_collect_dry_runs.py",
)
"""Files that take half a minute and more."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files begin first: none is left to one core at the end."""
    first = {ROOT / "tests" / file: place for place, file in enumerate(LONGEST)}
    items.sort(key=lambda item: first.get(item.path, len(first)))


@pytest.fixture(autouse=True)
def logging_left_alone() -> Iterator[None]:
    """Hydra sets the root logger up; its handlers would write to a test's closed streams later."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    yield
    for handler in [one for one in root.handlers if one not in handlers]:
        root.removeHandler(handler)
        handler.close()
    root.setLevel(level)


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """``command("xplain plan", "seed=2")`` runs ``xplain plan seed=2`` in an empty folder, in a
    process of its own."""

    def run(words: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        return forked.captured(tmp_path, *words.split()[1:], *arguments)

    return run


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)
