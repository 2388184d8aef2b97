"""The outputs folder, with its runs, sweeps and results."""

import logging
import os
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from xplain.errors import InputError, first_line
from xplain.experiment.results import RESULTS, load_results
from xplain.report.folder import SWEEP, SweepFolder

log = logging.getLogger(__name__)


@contextmanager
def attempt(otherwise: str) -> Iterator[None]:
    """Runs a block of work after the results are saved. If the block fails, its error is logged as
    a warning and not raised.

    Args:
        otherwise: beginning of the warning, which says what is missing now.
    """
    try:
        yield
    except (BrokenPipeError, SystemExit) as error:  # rich turns the first error into the second
        if not isinstance(error.__context__ or error, BrokenPipeError):
            raise
        log.warning("%s: nobody reads the output any more (closed pipe)", otherwise)
        # Python writes the rest of the buffer at its end.
        with suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        log.warning("%s: %s", otherwise, first_line(error)[:300])
        log.debug("it failed", exc_info=True)


def without_passwords(text: str) -> str:
    """Removes user names and passwords from the addresses in a text."""
    return re.sub(r"://[^/@\s'\"]+@", "://***@", text)


@contextmanager
def alone(folder: Path, waiting: str) -> Iterator[None]:
    """Locks a sweep during a block; logs ``waiting`` if another process has the lock."""
    lock = FileLock(folder / "sweep.lock")  # makes the folder too
    try:
        held = lock.acquire(blocking=False)
    except Timeout:
        log.info("%s: %s", folder.name, waiting)
        held = lock.acquire()
    with held:
        yield


class Disk:
    """Keeps results only on disk (``tracking=none``); subclasses also send them elsewhere."""

    def log(self, folder: Path, outputs: Path) -> list[str]:
        """Records a finished run or sweep. Never raises, because the results are on disk.

        Args:
            folder: folder of the run or sweep.
            outputs: the outputs folder.

        Returns:
            Lines for the terminal that say where the results are.
        """
        return []


_NO_RESULTS = {"artifacts", "cache", "report", "results"}
"""Folders below the outputs folder that are not searched for runs and sweeps."""


def runs_and_sweeps(outputs: Path) -> Iterator[Path]:
    """Yields the folders of all finished runs and of all sweeps, oldest path first."""
    for place, folders, files in os.walk(outputs):
        folders[:] = sorted(name for name in folders if name not in _NO_RESULTS)
        if SWEEP in files or RESULTS in files:
            yield Path(place)


def newest_sweep(outputs: Path) -> Path:
    """Returns the folder of the sweep whose list was written last.

    Raises:
        InputError: there is no sweep.
    """
    for path in sorted(outputs.glob(f"sweeps/*/{SWEEP}"), key=lambda p: -p.stat().st_mtime):
        with suppress(InputError):  # a damaged sweep is skipped
            _ = SweepFolder(path.parent).about
            return path.parent
    raise InputError("folder", str(outputs / "sweeps"), "a folder of a sweep; here is no sweep")


def find_unlisted_results(outputs: Path) -> dict[Path, int]:
    """Finds the results that belong to no run or sweep in the outputs folder. Returns
    ``{folder of the result: its size in bytes}``.

    Raises:
        InputError: the list of a sweep cannot be read, so its results are unknown.
        OSError, ValueError: the results of a run cannot be read.
    """
    kept = {path.name for path in outputs.glob("sweeps/*/jobs/*")}
    for folder in runs_and_sweeps(outputs):
        if (folder / SWEEP).exists():
            kept |= {job.fingerprint for job in SweepFolder(folder).jobs}
        else:
            kept.add(load_results(folder).fingerprint)
    others = [path for path in sorted(outputs.glob("results/*/")) if path.name not in kept]
    return {path: sum(file.stat().st_size for file in path.iterdir()) for path in others}


def delete_result(folder: Path) -> None:
    """Deletes a result. First deletes the file that marks the result as complete, so that nobody
    reads an incomplete result."""
    (folder / RESULTS).unlink(missing_ok=True)
    shutil.rmtree(folder)
