"""Runs a sweep: gives its batches to a launcher, then writes the report and sends results to
MLflow.

The launcher is one of Hydra's on the command line, and joblib in Python.
"""

import json
import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from datetime import timedelta
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NoReturn

from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.errors import InputError, first_line
from xplain.experiment.fingerprint import code_version, git_state
from xplain.experiment.results import RESULTS
from xplain.report.folder import FAILURE, SWEEP, ListedJob, SweepFolder
from xplain.report.stages import Stages
from xplain.runs.folder import Disk, alone, attempt, without_passwords
from xplain.runs.job import Job, failing_into, save_batch
from xplain.runs.plan import Plan, command, label_jobs, parse, values_of
from xplain.storage import write_text

log = logging.getLogger(__name__)

POLL = 1.0
"""Seconds between two checks of a sweep's progress."""

BATCHES, LISTED = "batches", "job.json"
"""The folder of the batches in a sweep's folder; and the file in a job's folder that describes a
job of another sweeper."""

CAME = threading.Event()
"""Is set when a signal interrupts this process. A library may replace the interruption by another
error, but not this event."""


def end_on_signals() -> None:
    """Makes SIGTERM and a closed terminal interrupt this process like Ctrl-C. Workers ignore
    Ctrl-C, because an interrupted import would print a traceback."""

    def interrupt(*_: object) -> NoReturn:
        CAME.set()
        raise KeyboardInterrupt

    def wait() -> None:
        while signal.sigwait({signal.SIGINT}):
            os.kill(os.getpid(), signal.SIGTERM)

    # Ignored signals stay ignored: Ctrl-C in a background job, a closed terminal under nohup.
    numbers = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    for number in heard:
        signal.signal(number, interrupt)
    if signal.SIGINT in heard:
        from joblib.externals.loky.backend import resource_tracker as tracker_of_joblib

        # A tracker that starts later removes the block: Python's, and that of joblib before 1.6.
        resource_tracker.ensure_running()
        tracker_of_joblib.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # workers inherit this
        threading.Thread(target=wait, daemon=True).start()


def run_missing(plan: Plan, launch: Callable[[list[Path]], Any]) -> None:
    """Runs the jobs of a plan that have no results.

    Args:
        plan: the sweep. With ``dry_run=true`` its jobs are only printed.
        launch: receives the files of the batches, and runs the batches. Hydra's launchers return
            what became of each batch.

    Raises:
        KeyboardInterrupt: the sweep was interrupted; MLflow has the ended jobs.
    """
    if plan.config.dry_run:
        _print_jobs(plan)
        return
    folder, jobs, done = plan.folder, plan.jobs, len(plan.finished)
    with alone(folder.path, "another process runs this sweep; waiting for it"):
        outputs = folder.path.parents[1]
        save_sweep(folder.path, jobs, outputs, plan.about)
        words = f"{len(plan.todo)} jobs to run" if plan.todo else "no job to run"
        log.info("%s: %s%s", folder.path.name, words, f", {done} finished before" if done else "")
        batches = {
            folder.path / BATCHES / f"{number}.json": batch
            for number, batch in enumerate(plan.batches())
        }
        for path, batch in batches.items():
            save_batch(path, batch)
        returned: Any = []
        try:
            with _report_progress(plan):
                try:
                    returned = launch([*batches]) if batches else []
                except Exception as error:  # noqa: BLE001  (launchers may raise any error)
                    log.warning("the launcher failed (%s)", first_line(error)[:160])
                if CAME.is_set():  # the launcher replaced the interruption by another error
                    raise KeyboardInterrupt
        except KeyboardInterrupt:
            instantiate(plan.config.tracking).log(folder.path, outputs)
            finished = sum(folder.state(job) == "finished" for job in jobs)
            raise KeyboardInterrupt(
                f"{finished} of {len(jobs)} jobs are finished; the same command runs the other jobs"
            ) from None
        for (job, *_), one in zip(batches.values(), returned or (), strict=False):
            with failing_into(folder.path / "jobs" / job.fingerprint):
                _ = one.return_value  # raises errors from outside of the job's code


