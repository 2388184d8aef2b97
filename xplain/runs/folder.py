"""The outputs folder: runs, sweeps and results in it, and what is said beside what is saved."""

from __future__ import annotations

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
def attempted(otherwise: str) -> Iterator[None]:
    """What follows the saved results: where it fails, a line says what is missing.

    Args:
        otherwise: what is missing then.
    """
    try:
        yield
    except (BrokenPipeError, SystemExit) as error:  # rich makes the second of the first
        if not isinstance(error.__context__ or error, BrokenPipeError):
            raise
        log.warning("%s: nobody reads the output any more (closed pipe)", otherwise)
        # Python writes what is left in the buffer when it ends.
        with suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Exception as error:
        log.warning("%s: %s", otherwise, first_line(error)[:300])
        log.debug("it failed", exc_info=True)


def without_passwords(text: str) -> str:
    """The text, without user name and password in the addresses that it holds."""
    return re.sub(r"://[^/@\s'\"]+@", "://***@", text)


@contextmanager
def alone(folder: Path, waiting: str) -> Iterator[None]:
    """Holds a sweep's lock; tells ``waiting`` when another process has it."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / "sweep.lock")
    try:
        held = lock.acquire(timeout=1)
    except Timeout:
        log.info("%s: %s", folder.name, waiting)
        held = lock.acquire()
    with held:
        yield


class Disk:
    """Leaves results on disk (``tracking=none``); subclasses send them elsewhere."""

    def log(self, folder: Path, outputs: Path) -> list[str]:
        """Takes note of a run or a sweep that ended. Never raises: the results are on disk.

        Args:
            folder: of the run or sweep.
            outputs: the outputs folder.

        Returns:
            Lines for the terminal: where to look.
        """
        return []


_NO_RESULTS = {"artifacts", "cache", "report", "results"}
"""Folders below the outputs that hold copies or no results of a run's own."""


def runs_and_sweeps(outputs: Path) -> Iterator[Path]:
    """The folder of every finished run and of every sweep, oldest path first."""
    for place, folders, files in os.walk(outputs):
        folders[:] = sorted(name for name in folders if name not in _NO_RESULTS)
        if SWEEP in files:
            folders.clear()
        if SWEEP in files or RESULTS in files:
            yield Path(place)


def newest_sweep(outputs: Path) -> Path:
    """The folder of the sweep whose list was written last.

    Raises:
        InputError: there is none.
    """
    for path in sorted(outputs.glob(f"sweeps/*/{SWEEP}"), key=lambda p: -p.stat().st_mtime):
        with suppress(InputError):  # a damaged one hides no other
            _ = SweepFolder(path.parent).about
            return path.parent
    raise InputError("folder", str(outputs / "sweeps"), "no sweep there; name a sweep's folder")


def unlisted_results(outputs: Path) -> dict[Path, int]:
    """``{folder: bytes}`` of the results that no run and no sweep in the outputs folder has.

    Raises:
        InputError: a sweep whose list cannot be read: its results are not known.
        OSError, ValueError: a run's results that cannot be read.
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
    """Deletes a result: first what says that it is there, so that nobody reads half of it."""
    (folder / RESULTS).unlink(missing_ok=True)
    shutil.rmtree(folder)
