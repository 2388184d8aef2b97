"""One job, from its configuration to results on disk, in MLflow and on the terminal."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from xplain import __version__
from xplain.experiment.cache import source_fingerprint
from xplain.experiment.config import GROUPS, one_line, require_usable
from xplain.experiment.fingerprint import code_version, configuration, fingerprint, git_state
from xplain.experiment.from_config import experiment_of
from xplain.experiment.pipeline import Prepared
from xplain.experiment.progress import SILENT, Progress
from xplain.experiment.results import (
    EPISODES,
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
from xplain.runs.forecast import print_dry_job
from xplain.runs.launch import end_with_parent
from xplain.runs.mlflow import Disk
from xplain.runs.plan import Job
from xplain.storage import write_text

log = logging.getLogger(__name__)


def run_job(cfg: DictConfig) -> float | None:
    """Runs the experiment that ``cfg`` describes; returns the mean regret (for sweepers).

    A job of a sweep never raises: the others go on, and what went wrong is in its folder. Where
    the configuration or the data of a single run cannot be used, its folder is removed.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    job = job_of(folder)
    if job is not None:
        return _run_in_sweep(cfg, *job)
    try:
        require_usable(cfg)
        if cfg.dry_run:
            print_dry_job(configuration(cfg), _outputs(cfg))
            shutil.rmtree(folder, ignore_errors=True)
            return None
        return _run_alone(cfg, folder)
    except Exception as error:  # whatever it is: it is raised again
        if HydraConfig.get().mode == RunMode.RUN and one_line(error) is not None:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _outputs(cfg: DictConfig) -> Path:
    return Path(cfg.outputs).absolute()


def _run_alone(cfg: DictConfig, folder: Path) -> float | None:
    progress = stages()
    tell_when_compiling(progress.compiling)
    tracking: Disk = instantiate(cfg.tracking)
    config = configuration(cfg)
    results, prepared = run_experiment(cfg, config, folder, progress, print_summary)
    print_certificates(results.bounds)
    stamp = fingerprint(config)
    results = replace(results, id=result_id(results, folder), stamp=stamp)
    with progress.stage("drawing one explanation"):
        drawn = _draw(folder, prepared)
    save_results(folder, results)
    with progress.stage("sending the run to MLflow"):
        lines = tracking.log(folder, _outputs(cfg))
    log.info("folder: %s", os.path.relpath(folder))
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
        results, _ = run_experiment(cfg, config, folder, SILENT)
    except Exception as error:  # any failure of a job is a result of the sweep
        if is_ours(folder):
            log.exception("failed")
            mark_failed(folder, error)
        return None
    results = replace(results, id=sweep.result_id(job), name=job.label, stamp=job.fingerprint)
    save_results(folder, results)
    return results.regret


def run_experiment(
    cfg: DictConfig,
    config: dict[str, Any],
    folder: Path,
    progress: Progress,
    tell: Callable[[Results], None] | None = None,
) -> tuple[Results, Prepared]:
    """The experiment itself: writes its episodes into the folder, returns the results.

    Args:
        cfg: as Hydra composed it.
        config: all of it that decides a number, resolved.
        folder: of the run.
        progress: hears how far it is.
        tell: hears the results before the certificates, which take as long again, are sought.
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
    write_text(folder / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True))
    results = results_of(prepared, records, {}, provenance)
    if tell is not None:
        tell(results)
    bounds = experiment.certificates(prepared, progress)
    seconds = seconds | {"bounds": time.perf_counter() - explained}
    return replace(results, bounds=bounds, seconds=seconds), prepared


def result_id(results: Provenance, folder: Path) -> str:
    """Names this result for ever: what was run, by which code, and in which folder."""
    content = json.dumps([results.config, results.code, folder.name], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:32]


def _draw(folder: Path, prepared: Prepared) -> str:
    """Draws the run's pictures; returns which episode is drawn."""
    from xplain.report import plots, traces

    figure, drawn = traces.draw_typical(folder, prepared.scene)
    plots.save(figure, folder / "trace.png")
    if len(prepared.curve):
        figure = plots.disagreements(
            prepared.curve.tolist(), len(prepared.learned_types), prepared.rule
        )
        plots.save(figure, folder / "disagreements.png")
    return drawn