def save_sweep(
    path: Path, jobs: Sequence[ListedJob], outputs: Path, about: Mapping[str, Any]
) -> None:
    """Writes the description of a sweep: once, or again if the file is damaged.

    Args:
        path: folder of the sweep.
        jobs: all jobs.
        outputs: the outputs folder.
        about: further contents, such as its command and the settings of its report.
    """
    with suppress(OSError, InputError):
        _ = SweepFolder(path).about
        return
    # A relative path, because a project may be moved. Both paths are resolved, because ".." goes
    # to another folder after a symbolic link.
    results = os.path.relpath(outputs.resolve() / "results", path.resolve())
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
    """Writes the report of a sweep, sends it to MLflow and prints the outcome. Returns True if all
    jobs have results.

    Args:
        folder: folder of the sweep.
        tracking: where results are sent, besides the disk.
        outputs: the outputs folder.
        began: time when this process started the sweep, in seconds since 1970.
        tell: prints the outcome.
        shown: True prints the table of the sweep.
    """
    from xplain.report.page import write_report
    from xplain.report.terminal import print_sweep

    summary = None
    # If two processes run one sweep, both end it and would send the same jobs to MLflow.
    with alone(folder.path, "another process ends this sweep; waiting for it"):
        with attempt("there is no report"):
            summary, _ = write_report(folder.path)
        lines = tracking.log(folder.path, outputs)
    if shown and summary is not None and summary.results:
        with attempt("the table was not printed"):
            print_sweep(summary)
    count = len(folder.jobs)
    finished = sum(folder.state(job) == "finished" for job in folder.jobs)
    end = [f"{finished} of {count} jobs finished, {_format_duration(time.time() - began)}"]
    end += [
        f"failed: {job.label}: {folder.error(job)}\n  {os.path.relpath(folder.of(job))}"
        for job in folder.jobs
        if folder.state(job) == "failed"
    ]
    end += ["the same command runs the other jobs"] if finished < count else []
    end += [f"folder: {os.path.relpath(folder.path)}"]
    end += [f"report: {os.path.relpath(folder.path / 'report' / 'index.html')}", *lines]
    with attempt("the outcome was not printed"):
        tell("\n".join(end))
    return finished == count


def list_job(job: Job, overrides: Sequence[str], folder: Path) -> None:
    """Writes the description of another sweeper's job into the job's folder."""
    texts = values_of([own[0] for own in parse(overrides).values()], job)
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(asdict(ListedJob("", (*overrides,), texts, job.fingerprint)))
    write_text(folder / LISTED, text + "\n")


def find_ended(config: DictConfig) -> SweepFolder | None:
    """Finds the sweep that ended: from the plan of xplain's sweeper, or from the descriptions that
    jobs of another sweeper wrote. Returns None if no job ran."""
    folder = SweepFolder(Path(config.hydra.sweep.dir).absolute())
    paths = sorted(folder.path.glob(f"jobs/*/{LISTED}"), key=lambda path: path.stat().st_mtime_ns)
    if rows := [ListedJob(**json.loads(path.read_text(encoding="utf-8"))) for path in paths]:
        about = {"name": "multirun", "command": command(config)}
        save_sweep(folder.path, label_jobs(rows), Path(config.outputs).absolute(), about)
    return folder if (folder.path / SWEEP).exists() else None


def _print_jobs(plan: Plan) -> None:
    """Prints the jobs with their states, and the expected time, for ``dry_run=true``."""
    for job in plan.jobs:
        if job.fingerprint in {*plan.finished, *plan.todo}:  # resume=failed skips some
            print(f"{'done' if job.fingerprint in plan.finished else 'to run':8}{job.label}")
    print(f"{len(plan.jobs)} jobs: {len(plan.finished)} done, {len(plan.todo)} to run")
    if plan.todo and not plan.finished:
        print("expected time: unknown until the first job is finished")
    elif plan.todo:
        seconds = sum(plan.finished.values()) / len(plan.finished) * len(plan.todo)
        left = _format_duration(seconds)
        print(f"expected time: about {left} for one worker, estimated from the finished jobs")


@contextmanager
def _report_progress(plan: Plan) -> Iterator[None]:
    """Reports the progress of the jobs, from their folders, and the first failure, while the block
    runs."""
    began, folder, done = time.time(), plan.folder, len(plan.finished)
    jobs = [job for job in plan.jobs if job.fingerprint in plan.todo]
    progress, stop = Stages(), threading.Event()

    def ended(path: Path) -> bool:  # in this attempt, not an earlier one
        return path.exists() and path.stat().st_mtime >= began - 1

    def watch() -> None:
        over, said = False, False
        while not over:
            over = stop.wait(POLL)
            failed = [job for job in jobs if ended(folder.of(job) / FAILURE)]
            if failed and not said:
                log.warning("first failure: %s: %s", failed[0].label, folder.error(failed[0]))
            said = bool(failed)
            count = len(failed) + sum(ended(folder.address(job) / RESULTS) for job in jobs)
            words = f"{done + count} of {done + len(jobs)} jobs done, {len(failed)} failed"
            if 0 < count < len(jobs):
                left = (time.time() - began) / count * (len(jobs) - count)
                words += f", about {_format_duration(left)} left"
            progress.note(words)

    thread = threading.Thread(target=watch, daemon=True)
    with progress.stage("sweep"):
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


def _format_duration(seconds: float) -> str:
    """Formats hours, minutes and seconds: ``0:03:20``."""
    return str(timedelta(seconds=round(seconds)))
