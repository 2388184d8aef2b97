"""Hydra's sweeper of xplain: the jobs of a sweep that have no result yet.

Hydra looks for plugins in ``hydra_plugins``: every Hydra program of the environment imports this
file, so it imports nothing of xplain before a sweep begins.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class XplainSweeper(Sweeper):
    """All combinations of the swept values, without the jobs that have a result.

    Args:
        params: ``{key: values}``, as in Hydra's basic sweeper.
        settings: a list of such mappings, one a setting of the experiment; the sweep is the
            union over settings, each combined with ``params``. Keys given on the command line
            win over both.
        pool: swept keys over whose values the report averages; every other one has rows or lines
            of its own.
        report: ``table1`` adds the paper's Table 1 with its published values; null adds nothing.
        together: swept keys whose values one worker runs after each other, on the same data.
    """

    def __init__(self, **keys: Any) -> None:
        self.keys = keys

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Called by Hydra before :meth:`sweep`."""
        self.config = config
        self._compose = partial(hydra_context.config_loader.load_sweep_config, config)
        self._launcher = partial(
            Plugins.instance().instantiate_launcher,
            hydra_context=hydra_context,
            task_function=task_function,
            config=config,
        )

    def sweep(self, arguments: list[str]) -> Any:
        """Runs the jobs without a result; returns what the launcher does, or None."""
        from xplain.runs.sweep import Plan, run_missing

        assert self.config is not None  # Hydra has called setup
        plan = Plan.of(self.config, self.keys, arguments, {}, self._compose)
        self.config.hydra.sweep.dir = str(plan.folder.path)

        def launch(_: Any, batch: Sequence[Sequence[str]]) -> Any:
            return self._launcher().launch(batch, initial_job_idx=0)

        return run_missing(plan, launch)
