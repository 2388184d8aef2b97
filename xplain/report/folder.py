"""A sweep on disk: which jobs it has, and how far each one is.

``sweep.json`` lists the jobs with the fingerprints of their results. A job is finished where its
result's address has ``results.json``; where it failed, ``failure.json`` in its own folder below
``jobs/`` says why. Both are written whole or not at all.
"""

from __future__ import annotations

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
    values: Mapping[str, str]
    fingerprint: str


@dataclass(frozen=True)
class SweepFolder:
    """The folder of one sweep."""

    path: Path

    @cached_property
    def about(self) -> dict[str, Any]:
        """The content of its file: its command, its jobs, how it is reported.

        Raises:
            OSError: there is no such file.
            InputError: it is damaged.
        """
        path = self.path / SWEEP
        with suppress(ValueError, AttributeError):
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if {"command", "results"} <= content.keys() and isinstance(content["jobs"], list):
                return content
        raise InputError("sweep", str(path), "is damaged; the sweep's own command writes it anew")

    @cached_property
    def jobs(self) -> tuple[Listed, ...]:
        """The jobs, in their order."""
        return tuple(
            Listed(**{**job, "overrides": tuple(job["overrides"])}) for job in self.about["jobs"]
        )

    def of(self, job: Listed) -> Path:
        """Path of the job's own folder, whether it exists or not."""
        return self.path / "jobs" / job.fingerprint

    def address(self, job: Listed) -> Path:
        """Where the job's result is, or will be."""
        return self.path / str(self.about["results"]) / job.fingerprint

    def state(self, job: Listed) -> Literal["waiting", "finished", "failed"]:
        """How far the job is."""
        if (self.address(job) / RESULTS).exists():
            return "finished"
        return "failed" if (self.of(job) / FAILURE).exists() else "waiting"

    def error(self, job: Listed) -> str:
        """Why the job failed, in a line."""
        return str(json.loads((self.of(job) / FAILURE).read_text(encoding="utf-8"))["error"])
