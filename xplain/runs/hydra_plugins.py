"""What Hydra needs of us: the sweeper that resumes.

Registered by our own command alone: in the namespace package ``hydra_plugins``, where Hydra looks
by itself, every Hydra program of the environment would load it.
"""

from __future__ import annotations

from typing import Any, Literal

from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from xplain.errors import checks, mapping
from xplain.experiment.config import register as register_keys


@checks("hydra.sweeper")
class ResumingSweeper(Sweeper):
    """All combinations of the swept values, without the jobs that are finished already.

    Args:
        params: ``{key: values}``, as in Hydra's basic sweeper.
        settings: a list of such mappings, one a setting of the experiment; the sweep is the
            union over settings, each combined with ``params``. Keys given on the command line
            win over both.
        pool: swept keys over whose values the report's tables and plots average; every other
            one has rows or lines of its own.
        report: ``table1`` adds the paper's Table 1 with its published values; null adds nothing.
    """

    def __init__(
        self,
        params: dict[str, Any] | None = None,
        settings: list[dict[str, Any]] | None = None,
        pool: list[str] | None = None,
        report: Literal["table1"] | None = None,
    ) -> None:
        self.params = {**mapping("hydra.sweeper.params", params or {}, "key: values")}
        self.settings = settings or [{}]
        self.shown = {"pool": list(pool or ()), "report": report}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        """Called by Hydra before :meth:`sweep`."""
        self._run = hydra_context, task_function, config

    def sweep(self, arguments: list[str]) -> Any:
        """Runs the sweep; ends the process with exit code 1 when jobs failed."""
        from xplain.runs.sweep import run_sweep

        settings = [{**self.params, **setting} for setting in self.settings]
        return run_sweep(*self._run, settings, list(arguments), self.shown)


NAME = "hydra_plugins.xplain.ResumingSweeper"
"""Hydra instantiates no sweeper whose name begins otherwise: conf/hydra/sweeper/xplain.yaml."""


def register() -> None:
    """Makes known to Hydra in this process what the experiment needs. Safe to call twice."""
    register_keys()
    plugins = Plugins.instance()
    plugins.register(ResumingSweeper)
    plugins.class_name_to_class[NAME] = ResumingSweeper
