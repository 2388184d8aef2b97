"""One job: from its configuration to a result at its address, and to a run's own folder.

A result has one address, ``outputs/results/<fingerprint>``. A job whose address has a finished
result returns it. So a repeated run, a resumed sweep, and sweeps with common jobs all use the same
result. Files are written atomically, ``results.json`` last: no reader sees a partial result, and
two processes may compute the same result.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from xplain import __version__
from xplain.errors import InputError, XplainError, escape
from xplain.experiment.cache import EpisodeCache, source_fingerprint
from xplain.experiment.config import GROUPS, require_usable
from xplain.experiment.explanations import describe_costs, estimate_costs
from xplain.experiment.fingerprint import code_version, configuration, fingerprint, git_state
from xplain.experiment.from_config import COSTS, experiment_of
from xplain.experiment.progress import SILENT, Progress
from xplain.experiment.results import (
    EPISODES,
    RESULTS,
    Provenance,
    Results,
    domain_name,
    episode_lines,
    find_finished,
    results_of,
    save_results,
)
from xplain.report.folder import FAILURE
from xplain.report.terminal import print_certificates, print_summary
from xplain.runs.folder import Disk, attempt
from xplain.storage import write_text

log = logging.getLogger(__name__)

OTHER_CODE = (
    "this worker has other code, libraries, data or files of choices than the process that started "
    "the sweep: update the worker, and start the command again"
)
_ESTIMATED: set[tuple[str, str]] = set()
"""Data sets and costs whose estimated costs of explanations this process has logged. The jobs of a
sweep with other solvers have the same estimate."""


@dataclass(frozen=True)
class Job:
    """One configuration of the experiment.

    Attributes:
        config: everything that decides a number, resolved.
        choices: the component chosen in each group, by name.
        outputs: path of the outputs folder.
        anew: True computes the job again without any cache, even if it has a result.
    """

    config: Mapping[str, Any]
    choices: Mapping[str, str]
    outputs: str
    anew: bool

    @classmethod
    def of(cls, cfg: DictConfig, choices: Mapping[str, str]) -> Job:
        """Makes a job from a composed configuration.

        Raises:
            XplainError: a key has no value, or a value that is not allowed.
        """
        require_usable(cfg)
        chosen = {group: str(choices[group]) for group in GROUPS}
        outputs = str(Path(cfg.outputs).absolute())
        return cls(configuration(cfg), chosen, outputs, cfg.resume == "none")

    @cached_property
    def fingerprint(self) -> str:
        """Fingerprint of everything that the job's numbers depend on."""
        return fingerprint(self.config)

    @cached_property
    def source(self) -> str:
        """Fingerprint of everything that the job's data, types and traces depend on."""
        return source_fingerprint(self.config)

    @property
    def address(self) -> Path:
        """The folder of the job's result, whether it exists or not."""
        return Path(self.outputs, "results", self.fingerprint)

    def find_result(self) -> Results | None:
        """Returns the job's result, if there is a valid result."""
        return None if self.anew else find_finished(self.address)

    def result(
        self,
        progress: Progress = SILENT,
        save: Callable[[Results, str], None] = lambda results, episodes: None,
    ) -> Results:
        """Returns the job's result, and computes it if there is no result.

        Args:
            progress: receives the progress.
            save: receives the results and the text of the episodes before certificates are
                computed, because certificates may take as long as the results.
        """
        if (known := self.find_result()) is not None:
            log.info("the result exists already: %s", os.path.relpath(self.address))
            save(known, (self.address / EPISODES).read_text(encoding="utf-8"))
            return known
        started, begun = time.time(), time.perf_counter()
        experiment = experiment_of(self.config)
        cache = None if self.anew else Path(self.outputs, "cache")
        prepared = experiment.prepare(cache, self.source, progress)
        prepared_in = time.perf_counter() - begun
        about = self.source, json.dumps([self.config[key] for key in COSTS])
        if prepared.doubted is not None and about not in _ESTIMATED:
            _ESTIMATED.add(about)
            log.warning("%s", describe_costs(estimate_costs(prepared, experiment.costs)))
        halfway = time.perf_counter()
        shared = EpisodeCache(cache, self.config)
        prepared, records = experiment.explain_cases(prepared, shared, progress)
        explained = time.perf_counter()
        name = f"{domain_name(self.choices, self.config)} {self.choices['solver']}"
        provenance = Provenance(
            name=f"{name} λ={self.config['lambda']:g} seed={self.config['seed']}",
            fingerprint=self.fingerprint,
            xplain=__version__,
            code=code_version(),
            git=git_state(),
            worker=f"{socket.gethostname()} {os.getpid()}",
            started=started,
            seconds={"prepare": prepared_in, "explain": explained - halfway},
            choices=self.choices,
            config=self.config,
        )
        results = results_of(prepared, records, provenance)
        episodes = episode_lines(prepared, records)
        save(results, episodes)
        if experiment.certify.traces:
            bounds: dict[str, float] = {}
            with attempt("there are no certificates"):
                bounds = experiment.certify.certificates(
                    prepared,
                    experiment.costs,
                    experiment.solver,
                    experiment.belief,
                    experiment.seed,
                    progress,
                )
            seconds = {**results.seconds, "bounds": time.perf_counter() - explained}
            made = "made" if bounds else "failed"
            results = replace(results, bounds=bounds, certificates=made, seconds=seconds)
        _save(self.address, results, episodes)
        return results


