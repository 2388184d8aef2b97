"""Runs a sweep: what is missing, on the chosen launcher, to a clean end whatever happens."""

from __future__ import annotations

import logging
import os
import shlex
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from hydra.types import HydraContext, TaskFunction
from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.errors import first_line
from xplain.experiment.cache import source_fingerprint
from xplain.experiment.fingerprint import code_version, fingerprint, git_state
from xplain.experiment.from_config import check
from xplain.experiment.results import load_results
from xplain.runs.compose import Composer
from xplain.runs.folder import SweepFolder
from xplain.runs.launch import interruptible, launch
from xplain.runs.mlflow import Disk
from xplain.runs.plan import Job, Plan, in_launch_order, make_plan
from xplain.runs.progress import duration, watched
from xplain.runs.reuse import Todo, copy_results, todo_of
from xplain.runs.terminal import attempted, tables_are_shown

log = logging.getLogger(__name__)


def run_sweep(
    context: HydraContext,
    task: TaskFunction,
    config: DictConfig,
    settings: list[dict[str, Any]],
    arguments: list[str],
    shown: Mapping[str, Any],
) -> Path | None:
    """Plans the sweep, runs the jobs that are missing, reports; returns the sweep's folder, or None
    where nothing was to run.

    Args:
        context, task, config: of Hydra.
        settings: see :func:`xplain.runs.plan.make_plan`.
        arguments: overrides given on the command line.
        shown: how the report is to show it (``pool``, ``report``), kept beside the jobs.

    Raises:
        XplainError: the configuration of some job is wrong; nothing was run.
    """
    began = time.time()
    configurations: dict[str, dict[str, Any]] = {}

    def fingerprints(resolved: dict[str, Any]) -> tuple[str, str]:
        own = fingerprint(resolved)
        configurations[own] = resolved
        return own, source_fingerprint(resolved)

    name = config.hydra.runtime.choices.get("sweeps") or "multirun"
    load = partial(context.config_loader.load_sweep_config, config)
    compose = Composer(load, config.hydra.runtime.choices)
    plan = make_plan(name, settings, arguments, compose, fingerprints)
    for note in plan.notes:
        log.info(note)
    outputs = Path(config.outputs).absolute()
    folder = SweepFolder(outputs / "sweeps" / plan.identity)
    missing = [job for job in plan.jobs if folder.state(job) != "finished"]
    check([configurations[job.fingerprint] for job in missing])
    if config.dry_run:
        _print_jobs(plan, folder, todo_of(plan, folder, outputs, config.resume))
        return None
    with folder.alone(f"{plan.identity}: another process runs this sweep; waiting for it"):
        made = {"command": _command(config), "code": code_version(), "git": git_state()}
        folder.save(plan, {"started": began, **made, **shown})
        todo = todo_of(plan, folder, outputs, config.resume)
        start = partial(launch, context, task, config, folder)
        carry_out(todo, plan, folder, instantiate(config.tracking), outputs, start)
    return folder.path


def _command(config: DictConfig) -> str:
    """What starts the same sweep, from Python as well."""
    given = [*config.hydra.overrides.hydra, *config.hydra.overrides.task]
    words = [word for word in given if not word.startswith("hydra.mode=")]
    prepared = any(word.startswith("sweeps=") for word in words)
    return shlex.join(["python", "-m", "xplain", *([] if prepared else ["-m"]), *words])


