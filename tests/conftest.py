"""What the tests share: commands run as a user runs them, in folders of their own."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell's background job ignores Ctrl-C, and so would all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)

Command = Callable[..., subprocess.CompletedProcess[str]]


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
    """``command("xplain plan", "seed=2")`` runs ``python -m xplain plan seed=2`` in an empty
    folder."""

    def run(words: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
        env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))} | environment
        env.pop("MLFLOW_TRACKING_URI", None)
        env |= environment
        return subprocess.run(
            [sys.executable, "-m", *words.split(), *arguments],
            cwd=tmp_path,
            env=env,
            capture_output=True,
            text=True,
            timeout=300,
        )

    return run


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)
