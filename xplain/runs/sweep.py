"""Runs a sweep: what is missing, on the chosen launcher, to a clean end whatever happens."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import Event
from typing import Any

from hydra.types import HydraContext, TaskFunction
from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.experiment.cache import source_fingerprint
from xplain.experiment.fingerprint import code_version, fingerprint, git_state
from xplain.experiment.from_config import check
from xplain.experiment.results import load_results
from xplain.report.summary import Summary
from xplain.runs.compose import Composer
from xplain.runs.folder import SweepFolder, mark_failed
from xplain.runs.forecast import print_dry_run
from xplain.runs.launch import interruptible, launch
from xplain.runs.mlflow import tell_links
from xplain.runs.mlflow_mirror import mirror_of
from xplain.runs.plan import Job, Plan, in_launch_order, make_plan
from xplain.runs.progress import Watch, duration
from xplain.runs.reuse import copy_finished

log = logging.getLogger(__name__)


def run_sweep(
    context: HydraContext,
    task: TaskFunction,
    config: DictConfig,
    settings: list[dict[str, Any]],
    arguments: list[str],
    shown: Mapping[str, Any],
) -> None:
    """Plans the sweep, runs the jobs that are missing, reports.

    Args:
        context, task, config: of Hydra.
        settings: see :func:`xplain.runs.plan.make_plan`.
        arguments: overrides given on the command line.
        shown: how the report is to show it (``pool``, ``report``), kept beside the jobs.

    Raises:
        XplainError: the configuration of some job is wrong; nothing was run.
        SystemExit: 1 when jobs failed.
    """
    began = time.time()
    configurations: dict[str, dict[str, Any]] = {}

    def load(overrides: list[str]) -> DictConfig:
        return context.config_loader.load_sweep_config(config, overrides)

    def fingerprints(resolved: dict[str, Any]) -> tuple[str, str]:
        own = fingerprint(resolved)
        configurations[own] = resolved
        return own, source_fingerprint(resolved)

    name = config.hydra.runtime.choices.get("sweeps") or "multirun"
    compose = Composer(load, config.hydra.runtime.choices)
    plan = make_plan(name, settings, arguments, compose, fingerprints)
    outputs = Path(config.outputs).absolute()
    folder = SweepFolder(outputs / "sweeps" / plan.identity)
    missing = [job for job in plan.jobs if folder.state(job) != "finished"]
    check([configurations[job.fingerprint] for job in missing])
    if config.dry_run:
        print_dry_run(plan, folder, outputs, config, configurations)
        return
    with folder.alone(f"{plan.identity}: another process runs this sweep; waiting for it"):
        folder.save(
            plan,
            {
                "started": began,
                "command": " ".join(["python -m xplain", *sys.argv[1:]]),
                "code": code_version(),
                "git": git_state(),
                **shown,
            },
        )
        run = Run(plan, folder, instantiate(config.tracking), outputs, config.resume)
        try:
            run.through(lambda jobs: launch(jobs, folder, context, task, config))
        except KeyboardInterrupt:
            raise KeyboardInterrupt(run.so_far()) from None
    run.tell()
    if run.failed:
        raise SystemExit(1)


class Run:
    """One start of a sweep: chooses the jobs, launches them, ends in a clean state.

    Args:
        plan, folder: of the sweep.
        tracking: where results go besides the disk.
        outputs: the outputs folder.
        resume: which jobs to run: ``missing``, ``failed`` or ``none`` (all of them anew).
    """

    def __init__(
        self, plan: Plan, folder: SweepFolder, tracking: Any, outputs: Path, resume: str
    ) -> None:
        self._plan, self._folder, self._resume = plan, folder, resume
        self._mirror = mirror_of(tracking, outputs, folder, plan.jobs, fresh=resume == "none")
        if resume == "none":
            for job in plan.jobs:
                folder.clear(job)
        states = [(job, folder.trust(job)) for job in plan.jobs]
        self._todo = [
            job
            for job, state in states
            if (state == "failed" if resume == "failed" else state != "finished")
        ]
        for job in self._todo:
            folder.clear(job)
        self._done_before = sum(state == "finished" for _, state in states)
        self._copied = [] if resume == "none" else copy_finished(outputs, folder, self._todo)
        self._todo = [job for job in self._todo if job not in self._copied]
        self._tracking, self._outputs = tracking, outputs
        self._summary: Summary | None = None

    def through(self, launch: Callable[[list[Job]], None]) -> None:
        """Launches what is to be done and brings MLflow and the report to their final state."""
        plan, folder = self._plan, self._folder
        self._announce()
        status = "KILLED"
        try:
            before = self._done_before + len(self._copied)
            watch = Watch(folder, self._todo, self._mirror, before)
            with interruptible() as interrupted, watch:
                self._attempt(launch, interrupted)
            states = [folder.state(job) for job in plan.jobs]
            if all(state == "finished" for state in states):
                status = "FINISHED"
            elif "failed" in states:
                status = "FAILED"
        except Exception:
            status = "FAILED"
            raise
        finally:
            summary, report = None, None
            if status != "KILLED":
                from xplain.report.write import write_report

                summary, report = write_report(folder.path)
            self._mirror.finish(status, summary, report)
            self._summary = summary

    def _announce(self) -> None:
        before = f", {self._done_before} finished before" if self._done_before else ""
        if self._copied:
            before += f", {len(self._copied)} copied from finished runs and sweeps"
        if not self._todo:
            log.info("%s: nothing is missing%s", self._plan.identity, before)
            return
        log.info("%s: %d jobs to run%s", self._plan.identity, len(self._todo), before)
        log.info("folder: %s", self._folder.path)

    def _attempt(self, launch: Callable[[list[Job]], None], interrupted: Event) -> None:
        """Launches until every job has ended. When a worker dies, launchers give up on all
        jobs: those not begun are launched again, those it may have died of each on its own.

        Raises:
            KeyboardInterrupt: also where what was interrupted made another error of it, as the
                composition of a configuration does.
        """
        fresh, suspects, idle = in_launch_order(self._todo), list[Job](), 0
        while fresh or suspects:
            alone = not fresh
            batch = [suspects.pop(0)] if alone else fresh
            error: Exception | None = None
            try:
                launch(batch)
            except Exception as raised:  # noqa: BLE001  (launchers raise what they like)
                error = raised
            if interrupted.is_set():
                raise KeyboardInterrupt
            fresh = [job for job in batch if self._folder.state(job) == "waiting"]
            lost = [job for job in batch if self._folder.state(job) == "running"]
            # A worker may die before it begins a job; when it happens again and again the
            # launcher itself is at fault.
            idle = idle + 1 if len(fresh) == len(batch) else 0
            if idle == 3:
                raise error or RuntimeError("the launcher ran none of the jobs")
            for job in lost:
                self._folder.clear(job)
                if alone:
                    words = f"its worker died, twice ({_short(error)})"
                    mark_failed(self._folder.of(job), RuntimeError(words))
            if not alone:
                suspects += lost
            if fresh or (lost and not alone):
                log.warning(
                    "a worker died (%s); %d jobs are launched again",
                    _short(error),
                    len(fresh) + len(suspects),
                )

    def _shares(self) -> str:
        """How much of the workers' time went into the method, and how much into the rest."""
        inside, workers = 0.0, set()
        for job in self._todo:
            if self._folder.state(job) == "finished":
                inside += sum(load_results(self._folder.of(job)).seconds.values())
                workers.add(self._folder.worker(job))
        if not workers:
            return "no job ran"
        share = min(1.0, inside / (len(workers) * age()))
        return (
            f"time of {len(workers)} worker{'s' if len(workers) > 1 else ''}: {share:.0%} in the "
            f"method itself, {1 - share:.0%} in all else (start, configuration, waiting, MLflow, "
            "report)"
        )

    @property
    def failed(self) -> list[Job]:
        """Jobs whose folder tells of an error, in the order of the sweep."""
        return [job for job in self._plan.jobs if self._folder.state(job) == "failed"]

    def so_far(self) -> str:
        """What a person who interrupted the sweep wants to know."""
        finished = sum(self._folder.state(job) == "finished" for job in self._plan.jobs)
        return f"{finished} of {len(self._plan.jobs)} jobs are finished; the same command goes on"

    def tell(self) -> None:
        """The table, what failed, where to look."""
        from xplain.report.console import print_sweep

        if self._summary is not None and self._summary.results:
            print_sweep(self._summary)
        total = len(self._plan.jobs)
        finished = sum(self._folder.state(job) == "finished" for job in self._plan.jobs)
        log.info("%d of %d jobs finished, %s", finished, total, duration(age()))
        log.info(self._shares())
        for job in self.failed:
            log.info("failed: %s: %s", job.label, self._folder.failure(job)["error"])
            log.info("  %s", self._folder.of(job))
        if self.failed:
            log.info("run them again: the same command with resume=failed")
        elif finished < total:
            log.info("run the others: the same command without resume=%s", self._resume)
        report = self._folder.path / "report"
        log.info("folder: %s", os.path.relpath(self._folder.path))
        log.info("report: %s (regret.csv beside it)", os.path.relpath(report / "index.html"))
        tell_links(self._tracking, self._outputs, self._mirror.links())


def age() -> float:
    """Seconds since this process started, imports and all; where the system does not tell,
    since this module was imported."""
    try:
        birth = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - birth / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return time.time() - _IMPORTED


_IMPORTED = time.time()


def _short(error: BaseException | None) -> str:
    if error is None:
        return "no word from it"
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