def carry_out(
    todo: Todo,
    plan: Plan,
    folder: SweepFolder,
    tracking: Disk,
    outputs: Path,
    launch: Callable[[list[Job]], None],
) -> None:
    """Copies and launches what is to be done, then brings the report and MLflow in line.

    Args:
        todo: what is to be done.
        plan, folder: of the sweep, whose lock is held.
        tracking: where results go besides the disk.
        outputs: the outputs folder.
        launch: runs jobs, each in its own process or not.

    Raises:
        KeyboardInterrupt: it was interrupted; what had ended is in MLflow.
    """
    jobs = {job.fingerprint: job for job in plan.jobs}
    copied = {key for key, source in todo.copied.items() if copy_results(source, folder, jobs[key])}
    for key in jobs.keys() - {*todo.finished, *copied}:
        folder.clear(jobs[key])  # also what is left alone may hold half of a result
    run = [job for key, job in jobs.items() if key in {*todo.run, *todo.copied} - copied]
    _announce(plan, folder, run, len(todo.finished), len(copied))
    try:
        with interruptible() as interrupted, watched(folder, run, len(todo.finished) + len(copied)):
            try:
                if run:
                    launch(in_launch_order(run))
            except Exception as error:  # noqa: BLE001  (launchers raise what they like)
                log.warning("the launcher gave up (%s)", first_line(error)[:160])
            if interrupted.is_set():  # what was interrupted made another error of it
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        tracking.log(folder.path, outputs)
        finished = sum(folder.state(job) == "finished" for job in plan.jobs)
        words = f"{finished} of {len(plan.jobs)} jobs are finished; the same command goes on"
        raise KeyboardInterrupt(words) from None
    from xplain.report.console import print_sweep
    from xplain.report.write import write_report

    summary, report = write_report(folder.path)
    lines = tracking.log(folder.path, outputs)
    if summary.results and tables_are_shown():
        with attempted("the table was not printed"):
            print_sweep(summary)
    _tell(plan, folder, run)
    log.info("folder: %s", os.path.relpath(folder.path))
    log.info("report: %s (regret.csv beside it)", os.path.relpath(report / "index.html"))
    for line in lines:
        log.info(line)


def _announce(plan: Plan, folder: SweepFolder, run: list[Job], finished: int, copied: int) -> None:
    words = [f"{len(run)} jobs to run" if run else "nothing is missing"]
    words += [f"{finished} finished before"] if finished else []
    words += [f"{copied} copied from finished runs and sweeps"] if copied else []
    log.info("%s: %s", plan.identity, ", ".join(words))
    if run:
        log.info("folder: %s", folder.path)


def _print_jobs(plan: Plan, folder: SweepFolder, todo: Todo) -> None:
    """What ``dry_run=true`` prints: the jobs, those already done, and the time to expect."""
    done = {*todo.finished, *todo.copied}
    for job in plan.jobs:
        if job.fingerprint in {*done, *todo.run}:  # resume=failed leaves some
            print(f"{'done' if job.fingerprint in done else 'to run':8}{job.label}")
    print(
        f"{len(plan.jobs)} jobs: {len(todo.finished)} done, {len(todo.copied)} done elsewhere (to "
        f"be copied), {len(todo.run)} to run"
    )
    own = [job for job in plan.jobs if job.fingerprint in todo.finished]
    if own and todo.run:
        seconds = [sum(load_results(folder.of(job)).seconds.values()) for job in own]
        workers = len({folder.worker(job) for job in own})
        left = sum(seconds) / len(own) * len(todo.run) / workers
        print(f"time to expect: about {duration(left)}, as its finished jobs took")


def _tell(plan: Plan, folder: SweepFolder, ran: list[Job]) -> None:
    """How many jobs are finished, where the time went, what failed, what to do about it."""
    finished = {job.name for job in plan.jobs if folder.state(job) == "finished"}
    failed = [job for job in plan.jobs if folder.state(job) == "failed"]
    log.info("%d of %d jobs finished, %s", len(finished), len(plan.jobs), duration(age()))
    own = [job for job in ran if job.name in finished]
    inside = sum(sum(load_results(folder.of(job)).seconds.values()) for job in own)
    workers = {folder.worker(job) for job in own}
    if workers:
        share = min(1.0, inside / (len(workers) * age()))
        log.info(
            "time of %d worker%s: %.0f%% in the method itself, %.0f%% in all else (start, "
            "configuration, waiting, MLflow, report)",
            len(workers),
            "s" if len(workers) > 1 else "",
            100 * share,
            100 * (1 - share),
        )
    for job in failed:
        log.info("failed: %s: %s", job.label, folder.failure(job)["error"])
        log.info("  %s", folder.of(job))
    if failed:
        log.info("run them again: the same command with resume=failed")
    elif len(finished) < len(plan.jobs):
        log.info("run the others: the same command with resume=missing")


def age() -> float:
    """Seconds since this process started, imports and all; where the system does not tell,
    since this module was imported."""
    try:
        birth = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - birth / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return time.time() - _IMPORTED


_IMPORTED = time.time()
