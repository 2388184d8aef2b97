"""One finished sweep for all tests that compare with it, one empty store for those that start."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import NamedTuple

import pytest

from tests import forked
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


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """MLflow's database before the first run."""
    path = tmp_path_factory.mktemp("store") / "mlflow.db"
    forked.make_store(path)
    return path


@pytest.fixture
def folder(tmp_path: Path, empty_store: Path) -> Path:
    """An empty folder but for MLflow's database, whose tables need not be made then."""
    (tmp_path / "outputs").mkdir()
    shutil.copy(empty_store, tmp_path / "outputs" / "mlflow.db")
    return tmp_path
