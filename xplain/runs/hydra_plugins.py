"""What Hydra needs of us: the config group ``sweeps`` and the sweeper that resumes.

Registered by our own command alone: in the namespace package ``hydra_plugins``, where Hydra looks
by itself, every Hydra program of the environment would load them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigLoadError, ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from xplain.errors import checks
from xplain.experiment.config import CONF, SWEEPS

GROUP = "sweeps"


class SweepFiles(FileConfigSource):
    """The folder of sweep files as a config group, and nothing beside it."""

    @staticmethod
    def scheme() -> str:
        """What its search path begins with."""
        return "xplain-sweeps"

    def load_config(self, config_path: str) -> ConfigResult:
        """The content of ``sweeps/<name>.yaml``."""
        if not self.is_config(config_path):
            raise ConfigLoadError(f"Config not found : {config_path}")
        return super().load_config(self._inside(config_path))

    def available(self) -> bool:
        """Whether the folder is there."""
        return Path(self.path).is_dir()

    def is_group(self, config_path: str) -> bool:
        """Only the folder itself is a group."""
        return config_path in ("", GROUP) and self.available()

    def is_config(self, config_path: str) -> bool:
        """Files in the folder are its choices."""
        group, _, name = config_path.rpartition("/")
        return group == GROUP and super().is_config(name)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """The group, or its choices."""
        if config_path == "":
            return [] if results_filter == ObjectType.CONFIG else [GROUP]
        if config_path != GROUP or results_filter == ObjectType.GROUP:
            return []
        return sorted(path.stem for path in Path(self.path).glob("*.yaml"))

    def _inside(self, config_path: str) -> str:
        return config_path.removeprefix(f"{GROUP}/")


class SweepSearchPath(SearchPathPlugin):
    """Puts the group on the search path of our own configuration, and of no other."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Called by Hydra once at start."""
        main = [entry.path for entry in search_path.get_path() if entry.provider == "main"]
        if any(path and Path(path.removeprefix("file://")) == CONF for path in main):
            search_path.append("xplain", f"{SweepFiles.scheme()}://{SWEEPS}")


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
        self.params = params or {}
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

        settings = [{**self.params, **plain(setting)} for setting in self.settings]
        return run_sweep(*self._run, settings, list(arguments), self.shown)


def plain(node: Any) -> dict[str, Any]:
    """A mapping without OmegaConf's types."""
    content: Any = OmegaConf.to_container(node) if OmegaConf.is_config(node) else node
    return dict(content)


NAME = "hydra_plugins.xplain.ResumingSweeper"
"""Hydra instantiates no sweeper whose name begins otherwise: conf/hydra/sweeper/xplain.yaml."""


def register() -> None:
    """Makes them known to Hydra in this process. Safe to call twice."""
    plugins = Plugins.instance()
    for plugin in (SweepFiles, SweepSearchPath, ResumingSweeper):
        plugins.register(plugin)
    plugins.class_name_to_class[NAME] = ResumingSweeper
