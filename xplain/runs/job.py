"""One job, from its configuration to results on disk, in MLflow and on the terminal."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from xplain import __version__
from xplain.errors import InputError, XplainError
from xplain.experiment.cache import source_fingerprint
from xplain.experiment.config import GROUPS, require_usable
from xplain.experiment.fingerprint import code_version, configuration, fingerprint, git_state
from xplain.experiment.from_config import check, experiment_of
from xplain.experiment.pipeline import Prepared
from xplain.experiment.progress import SILENT, Progress
from xplain.experiment.results import (
    EPISODES,
    RESULTS,
    Provenance,
    Results,
    domain_name,
    episode_lines,
    results_of,
    save_results,
)
from xplain.numba_kernels import tell_when_compiling
from xplain.report.run_summary import print_certificates, print_summary
from xplain.report.stages import stages
from xplain.runs.folder import SweepFolder, is_ours, job_of, mark_failed, mark_started
from xplain.runs.launch import end_with_parent
from xplain.runs.mlflow import Disk
from xplain.runs.plan import Job
from xplain.runs.terminal import attempted, logged_to, tables_are_shown, without_passwords
from xplain.storage import write_text

log = logging.getLogger(__name__)


def run_job(cfg: DictConfig) -> float | None:
    """Runs the experiment that ``cfg`` describes; returns the mean regret (for sweepers).

    A job of a sweep never raises: the others go on, and what went wrong is in its folder. A single
    run never writes into the folder of another run.

    Raises:
        XplainError: the configuration or the data of a single run cannot be used.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    job = job_of(folder)
    if job is not None:
        return _run_in_sweep(cfg, *job)
    try:
        require_usable(cfg)
        if cfg.dry_run:
            check([configuration(cfg)])
            print("1 job")
            return None
        if (folder / RESULTS).exists():
            allowed = "another folder: this one holds the results of an earlier run"
            raise InputError("hydra.run.dir", os.path.relpath(folder), allowed)
        return _run_alone(cfg, folder)
    except SystemExit as error:
        raise XplainError(_ended_by(error)) from error
    finally:
        # A folder with a token drawn for this run is no one else's.
        if "${unique:}" in OmegaConf.to_yaml(HydraConfig.get().run):
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def _ended_by(error: SystemExit) -> str:
    return f"a component ended the program (sys.exit({error.code!r})) while the experiment ran"


def _outputs(cfg: DictConfig) -> Path:
    return Path(cfg.outputs).absolute()


def _run_alone(cfg: DictConfig, folder: Path) -> float | None:
    progress = stages()
    tell_when_compiling(progress.compiling)
    tracking: Disk = instantiate(cfg.tracking)
    config = configuration(cfg)
    stamp = fingerprint(config)

    def save(results: Results) -> None:
        """Results without certificates are nobody else's."""
        save_results(folder, replace(results, id=result_id(results, folder)))
        if tables_are_shown():
            with attempted("the summary was not printed"):
                print_summary(results)

    results, prepared, whole = run_experiment(cfg, config, folder, progress, save)
    stamp = stamp if whole else ""
    results = replace(results, id=result_id(results, folder), stamp=stamp)
    save_results(folder, results)
    if tables_are_shown():
        with attempted("the certificates were not printed"):
            print_certificates(results.bounds)
    drawn = None
    with progress.stage("drawing one explanation"), attempted("there is no picture"):
        drawn = _draw(folder, prepared)
    with progress.stage("sending the run to MLflow"):
        lines = tracking.log(folder, _outputs(cfg))
    log.info("folder: %s", os.path.relpath(folder))
    if drawn is not None:
        log.info("  trace.png is one explanation: %s", drawn)
    log.info("  results.json has all figures")
    for line in lines:
        log.info(line)
    return results.regret


def _run_in_sweep(cfg: DictConfig, sweep: SweepFolder, job: Job) -> float | None:
    folder = sweep.of(job)
    end_with_parent()
    mark_started(folder)
    try:
        config = configuration(cfg)
        if fingerprint(config) != job.fingerprint:
            raise RuntimeError(
                "this worker runs other code, libraries or data than the process that started "
                "the sweep; install the same versions on every machine"
            )
        with logged_to(folder / "xplain.log"):
            results, _, _ = run_experiment(cfg, config, folder, SILENT)
    except (Exception, SystemExit) as error:  # noqa: BLE001  (a failure is a result of the sweep)
        if is_ours(folder):
            failure = RuntimeError(_ended_by(error)) if isinstance(error, SystemExit) else error
            mark_failed(folder, failure)
        return None
    results = replace(results, id=sweep.result_id(job), name=job.label, stamp=job.fingerprint)
    save_results(folder, results)
    return results.regret


def run_experiment(
    cfg: DictConfig,
    config: dict[str, Any],
    folder: Path,
    progress: Progress,
    save: Callable[[Results], None] | None = None,
) -> tuple[Results, Prepared, bool]:
    """The experiment itself: writes its episodes into the folder; returns the results, what was
    prepared, and whether the results have all the certificates that were asked for.

    Args:
        cfg: as Hydra composed it.
        config: all of it that decides a number, resolved.
        folder: of the run.
        progress: hears how far it is.
        save: is given the results before the certificates, which take as long again, are sought.
    """
    started, begun = time.time(), time.perf_counter()
    experiment = experiment_of(cfg)
    prepared = experiment.prepared(_outputs(cfg) / "cache", source_fingerprint(config), progress)
    halfway = time.perf_counter()
    prepared, records = experiment.explained(prepared, progress)
    explained = time.perf_counter()
    seconds = {"prepare": halfway - begun, "explain": explained - halfway}
    chosen = HydraConfig.get().runtime.choices
    choices = {group: str(chosen[group]) for group in GROUPS}
    domain = domain_name(choices, config)
    provenance = Provenance(
        name=f"{domain} {choices['solver']} λ={config['lambda']:g} seed={config['seed']}",
        xplain=__version__,
        code=code_version(),
        git=git_state(),
        started=started,
        seconds=seconds,
        choices=choices,
        config=config,
    )
    write_text(folder / EPISODES, episode_lines(prepared, records))
    write_text(folder / "config.yaml", without_passwords(OmegaConf.to_yaml(cfg, resolve=True)))
    results = results_of(prepared, records, {}, provenance)
    if save is not None:
        save(results)
    bounds: dict[str, float] | None = None
    with attempted("there are no certificates"):
        bounds = experiment.certificates(prepared, progress)
    seconds = seconds | {"bounds": time.perf_counter() - explained}
    results = replace(results, bounds=bounds or {}, seconds=seconds)
    return results, prepared, bounds is not None


def result_id(results: Provenance, folder: Path) -> str:
    """Names this result for ever: what was run, by which code, and in which folder."""
    content = json.dumps([results.config, results.code, folder.name], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:32]


def _draw(folder: Path, prepared: Prepared) -> str:
    """Draws the run's pictures; returns which episode is drawn."""
    from xplain.report import plots, traces

    figure, _, drawn = traces.draw_typical(folder, prepared.scene)
    plots.save(figure, folder / "trace.png")
    if len(prepared.curve):
        figure = plots.disagreements(
            prepared.curve.tolist(), len(prepared.learned_types), prepared.rule
        )
        plots.save(figure, folder / "disagreements.png")
    return drawn
