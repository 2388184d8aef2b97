"""Runs a sweep: gives its batches to a launcher, then writes the report and logs to MLflow.

The launcher is one of Hydra's on the command line, and joblib in Python.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.errors import InputError, first_line
from xplain.experiment.fingerprint import code_version, git_state
from xplain.experiment.results import RESULTS
from xplain.report.folder import FAILURE, SWEEP, Listed, SweepFolder
from xplain.report.stages import stages
from xplain.runs.folder import Disk, alone, attempted, without_passwords
from xplain.runs.job import Job, failing_into, save_batch
from xplain.runs.plan import Plan, command, listed, values_of
from xplain.runs.signals import CAME
from xplain.storage import write_text

log = logging.getLogger(__name__)

POLL = 1.0
"""Seconds between looks at how far a sweep is."""

BATCHES, LISTED = "batches", "job.json"
"""In a sweep's folder, the batches of its jobs; and in a job's own, where another sweeper than ours
lists none, what it was."""


def run_missing(plan: Plan, launch: Callable[[list[Path]], Any]) -> Any:
    """Runs the jobs of a plan that have no result, and returns what the launcher does.

    Args:
        plan: of the sweep. With ``dry_run=true`` its jobs are printed.
        launch: runs the batches that these files list.

    Raises:
        KeyboardInterrupt: it was interrupted; what had ended is in MLflow.
    """
    if plan.config.dry_run:
        _print_jobs(plan)
        return None
    folder, jobs, done = plan.folder, plan.jobs, len(plan.finished)
    with alone(folder.path, "another process runs this sweep; waiting for it"):
        outputs = folder.path.parents[1]
        save_sweep(folder.path, jobs, outputs, plan.about)
        words = [f"{len(plan.todo)} jobs to run" if plan.todo else "nothing is missing"]
        words += [f"{done} finished before"] if done else []
        log.info("%s: %s", folder.path.name, ", ".join(words))
        batches, files = plan.batches(), list[Path]()
        for number, batch in enumerate(batches):
            files.append(folder.path / BATCHES / str(number) / "batch.json")
            files[-1].parent.mkdir(parents=True, exist_ok=True)
            save_batch(files[-1], batch)
        returned: Any = []
        try:
            with _watched(plan):
                try:
                    returned = launch(files) if files else []
                except Exception as error:  # noqa: BLE001  (launchers raise what they like)
                    log.warning("the launcher gave up (%s)", first_line(error)[:160])
                if CAME.is_set():  # the launcher made another error of the interruption
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            tracking: Disk = instantiate(plan.config.tracking)
            tracking.log(folder.path, outputs)
            finished = sum(folder.state(job) == "finished" for job in jobs)
            said = f"{finished} of {len(jobs)} jobs are finished; the same command goes on"
            raise KeyboardInterrupt(said) from None
        for (job, *_), one in zip(batches, returned or (), strict=False):
            with failing_into(folder.path / "jobs" / job.fingerprint):
                _ = one.return_value  # raises what it failed with outside of its own code
    return returned


def save_sweep(path: Path, jobs: Sequence[Listed], outputs: Path, about: Mapping[str, Any]) -> None:
    """Writes the description of a sweep: once, or again where the file is damaged.

    Args:
        path: of its folder.
        jobs: all of them.
        outputs: the outputs folder.
        about: beside the jobs, such as its command and how it is reported.
    """
    with suppress(OSError, InputError):
        _ = SweepFolder(path).about
        return
    # A path from here: a project may be moved.
    results = os.path.relpath(outputs / "results", path)
    made = {"code": code_version(), "git": git_state(), "started": time.time(), "results": results}
    text = json.dumps({**about, **made, "jobs": [asdict(job) for job in jobs]}, indent=1)
    write_text(path / SWEEP, without_passwords(text) + "\n")


def finish(
    folder: SweepFolder,
    tracking: Disk,
    outputs: Path,
    began: float,
    tell: Callable[[str], None],
    shown: bool = True,
) -> bool:
    """Writes the report of a sweep, sends it to MLflow and tells its end; returns whether all of
    its jobs have results.

    Args:
        folder: of the sweep.
        tracking: where results go besides the disk.
        outputs: the outputs folder.
        began: when this process began with it, in seconds since 1970.
        tell: takes a line for people.
        shown: whether its table is printed.
    """
    from xplain.report.page import write_report
    from xplain.report.terminal import print_sweep

    summary = None
    # The same sweep, started twice, ends twice: both would send the same jobs to MLflow.
    with alone(folder.path, "another process ends this sweep; waiting for it"):
        with attempted("there is no report"):
            summary, _ = write_report(folder.path)
        lines = tracking.log(folder.path, outputs)
    if shown and summary is not None and summary.results:
        with attempted("the table was not printed"):
            print_sweep(summary)
    states = [folder.state(job) for job in folder.jobs]
    finished, count = states.count("finished"), len(states)
    end = [f"{finished} of {count} jobs finished, {_duration(time.time() - began)}"]
    for job, state in zip(folder.jobs, states, strict=True):
        if state == "failed":
            where = os.path.relpath(folder.of(job))
            end += [f"failed: {job.label}: {folder.error(job)}", f"  {where}"]
    end += ["run the others: the same command"] if finished < count else []
    end += [f"folder: {os.path.relpath(folder.path)}"]
    end += [f"report: {os.path.relpath(folder.path / 'report' / 'index.html')}", *lines]
    with attempted("the end was not told"):
        tell("\n".join(end))
    return finished == count


def list_job(job: Job, overrides: Sequence[str], folder: Path) -> None:
    """Leaves word of a job that another sweeper than ours runs, in its own folder."""
    texts = values_of([one.partition("=")[0] for one in overrides], job)
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(Listed("", (*overrides,), texts, job.fingerprint)))
    write_text(folder / LISTED, text + "\n")


def collected(config: DictConfig) -> SweepFolder | None:
    """The sweep that ended: of our sweeper as it was planned, of another one as its jobs left
    word. None where nothing ran."""
    folder = SweepFolder(Path(config.hydra.sweep.dir).absolute())
    paths = sorted(folder.path.glob(f"jobs/*/{LISTED}"), key=lambda path: path.stat().st_mtime_ns)
    if rows := [Listed(**json.loads(path.read_text(encoding="utf-8"))) for path in paths]:
        about = {"name": "multirun", "command": command(config)}
        save_sweep(folder.path, listed(rows), Path(config.outputs).absolute(), about)
    return folder if (folder.path / SWEEP).exists() else None


def _print_jobs(plan: Plan) -> None:
    """What ``dry_run=true`` prints: the jobs, those already done, and the time to expect."""
    for job in plan.jobs:
        if job.fingerprint in {*plan.finished, *plan.todo}:  # resume=failed leaves some
            print(f"{'done' if job.fingerprint in plan.finished else 'to run':8}{job.label}")
    print(f"{len(plan.jobs)} jobs: {len(plan.finished)} done, {len(plan.todo)} to run")
    if plan.finished and plan.todo:
        paths = (plan.folder.path.parents[1] / "results" / key / RESULTS for key in plan.finished)
        seconds = sum(sum(json.loads(p.read_text("utf-8"))["seconds"].values()) for p in paths)
        left = _duration(seconds / len(plan.finished) * len(plan.todo))
        print(f"time to expect: about {left} of one worker, as its finished jobs took")


@contextmanager
def _watched(plan: Plan) -> Iterator[None]:
    """Tells how far the jobs are, by their folders, for the time of the context; and the first
    that fails."""
    began, folder, done = time.time(), plan.folder, len(plan.finished)
    jobs = [job for job in plan.jobs if job.fingerprint in plan.todo]
    progress, stop, said = stages(), threading.Event(), list[Listed]()

    def ended(path: Path) -> bool:  # now, not in an attempt before
        return path.exists() and path.stat().st_mtime >= began - 1

    def look() -> None:
        failed = [job for job in jobs if ended(folder.of(job) / FAILURE)]
        if failed and not said:
            log.warning("first failure: %s: %s", failed[0].label, folder.error(failed[0]))
        said.extend(failed)
        count = len(failed) + sum(ended(folder.address(job) / RESULTS) for job in jobs)
        words = f"{done + count} of {done + len(jobs)} jobs done, {len(failed)} failed"
        if 0 < count < len(jobs):
            left = (time.time() - began) / count * (len(jobs) - count)
            words += f", about {_duration(left)} left"
        progress.note(words)

    def watch() -> None:
        while not stop.wait(POLL):
            look()

    thread = threading.Thread(target=watch, daemon=True)
    with progress.stage("sweep"):
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()
            look()


def _duration(seconds: float) -> str:
    """In hours, minutes and seconds: ``0:03:20``."""
    return str(timedelta(seconds=round(seconds)))
