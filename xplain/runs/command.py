"""The experiment as Hydra runs it: ``@hydra.main``, one job, and the end of a sweep.

Nothing heavy is imported before the configuration is known to be one.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from xplain.errors import left_at_once
from xplain.experiment.config import CONF, register, report_errors
from xplain.experiment.progress import is_terminal

register()


def job(cfg: DictConfig) -> float | None:
    """What launchers send to workers: one run, or one job of a sweep. Returns its mean regret."""
    own = HydraConfig.get()
    if own.mode != RunMode.RUN:
        return _in_sweep(cfg, own)
    with report_errors():
        return _alone(cfg, own)


def _alone(cfg: DictConfig, own: Any) -> float | None:
    from xplain.report.stages import stages

    progress = stages()
    folder = Path(own.runtime.output_dir)
    try:
        shown = progress.stage("loading") if is_terminal(sys.stderr) else nullcontext()
        with shown, left_at_once():
            from xplain.numba_kernels import tell_when_compiling
            from xplain.runs.job import Job, dry_run, run_alone
        tell_when_compiling(progress.compiling)
        made = Job.of(cfg, own.runtime.choices)
        if cfg.dry_run:
            dry_run(made)
            return None
        return run_alone(made, folder, instantiate(cfg.tracking), progress).regret
    finally:
        # A folder with a token drawn for this run is no one else's.
        if "${unique:}" in OmegaConf.to_yaml(own.run):
            with suppress(OSError):  # it is not empty
                folder.rmdir()


def _in_sweep(cfg: DictConfig, own: Any) -> float | None:
    from xplain.runs.job import Job, dry_run
    from xplain.runs.sweep import list_job, run_batch, run_in_sweep

    made = Job.of(cfg, own.runtime.choices)
    folder = Path(own.sweep.dir).absolute() / "jobs" / (cfg.fingerprint or made.fingerprint)
    if cfg.dry_run:  # of another sweeper than ours
        dry_run(made)
        return None
    if cfg.fingerprint is None:
        list_job(made, own.overrides.task, folder)
    regret = run_in_sweep(made, folder, cfg.fingerprint or made.fingerprint)
    run_batch(folder)
    return regret


class SweepEnd(Callback):
    """The end of a sweep, whatever sweeper and launcher ran it: report, MLflow, exit code."""

    def __init__(self) -> None:
        self._began = time.time()

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Ends the process with exit code 1 where a job has no result."""
        from xplain.runs.sweep import collected, finish

        folder = collected(config)
        if folder is None:
            return
        outputs = Path(config.outputs).absolute()

        def tell(text: str) -> None:
            # A launcher in this process leaves the log to the last job's file.
            print(text, file=sys.stderr)

        if not finish(folder, instantiate(config.tracking), outputs, self._began, tell):
            sys.exit(1)


def main() -> None:
    """The experiment from the command line of this process.

    Raises:
        XplainError, HydraException, OmegaConfBaseException: the configuration is wrong.
    """
    register()  # anew: the folder may be another one by now
    # Hydra prints errors over several lines and exits; with this it raises, and we print one.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(job)()
