"""What a sweep still has to do: results that are there already, wherever below the outputs folder,
are not made twice."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from xplain.experiment.results import RESULTS, load_results, save_results
from xplain.report.summary import SWEEP
from xplain.runs.folder import FAILURE, STARTED, State, SweepFolder
from xplain.runs.plan import Job, Plan

_NO_RESULTS = {"artifacts", "cache", "report"}
"""Folders below the outputs that hold copies or none: MLflow's files, prepared work, reports."""


@dataclass(frozen=True)
class Todo:
    """What one start of a sweep does; jobs go by their fingerprints.

    Attributes:
        finished: done already.
        copied: where the same results are already, outside of this sweep.
        run: all others that were asked for, in the sweep's order.
    """

    finished: tuple[str, ...]
    copied: Mapping[str, Path]
    run: tuple[str, ...]


def decide(states: Mapping[str, State], resume: str, elsewhere: Mapping[str, Path]) -> Todo:
    """What is to be done; no file is touched here.

    Args:
        states: of all jobs, in the sweep's order.
        resume: ``missing`` (all that is not finished), ``failed`` (only jobs that failed) or
            ``none`` (all of them anew, copying none).
        elsewhere: folders of finished results that may be copied.
    """
    if resume == "none":
        return Todo((), {}, tuple(states))
    finished = tuple(key for key, state in states.items() if state == "finished")
    wanted = [
        key
        for key, state in states.items()
        if (state == "failed" if resume == "failed" else state != "finished")
    ]
    copied = {key: elsewhere[key] for key in wanted if key in elsewhere}
    return Todo(finished, copied, tuple(key for key in wanted if key not in copied))


def todo_of(plan: Plan, folder: SweepFolder, outputs: Path, resume: str) -> Todo:
    """What is to be done by the files below the outputs; ``resume`` as of :func:`decide`."""
    states = {job.fingerprint: folder.checked_state(job) for job in plan.jobs}
    missing = [key for key, state in states.items() if state != "finished"]
    elsewhere = {} if resume == "none" else finished_elsewhere(outputs, missing, folder.path)
    return decide(states, resume, elsewhere)


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
        target.mkdir(parents=True, exist_ok=True)
        for path in source.iterdir():
            if path.is_file() and path.name not in (RESULTS, STARTED, FAILURE):
                shutil.copy2(path, target / path.name)
    except (OSError, ValueError):
        sweep.clear(job)
        return False
    own = replace(results, id=sweep.result_id(job), name=job.label)
    save_results(target, own)
    return True
