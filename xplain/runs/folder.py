"""A sweep on disk: which jobs it has, and how far each one is.

``sweep.json`` lists the jobs with the fingerprints of their results. A job is finished where its
result's address has ``results.json``; where it failed, ``failure.json`` in its own folder below
``jobs/`` says why. Both are written whole or not at all.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from xplain.errors import InputError
from xplain.experiment.config import GROUPS
from xplain.experiment.results import RESULTS, load_results
from xplain.report.frame import SWEEP, load_sweep
from xplain.runs.terminal import without_passwords
from xplain.storage import write_text

log = logging.getLogger(__name__)

FAILURE = "failure.json"
LISTED = "job.json"
"""In a job's own folder, where another sweeper than ours lists no jobs: what it was."""

_LAST = ("solver", "lambda", "seed")
"""Keys that end a job's label, so that labels sort by setting."""


@dataclass(frozen=True)
class Listed:
    """A job as its sweep lists it.

    Attributes:
        label: for people, in MLflow and in messages.
        overrides: what Hydra makes its configuration from.
        values: the swept keys and the values that its configuration has, as text.
        fingerprint: of its result.
    """

    label: str
    overrides: tuple[str, ...]
    values: dict[str, str]
    fingerprint: str


def listed(jobs: Sequence[Listed]) -> tuple[Listed, ...]:
    """The jobs with the values and labels of swept keys alone: those that differ or that some jobs
    lack."""
    keys = dict.fromkeys(key for job in jobs for key in job.values)
    varying = [key for key in keys if len({job.values.get(key) for job in jobs}) > 1]
    varying = varying or [key for key in ("domain", "solver", "lambda") if key in keys]
    varying.sort(key=lambda key: _LAST.index(key) if key in _LAST else -1)
    found = []
    for job in jobs:
        values = {key: job.values[key] for key in varying if key in job.values}
        found.append(Listed(_label(values), job.overrides, values, job.fingerprint))
    return tuple(found)


def _label(values: Mapping[str, str]) -> str:
    words = []
    for key, value in values.items():
        name = "λ" if key == "lambda" else key.rpartition(".")[2]
        words.append(value if key in GROUPS else f"{name}={value}")
    return " ".join(words) or "only job"


@dataclass(frozen=True)
class SweepFolder:
    """The folder of one sweep."""

    path: Path

    @property
    def identity(self) -> str:
        """Name of the folder."""
        return self.path.name

    @contextmanager
    def alone(self, waiting: str) -> Iterator[None]:
        """Holds the sweep's lock; tells ``waiting`` when another process has it."""
        self.path.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.path / "sweep.lock")
        try:
            held = lock.acquire(timeout=1)
        except Timeout:
            log.info(waiting)
            held = lock.acquire()
        with held:
            yield

    def save(self, jobs: Sequence[Listed], results: Path, about: Mapping[str, Any]) -> None:
        """Writes down what the sweep is: once, or anew where the file is damaged.

        Args:
            jobs: all of them.
            results: folder of all results' addresses.
            about: beside the jobs, such as its command and how it is reported.
        """
        with suppress(OSError, InputError):
            load_sweep(self.path)
            return
        # A path from here: a project may be moved.
        content = {**about, "results": os.path.relpath(results, self.path)}
        text = json.dumps({**content, "jobs": [asdict(job) for job in jobs]}, indent=1) + "\n"
        write_text(self.path / SWEEP, without_passwords(text))

    def jobs(self) -> tuple[Listed, ...]:
        """The jobs, in their order."""
        return tuple(
            Listed(**{**job, "overrides": tuple(job["overrides"])})
            for job in load_sweep(self.path)["jobs"]
        )

    def of(self, job: Listed) -> Path:
        """Path of the job's own folder, whether it exists or not."""
        return self.path / "jobs" / job.fingerprint

    def address(self, job: Listed) -> Path:
        """Where the job's result is, or will be."""
        return self._results / job.fingerprint

    @cached_property
    def _results(self) -> Path:
        return self.path / load_sweep(self.path)["results"]

    def state(self, job: Listed) -> Literal["waiting", "finished", "failed"]:
        """How far the job is."""
        if (self.address(job) / RESULTS).exists():
            return "finished"
        return "failed" if (self.of(job) / FAILURE).exists() else "waiting"

    def failure(self, job: Listed) -> dict[str, str]:
        """Error and traceback of a failed job."""
        return json.loads((self.of(job) / FAILURE).read_text(encoding="utf-8"))


def mark_failed(folder: Path, error: BaseException) -> None:
    """Writes the error of a job that raised, with its traceback, into its folder."""
    text = " ".join(str(error).split()) or "no message"
    content = {
        "error": f"{type(error).__name__}: {text}",
        "traceback": "".join(traceback.format_exception(error)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FAILURE, json.dumps(content, indent=1) + "\n")


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
    lists = sorted(outputs.glob(f"sweeps/*/{SWEEP}"), key=lambda path: -path.stat().st_mtime)
    for path in lists:
        with suppress(InputError):  # a damaged one hides no other
            load_sweep(path.parent)
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
            kept |= {job["fingerprint"] for job in load_sweep(folder)["jobs"]}
        else:
            kept.add(load_results(folder).fingerprint)
    others = [path for path in sorted(outputs.glob("results/*")) if path.name not in kept]
    files = {folder: [*folder.iterdir()] for folder in others if folder.is_dir()}
    return {folder: sum(path.stat().st_size for path in own) for folder, own in files.items()}


def delete_result(folder: Path) -> None:
    """Deletes a result: first what says that it is there, so that nobody reads half of it."""
    (folder / RESULTS).unlink(missing_ok=True)
    shutil.rmtree(folder)
