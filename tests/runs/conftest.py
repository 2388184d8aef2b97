"""One finished sweep for all tests that compare with it, and one empty store for new sweeps."""

import os
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest
from filelock import FileLock

from tests import forked
from tests.runs import sweeps


class Finished(NamedTuple):
    """A sweep of four jobs, on all cores, without any failure."""

    folder: Path
    output: str
    seconds: float


def once(factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], None]) -> Path:
    """Returns a folder that one test process fills for all of them."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder, done = root / name, root / f"{name}.done"
    with FileLock(root / f"{name}.lock"):
        if not done.exists():
            folder.mkdir()
            fill(folder)
            done.touch()
    return folder


def _finish(folder: Path, store: Path) -> None:
    (folder / "outputs").mkdir()
    shutil.copy(store, folder / "outputs" / store.name)
    before = time.monotonic()
    code, output = sweeps.run(folder, *sweeps.TINY)
    assert code == 0, output
    (folder / "seconds.txt").write_text(str(time.monotonic() - before))


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory, empty_store: Path) -> Finished:
    """Copies the finished sweep, so that tests may change the copy."""
    folder = tmp_path_factory.mktemp("own") / "finished"
    fill = partial(_finish, store=empty_store)
    shutil.copytree(once(tmp_path_factory, "finished", fill), folder)
    read = [(folder / name).read_text() for name in ("output.txt", "seconds.txt")]
    return Finished(folder, read[0], float(read[1]))


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Makes MLflow's database before the first run."""
    folder = once(tmp_path_factory, "store", lambda path: forked.make_store(path / "mlflow.db"))
    return folder / "mlflow.db"


@pytest.fixture
def folder(tmp_path: Path, empty_store: Path) -> Path:
    """Makes a folder with only MLflow's database, so that its tables need not be made."""
    (tmp_path / "outputs").mkdir()
    shutil.copy(empty_store, tmp_path / "outputs" / "mlflow.db")
    return tmp_path
