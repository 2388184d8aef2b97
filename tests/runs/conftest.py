"""One finished sweep for all tests that compare with it."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.runs import sweeps


class Finished(NamedTuple):
    """A sweep of six jobs, on all cores, that nothing happened to."""

    folder: Path
    output: str
    seconds: float


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Whoever takes something out of its folder has it made again."""
    folder = tmp_path_factory.mktemp("finished")
    before = time.monotonic()
    code, output = sweeps.run(folder, *sweeps.TINY)
    assert code == 0, output
    return Finished(folder, output, time.monotonic() - before)
