"""Results that are there already, wherever below the outputs folder: nothing runs twice."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

from xplain.experiment.results import RESULTS, load_results, save_results
from xplain.report.summary import SWEEP
from xplain.runs.folder import FAILURE, STARTED, SweepFolder
from xplain.runs.plan import Job

_NO_RESULTS = {"artifacts", "cache", "report"}
"""Folders below the outputs that hold copies or none: MLflow's files, prepared work, reports."""


def runs_and_sweeps(outputs: Path) -> Iterator[Path]:
    """The folder of every finished run and of every sweep, oldest path first."""
    for place, folders, files in os.walk(outputs):
        folders[:] = sorted(name for name in folders if name not in _NO_RESULTS)
        if SWEEP in files:
            folders.clear()
        if SWEEP in files or RESULTS in files:
            yield Path(place)


def finished_below(outputs: Path) -> Iterator[tuple[str, Path]]:
    """(fingerprint, folder) of every finished run and job of a sweep, oldest path first."""
    for folder in runs_and_sweeps(outputs):
        try:
            if (folder / SWEEP).exists():
                sweep = SweepFolder(folder)
                finished = [job for job in sweep.jobs() if sweep.state(job) == "finished"]
                yield from [(job.fingerprint, sweep.of(job)) for job in finished]
            elif stamp := json.loads((folder / RESULTS).read_text(encoding="utf-8")).get("stamp"):
                yield stamp, folder
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            continue  # cut short, or not ours


def finished_elsewhere(
    outputs: Path, wanted: Collection[str], own: Path | None = None
) -> dict[str, Path]:
    """``{fingerprint: folder}`` of those wanted that are finished below the outputs folder, but not
    in the sweep's own."""
    found: dict[str, Path] = {}
    if wanted:
        for stamp, folder in finished_below(outputs):
            if stamp in wanted and (own is None or not folder.is_relative_to(own)):
                found.setdefault(stamp, folder)
                if len(found) == len(wanted):
                    break
    return found


def copy_results(source: Path, sweep: SweepFolder, job: Job) -> bool:
    """Copies the files of a finished run, and writes the results under the job's own name last of
    all; False where they were removed or damaged meanwhile."""
    sweep.clear(job)
    target = sweep.of(job)
    try:
        results = load_results(source)
        if results.stamp != job.fingerprint:
            return False
        target.mkdir(parents=True)
        for path in source.iterdir():
            if path.is_file() and path.name not in (RESULTS, STARTED, FAILURE):
                shutil.copy2(path, target / path.name)
    except (OSError, ValueError):
        sweep.clear(job)
        return False
    own = replace(results, id=sweep.result_id(job), name=job.label)
    save_results(target, own)
    return True
