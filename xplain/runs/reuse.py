"""Results that are there already, wherever below the outputs folder: nothing runs twice."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

from xplain.experiment.results import RESULTS, load_results, save_results
from xplain.runs.folder import FAILURE, STARTED, SWEEP, SweepFolder, result_id
from xplain.runs.plan import Job

_NO_RESULTS = {"artifacts", "cache", "report"}
"""Folders below the outputs that hold copies or none: MLflow's files, prepared work, reports."""


def finished_below(outputs: Path) -> Iterator[tuple[str, Path]]:
    """(fingerprint, folder) of every finished run and job of a sweep, oldest path first."""
    for place, folders, files in os.walk(outputs):
        folder = Path(place)
        folders[:] = sorted(name for name in folders if name not in _NO_RESULTS)
        if SWEEP in files:
            folders.clear()
            yield from _of_sweep(SweepFolder(folder))
        elif RESULTS in files:
            stamp = _stamp(folder)
            if stamp:
                yield stamp, folder


def finished_elsewhere(outputs: Path, wanted: Collection[str]) -> dict[str, Path]:
    """``{fingerprint: folder}`` of those wanted that are finished below the outputs folder."""
    found: dict[str, Path] = {}
    for stamp, folder in finished_below(outputs):
        if stamp in wanted:
            found.setdefault(stamp, folder)
            if len(found) == len(wanted):
                break
    return found


def copy_finished(outputs: Path, sweep: SweepFolder, jobs: list[Job]) -> list[Job]:
    """Gives the sweep a copy of each job's results where a run or another sweep has them;
    returns those jobs."""
    found = finished_elsewhere(outputs, {job.fingerprint for job in jobs}) if jobs else {}
    return [
        job
        for job in jobs
        if job.fingerprint in found and _copy(found[job.fingerprint], sweep, job)
    ]


def _copy(source: Path, sweep: SweepFolder, job: Job) -> bool:
    """Copies the files, and writes the results under the job's own name last of all."""
    try:
        results = load_results(source)
        if results.stamp != job.fingerprint:
            return False
        sweep.clear(job)
        target = sweep.of(job)
        target.mkdir(parents=True)
        for path in source.iterdir():
            if path.is_file() and path.name not in (RESULTS, STARTED, FAILURE):
                shutil.copy2(path, target / path.name)
    except (OSError, ValueError):  # removed or damaged meanwhile: the job runs
        sweep.clear(job)
        return False
    own = replace(results, id=result_id(sweep.identity, job), name=job.label)
    save_results(target, own)
    return True


def _of_sweep(sweep: SweepFolder) -> Iterator[tuple[str, Path]]:
    try:
        jobs = sweep.jobs()
    except (OSError, ValueError, KeyError, TypeError):
        return
    for job in jobs:
        if sweep.state(job) == "finished":
            yield job.fingerprint, sweep.of(job)


def _stamp(folder: Path) -> str:
    try:
        return str(json.loads((folder / RESULTS).read_text(encoding="utf-8")).get("stamp", ""))
    except (OSError, ValueError, AttributeError):
        return ""
