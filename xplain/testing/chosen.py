"""Components from configurations, as on the command line."""

from functools import cached_property
from pathlib import Path
from typing import Any

from xplain.experiment.config import CONF, register


class Chosen:
    """A component that is chosen by ``group=choice`` in a configuration.

    Args:
        group, choice: as on the command line.
        overrides: further keys, such as ``"solver.simulations=50"``.
        conf: a folder of your own configs, in addition to xplain's.
    """

    def __init__(
        self, group: str, choice: str, *overrides: str, conf: str | Path | None = None
    ) -> None:
        self.group = group
        self.overrides = [f"{group}={choice}", *overrides]
        if conf is not None:
            self.overrides.append(f"hydra.searchpath=[file://{Path(conf).absolute()}]")

    @cached_property
    def component(self) -> Any:
        """The component, created by :meth:`make` at its first use."""
        return self.make()

    def make(self) -> Any:
        """Creates a new component, as in a run with these keys.

        Raises:
            HydraException: there is no such choice.
            XplainError: its values are not allowed.
        """
        from hydra import compose, initialize_config_dir
        from hydra.core.global_hydra import GlobalHydra
        from hydra.utils import instantiate

        register()
        GlobalHydra.instance().clear()
        with initialize_config_dir(str(CONF), version_base="1.3"):
            cfg = compose("config", self.overrides)
        return instantiate(cfg[self.group])