def _save(folder: Path, results: Results, episodes: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / EPISODES, episodes)
    save_results(folder, results)


def run_alone(
    job: Job, folder: Path, tracking: Disk, progress: Progress, shown: bool = True
) -> Results:
    """Runs one job into its own folder: saves the results first, then shows and sends them.

    Args:
        job: the job.
        folder: receives copies of the result's files, and the pictures; created with the first
            file.
        tracking: where results are sent, besides the disk.
        progress: receives the progress.
        shown: True prints tables.

    Raises:
        XplainError: the configuration or the data cannot be used, or the folder has results.
    """
    if (folder / RESULTS).exists():
        allowed = "another folder: this folder has the results of an earlier run"
        raise InputError("hydra.run.dir", os.path.relpath(folder), allowed)

    def save(results: Results, episodes: str) -> None:
        _save(folder, results, episodes)
        if shown:
            with attempt("the summary was not printed"):
                print_summary(results)

    try:
        results = job.result(progress, save)
    except SystemExit as error:
        raise XplainError(name_ending(error)) from error
    save_results(folder, results)  # with the certificates
    write_text(folder / "config.yaml", OmegaConf.to_yaml(escape(dict(job.config))))
    if shown:
        with attempt("the certificates were not printed"):
            print_certificates(results.bounds)
    drawn = ""
    with progress.stage("drawing one explanation"), attempt("there is no picture"):
        drawn = f"  trace.png is one explanation: {_draw_pictures(folder, results)}"
    with progress.stage("sending the run to MLflow"):
        lines = tracking.log(folder, Path(job.outputs))
    where = f"folder: {os.path.relpath(folder)}"
    for line in filter(None, (where, drawn, "  results.json has all figures", *lines)):
        log.info(line)
    return results


def save_batch(path: Path, jobs: Iterable[Job]) -> None:
    """Writes the list of jobs that one worker of a sweep runs in sequence."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps({job.fingerprint: asdict(job) for job in jobs}))


def run_batch(path: Path) -> None:
    """Runs the jobs of a batch. The error of a failed job is written into the job's folder."""
    end_with_parent()
    for listed, content in json.loads(path.read_text(encoding="utf-8")).items():
        run_in_sweep(Job(**content), path.parents[1] / "jobs" / listed, listed)


@cache
def end_with_parent() -> None:
    """Ends this joblib worker when the process that started it ends. Call it once in a worker.

    Otherwise the workers of a sweep that was killed with ``kill -9`` continue beside the workers of
    the restarted sweep, and then wait for minutes. Workers on clusters are ended by their
    scheduler.
    """
    if not multiprocessing.current_process().name.startswith("LokyProcess"):
        return
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def run_in_sweep(job: Job, folder: Path, listed: str) -> float | None:
    """Runs a job of a sweep and returns its mean regret. It never raises: the error is written into
    the job's folder, and other jobs continue.

    Args:
        job: the job.
        folder: the job's folder inside the sweep's folder.
        listed: the job's fingerprint in the sweep's list. The job's own fingerprint differs from it
            if this worker has other code, libraries or data than the process that began the sweep.
    """
    regret = None
    with failing_into(folder):
        if listed != job.fingerprint:
            raise RuntimeError(OTHER_CODE)
        regret = job.result().regret
    return regret


@contextmanager
def failing_into(folder: Path) -> Iterator[None]:
    """Runs a block. If it raises an error, writes the error into the folder. The error is not
    raised again, because a failed job does not stop a sweep."""
    try:
        yield
    except SystemExit as error:
        mark_failed(folder, RuntimeError(name_ending(error)))
    except Exception as error:  # noqa: BLE001  (components may raise any error)
        mark_failed(folder, error)


def mark_failed(folder: Path, error: BaseException) -> None:
    """Writes a job's error with its traceback into its folder."""
    text = " ".join(str(error).split()) or "no message"
    content = {
        "error": f"{type(error).__name__}: {text}",
        "traceback": "".join(traceback.format_exception(error)),
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / FAILURE, json.dumps(content, indent=1) + "\n")


def name_ending(error: SystemExit) -> str:
    """Describes how a component ended the program."""
    return f"a component ended the program (sys.exit({error.code!r})) while the experiment ran"


def _draw_pictures(folder: Path, results: Results) -> str:
    """Draws the run's pictures. Returns a description of the drawn episode."""
    from xplain.report import plots, trace

    figure, _, drawn = trace.draw_typical(folder, results)
    plots.save(figure, folder / "trace.png")
    if elbow := results.elbow.disagreements:
        figure = plots.disagreements(elbow, len(results.types.found), results.elbow.rule)
        plots.save(figure, folder / "disagreements.png")
    return drawn
