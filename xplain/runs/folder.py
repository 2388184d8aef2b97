"""A sweep on disk: what its jobs are, and how far each one is.

The folder is the truth. Each job has a folder of its own below ``jobs/``; where ``results.json``
is, the job is finished; ``failure.json`` says why it failed; ``started.json`` that a worker took
it. All three are written whole or not at all, so a kill at any moment leaves one of these states.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from xplain.errors import InputError
from xplain.experiment.results import RESULTS, load_results
from xplain.report.summary import SWEEP, load_sweep
from xplain.runs.plan import Job, Plan
from xplain.runs.terminal import without_passwords
from xplain.storage import write_text

FAILURE = "failure.json"
STARTED = "started.json"

State = Literal["waiting", "running", "finished", "failed"]


@dataclass(frozen=True)
class SweepFolder:
    """The folder of one sweep."""

    path: Path

    @property
    def identity(self) -> str:
        """Name of the folder: the sweep's name and the digest of its jobs."""
        return self.path.name

    @contextmanager
    def alone(self, waiting: str) -> Iterator[None]:
        """Holds the sweep's lock; tells ``waiting`` when another process has it."""
        import logging

        from filelock import FileLock, Timeout

        self.path.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.path / "sweep.lock")
        try:
            held = lock.acquire(timeout=1)
        except Timeout:
            logging.getLogger(__name__).info(waiting)
            held = lock.acquire()
        with held:
            yield

    def save(self, plan: Plan, about: dict[str, Any]) -> None:
        """Writes down what the sweep is (once, or anew where it is damaged: the first command stays
        the one on record)."""
        try:
            load_sweep(self.path)
        except (OSError, InputError):
            content = {"name": plan.name, **about, "jobs": [asdict(job) for job in plan.jobs]}
            text = json.dumps(content, indent=1) + "\n"
            write_text(self.path / SWEEP, without_passwords(text))

    def jobs(self) -> tuple[Job, ...]:
        """The jobs in the order in which the sweep runs them."""
        return tuple(
            Job(**{**job, "overrides": tuple(job["overrides"])})
            for job in load_sweep(self.path)["jobs"]
        )

    def of(self, job: Job) -> Path:
        """Path of the job's own folder, whether it exists or not."""
        return self.path / "jobs" / job.name

    def state(self, job: Job) -> State:
        """How far the job is."""
        folder = self.of(job)
        if (folder / RESULTS).exists():
            return "finished"
        if (folder / FAILURE).exists():
            return "failed"
        return "running" if (folder / STARTED).exists() else "waiting"

    def checked_state(self, job: Job) -> State:
        """The state, after reading the results: with those of another fingerprint, or unreadable
        ones, the job is as good as not begun."""
        state = self.state(job)
        with suppress(ValueError):
            if state != "finished" or load_results(self.of(job)).stamp == job.fingerprint:
                return state
        return "waiting"

    def worker(self, job: Job) -> str:
        """Host and number of the process that ran the job."""
        return (self.of(job) / STARTED).read_text(encoding="utf-8")

    def result_id(self, job: Job) -> str:
        """What the job's result is called in MLflow."""
        return hashlib.sha256(f"{self.identity} {job.fingerprint}".encode()).hexdigest()[:32]

    def failure(self, job: Job) -> dict[str, str]:
        """Error and traceback of a failed job."""
        return json.loads((self.of(job) / FAILURE).read_text(encoding="utf-8"))

    def clear(self, job: Job) -> None:
        """Forgets how far the job was; the other files are written over."""
        for name in (RESULTS, FAILURE, STARTED):
            (self.of(job) / name).unlink(missing_ok=True)


def job_of(folder: Path) -> tuple[SweepFolder, Job] | None:
    """The sweep and the job whose folder this is; None for a run on its own."""
    sweep = SweepFolder(folder.parents[1])
    if folder.parent.name != "jobs" or not (sweep.path / SWEEP).exists():
        return None
    return next(((sweep, job) for job in sweep.jobs() if job.name == folder.name), None)


def mark_started(folder: Path) -> None:
    """This process took the job."""
    write_text(folder / STARTED, json.dumps(_here()) + "\n")


def is_ours(folder: Path) -> bool:
    """Whether no other process took the job since: the worker of a sweep that was killed may
    live on while the job runs anew."""
    try:
        return bool(json.loads((folder / STARTED).read_text(encoding="utf-8")) == _here())
    except (OSError, ValueError):
        return False


def _here() -> dict[str, Any]:
    return {"host": socket.gethostname(), "pid": os.getpid()}


def mark_failed(folder: Path, error: BaseException) -> None:
    """Writes the error of a job that raised, with its traceback, into its folder."""
    text = " ".join(str(error).split()) or "no message"
    content = {
        "error": f"{type(error).__name__}: {text}",
        "traceback": "".join(traceback.format_exception(error)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FAILURE, json.dumps(content, indent=1) + "\n")
