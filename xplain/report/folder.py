"""A sweep on disk: its jobs, and the state of each job.

``sweep.json`` lists the jobs with the fingerprints of their results. A job is finished if the
folder of its result has ``results.json``. If the job failed, its own folder below ``jobs/`` has
``failure.json`` with the reason. Both files are written atomically.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from xplain.errors import InputError
from xplain.experiment.results import RESULTS

SWEEP, FAILURE = "sweep.json", "failure.json"


@dataclass(frozen=True)
class ListedJob:
    """A job in its sweep's list.

    Attributes:
        label: readable name, in MLflow and in messages.
        overrides: overrides from which Hydra makes the job's configuration.
        values: the swept keys and their values in the job's configuration, as text.
        fingerprint: fingerprint of the job's result.
    """

    label: str
    overrides: tuple[str, ...]
    values: Mapping[str, str]
    fingerprint: str


@dataclass(frozen=True)
class SweepFolder:
    """The folder of one sweep."""

    path: Path

    @cached_property
    def about(self) -> dict[str, Any]:
        """The content of the sweep's file: the command, the jobs, and the settings of the report.

        Raises:
            OSError: the file is missing.
            InputError: the file is damaged.
        """
        path = self.path / SWEEP
        with suppress(ValueError, AttributeError):
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if {"command", "results"} <= content.keys() and isinstance(content["jobs"], list):
                return content
        raise InputError(
            "sweep", str(path), "a file that is not damaged; the sweep's command repairs it"
        )

    @cached_property
    def jobs(self) -> tuple[ListedJob, ...]:
        """The jobs, in order."""
        return tuple(
            ListedJob(**{**job, "overrides": tuple(job["overrides"])}) for job in self.about["jobs"]
        )

    def of(self, job: ListedJob) -> Path:
        """Returns the job's own folder in the sweep, whether the folder exists or not."""
        return self.path / "jobs" / job.fingerprint

    def address(self, job: ListedJob) -> Path:
        """Returns the folder where the job's result is stored, whether the folder exists or not."""
        return self.path / str(self.about["results"]) / job.fingerprint

    def state(self, job: ListedJob) -> Literal["waiting", "finished", "failed"]:
        """Returns the state of the job."""
        if (self.address(job) / RESULTS).exists():
            return "finished"
        return "failed" if (self.of(job) / FAILURE).exists() else "waiting"

    def error(self, job: ListedJob) -> str:
        """Reads the reason of the job's failure, in one line."""
        return str(json.loads((self.of(job) / FAILURE).read_text(encoding="utf-8"))["error"])
