"""The experiment under Hydra: ``@hydra.main``, one job, and the end of a sweep.

Slow imports happen only after the configuration is checked.
"""

import os
import sys
import time
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from xplain.errors import leave_at_once
from xplain.experiment.config import CONF, output_dir, register, report_errors

register()


def job(cfg: DictConfig) -> float | None:
    """Runs one job or a batch of a sweep; launchers send this function to workers. Returns the mean
    regret."""
    if "batch" in cfg:
        from xplain.runs.job import run_batch

        run_batch(Path(cfg.batch))
        return None
    own = HydraConfig.get()
    is_single = own.mode == RunMode.RUN
    try:
        # The errors of a sweep's job are its sweeper's.
        with report_errors() if is_single else nullcontext():
            return _run_job(cfg, own, is_single)
    finally:
        # A folder with this run's random token belongs to no other run.
        if is_single and "${unique:}" in OmegaConf.to_yaml(own.run):
            with suppress(OSError):  # the folder is not empty
                Path(output_dir(own)).rmdir()


def _run_job(cfg: DictConfig, own: Any, is_single: bool) -> float | None:
    """Runs a single job, or a job of a sweeper that is not xplain's. With ``dry_run=true`` it is
    only checked."""
    with leave_at_once():
        from xplain.experiment.from_config import check
        from xplain.report.stages import Stages
        from xplain.runs.job import Job, run_alone, run_in_sweep
        from xplain.runs.sweep import list_job
    made = Job.of(cfg, own.runtime.choices)
    if cfg.dry_run:
        check([made.config])
        print("1 job" + (", done" if made.find_result() else ""))
        return None
    if is_single:
        folder = Path(output_dir(own))
        return run_alone(made, folder, instantiate(cfg.tracking), Stages()).regret
    folder = Path(own.sweep.dir).absolute() / "jobs" / made.fingerprint
    list_job(made, own.overrides.task, folder)
    return run_in_sweep(made, folder, made.fingerprint)


class SweepEnd(Callback):
    """Hydra's callback at the end of a sweep, for any sweeper and launcher. It makes the report,
    logs to MLflow, and sets the exit code."""

    def __init__(self) -> None:
        self._began = time.time()

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Ends the process with exit code 1 if a job has no result."""
        from xplain.runs.sweep import find_ended, finish

        folder = None if config.dry_run else find_ended(config)
        if folder is None:
            return
        outputs = Path(config.outputs).absolute()
        # After a launcher in this process, logging writes to the last job's file.
        tell = partial(print, file=sys.stderr)
        if not finish(folder, instantiate(config.tracking), outputs, self._began, tell):
            sys.exit(1)


def main() -> None:
    """Runs the experiment from this process's command line.

    Raises:
        XplainError, HydraException, OmegaConfBaseException: the configuration is wrong.
    """
    register()  # again, because the working folder may have changed
    # Makes Hydra raise errors instead of printing several lines and exiting.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(job)()
