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

from xplain import __version__, storage, terminal
from xplain.command_line import hand_over, one_line
from xplain.experiment import Costs, Prepared, Source, evaluate, prepare
from xplain.solvers.base import Solver
from xplain.solvers.known_type import KnownType

log = logging.getLogger(__name__)

CHOICES = ("domain", "users", "observers", "labeler", "clusterer", "solver", "belief")


def run_job(cfg: DictConfig) -> float | None:
    """Runs the experiment that ``cfg`` describes; returns the mean regret (for sweepers).

    Where the configuration or the data of a single run cannot be used, its folder is removed.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        return _run(cfg, folder)
    except Exception as error:  # whatever it is: it is raised again or handed over
        if HydraConfig.get().mode != RunMode.RUN:
            raise
        if one_line(error) is not None:
            shutil.rmtree(folder, ignore_errors=True)
        hand_over(error)
        return None


def _run(cfg: DictConfig, folder: Path) -> float | None:
    """The experiment.

    Raises:
        XplainError: something in the configuration or the data cannot be used.
    """
    choices = {group: str(HydraConfig.get().runtime.choices[group]) for group in CHOICES}
    outputs = Path(cfg.outputs).absolute()
    started = time.time()

    # Everything is instantiated, and so checked, before any work.
    source = source_of(cfg)
    costs = costs_of(cfg)
    solver = instantiate(cfg.solver)
    belief = instantiate(cfg.belief)
    tracking = instantiate(cfg.tracking)

    clock = Clock()
    prepared = prepare(source, terminal.track)
    clock.lap("prepare")
    solvers: dict[str, Solver] = {"solver": solver, "clairvoyant": KnownType("labels")}
    if all(case.perfect is not None for case in prepared.cases):
        solvers["oracle"] = KnownType("type")
    records = evaluate(prepared, costs, solvers, belief, cfg.seed, terminal.track)
    clock.lap("explain")
    bounds: dict[str, float] = {}
    clock.lap("bounds")

    about = {
        "id": result_id(cfg, folder),
        "name": f"{choices['domain']} {choices['solver']} λ={cfg['lambda']:g} seed={cfg.seed}",
        "xplain": __version__,
        "code": storage.code_version(),
        "git": storage.git_state(),
        "started": started,
        "seconds": clock.laps,
        "choices": choices,
        "config": configuration(cfg),
    }
    results = storage.results_of(prepared, records, about, bounds)
    storage.write_atomically(folder / storage.EPISODES, storage.episode_lines(prepared, records))
    storage.write_atomically(folder / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True))
    _draw(folder, prepared, records)
    storage.save_results(folder, results)
    tracking.log(folder, outputs)
    terminal.print_summary(results)
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


def configuration(cfg: DictConfig) -> dict[str, Any]:
    """The resolved configuration, without what cannot change a number."""
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    return {key: plain[key] for key in plain if key not in ("outputs", "tracking", "sweeps")}


def result_id(cfg: DictConfig, folder: Path) -> str:
    """Names this result for ever: what was run, by which code, and in which folder."""
    content = json.dumps([configuration(cfg), storage.code_version(), folder.name], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:32]


def _draw(folder: Path, prepared: Prepared, records: list[Any]) -> None:
    from xplain.report import plots, traces

    own = next(record for record in records if record.solver == "solver")
    traces.save_trace(folder / "trace.png", prepared, own)
    if len(prepared.curve):
        plots.save_disagreements(folder / "disagreements.png", prepared)
