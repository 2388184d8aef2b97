"""One job, from its configuration to results on disk, in MLflow and on the terminal."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import time
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from xplain import __version__
from xplain.config import hand_over, one_line
from xplain.experiment import results as storage
from xplain.experiment.cache import prepared_once, source_stamp
from xplain.experiment.certificates import Certify
from xplain.experiment.fingerprint import configuration, stamp
from xplain.experiment.pipeline import Costs, Prepared, Source, Track, evaluate, prepare, untracked
from xplain.report import run_summary as terminal
from xplain.runs.folder import JobOfSweep, is_ours, job_of, mark_failed, mark_started
from xplain.runs.worker import end_with_parent
from xplain.solvers.base import Solver
from xplain.solvers.known_type import KnownType

log = logging.getLogger(__name__)

CHOICES = ("domain", "users", "observers", "labeler", "clusterer", "solver", "belief")


def run_job(cfg: DictConfig) -> float | None:
    """Runs the experiment that ``cfg`` describes; returns the mean regret (for sweepers).

    A job of a sweep never raises: the others go on, and what went wrong is in its folder. Where
    the configuration or the data of a single run cannot be used, its folder is removed.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    job = job_of(folder)
    if job is not None:
        return _run_in_sweep(cfg, folder, job)
    try:
        return _run_alone(cfg, folder)
    except Exception as error:  # whatever it is: it is raised again or handed over
        if HydraConfig.get().mode != RunMode.RUN:
            raise
        if one_line(error) is not None:
            shutil.rmtree(folder, ignore_errors=True)
        hand_over(error)
        return None


def _run_alone(cfg: DictConfig, folder: Path) -> float | None:
    tracking = instantiate(cfg.tracking)
    results, prepared = run_experiment(cfg, folder, terminal.track)
    results["id"] = result_id(cfg, folder)
    _draw(folder, prepared)
    storage.save_results(folder, results)
    tracking.log(folder, Path(cfg.outputs).absolute())
    terminal.print_summary(results)
    return _mean_regret(results)


def _run_in_sweep(cfg: DictConfig, folder: Path, job: JobOfSweep) -> float | None:
    end_with_parent()
    mark_started(folder)
    try:
        if stamp(configuration(cfg)) != job.stamp:
            raise RuntimeError(
                "this worker runs other code, libraries or data than the process that started "
                "the sweep; install the same versions on every machine"
            )
        results, _ = run_experiment(cfg, folder, untracked)
    except Exception as error:  # any failure of a job is a result of the sweep
        if is_ours(folder):
            log.exception("failed")
            mark_failed(folder, error)
        return None
    results |= {"id": job.result, "name": job.label, "stamp": job.stamp}
    storage.save_results(folder, results)
    return _mean_regret(results)


def run_experiment(
    cfg: DictConfig, folder: Path, track: Track[Any]
) -> tuple[dict[str, Any], Prepared]:
    """The experiment itself: writes its episodes into the folder, returns the results."""
    choices = {group: str(HydraConfig.get().runtime.choices[group]) for group in CHOICES}
    outputs = Path(cfg.outputs).absolute()
    started = time.time()

    # Everything is instantiated, and so checked, before any work; but for the source, where what
    # it leads to is known: its classifiers' imports take longer than all the rest then.
    costs = costs_of(cfg)
    solver = instantiate(cfg.solver)
    belief = instantiate(cfg.belief)
    certify = Certify(**cfg.certify)

    clock = Clock()
    config = configuration(cfg)
    prepared = prepared_once(
        outputs / "cache", source_stamp(config), lambda: prepare(source_of(cfg), track)
    )
    clock.lap("prepare")
    solvers: dict[str, Solver] = {"solver": solver, "clairvoyant": KnownType("labels")}
    if all(case.perfect is not None for case in prepared.cases):
        solvers["oracle"] = KnownType("type")
    records = evaluate(prepared, costs, solvers, belief, cfg.seed, track)
    clock.lap("explain")
    bounds = certify.certificates(prepared, costs, solver, cfg.seed)
    clock.lap("bounds")

    about = {
        "name": f"{choices['domain']} {choices['solver']} λ={cfg['lambda']:g} seed={cfg.seed}",
        "xplain": __version__,
        "code": storage.code_version(),
        "git": storage.git_state(),
        "started": started,
        "seconds": clock.laps,
        "choices": choices,
        "config": config,
    }
    storage.write_atomically(folder / storage.EPISODES, storage.episode_lines(prepared, records))
    storage.write_atomically(folder / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True))
    return storage.results_of(prepared, records, about, bounds), prepared


def _mean_regret(results: dict[str, Any]) -> float | None:
    regret = results["metrics"].get("regret")
    return None if regret is None else float(regret["mean"])


class Clock:
    """Seconds spent by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """The time since the last call went into this stage."""
        now = time.perf_counter()
        self.laps[stage] = now - self._last
        self._last = now


def source_of(cfg: DictConfig) -> Source:
    """The components that decide data, types and traces."""
    return Source(
        domain=instantiate(cfg.domain),
        users=instantiate(cfg.users),
        observers=instantiate(cfg.observers),
        labeler=instantiate(cfg.labeler),
        clusterer=instantiate(cfg.clusterer),
        traces=cfg.traces,
        max_steps=cfg.max_steps,
        seed=cfg.seed,
    )


def costs_of(cfg: DictConfig) -> Costs:
    """λ and the other costs."""
    return Costs(
        trade_off=cfg["lambda"],
        message_cost=cfg.message_cost,
        inexplicability_cost=cfg.inexplicability_cost,
        discount=cfg.discount,
        discount_per=cfg.discount_per,
        prior=cfg.prior,
    )


def result_id(cfg: DictConfig, folder: Path) -> str:
    """Names this result for ever: what was run, by which code, and in which folder."""
    content = json.dumps([configuration(cfg), storage.code_version(), folder.name], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:32]


def _draw(folder: Path, prepared: Prepared) -> None:
    from xplain.report import plots, traces

    scene = traces.scene_of(prepared.scene)
    story = next(traces.stories(folder, "solver"))
    traces.save_trace(folder / "trace.png", scene, story)
    if len(prepared.curve):
        figure = plots.disagreements(prepared.curve.tolist(), len(prepared.found), prepared.rule)
        plots.save(figure, folder / "disagreements.png")
