"""xplain's sweeper for Hydra: it runs the jobs of a sweep that have no result yet.

Hydra looks for plugins in ``hydra_plugins``: every Hydra program of the environment imports this
file, so it imports nothing of xplain before a sweep begins.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


class XplainSweeper(Sweeper):
    """Runs all combinations of the swept values, without the jobs that have a result.

    Args:
        params: ``{key: values}``, as in Hydra's basic sweeper.
        settings: a list of such mappings, one for each setting of the experiment. The sweep is the
            union over settings, each combined with ``params``. Keys on the command line override
            both.
        pool: swept keys that the report averages over; all other keys have separate rows or lines.
        report: ``table1`` adds the paper's Table 1 with its published values; null adds nothing.
    """

    def __init__(self, **_: Any) -> None:
        """Ignores the keys, because the plan reads them from the configuration."""

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Keeps the configuration and the launcher for :meth:`sweep`; Hydra calls this first."""
        self.config = config
        self._compose = partial(hydra_context.config_loader.load_sweep_config, config)
        self._launcher = partial(
            Plugins.instance().instantiate_launcher,
            hydra_context=hydra_context,
            task_function=task_function,
            config=config,
        )

    def sweep(self, arguments: list[str]) -> None:
        """Runs the jobs without a result."""
        from xplain.errors import quote
        from xplain.runs.plan import Plan, parse
        from xplain.runs.sweep import end_on_signals, run_missing

        config = self.config
        assert config is not None  # Hydra has called setup
        end_on_signals()
        plan = Plan.of(config, parse(arguments), self._compose)
        escaped = config.hydra.sweep.dir = str(plan.folder.path).replace("${", r"\${")

        def launch(batches: Sequence[Path]) -> Any:
            own = [
                f"hydra.sweep.dir={quote(escaped)}",
                "hydra.sweep.subdir=batches",
                "hydra/job_logging=none",  # a job in this process would redirect the sweep's log
            ]
            if config.hydra.job.config_name == "config":  # other files may have more keys
                config.hydra.job.config_name = "batch"
            words = [quote(str(path).replace("${", r"\${")) for path in batches]
            return self._launcher().launch([[*own, f"++batch={one}"] for one in words], 0)

        run_missing(plan, launch)
