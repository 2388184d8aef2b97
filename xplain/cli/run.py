"""The experiment: one run, or a sweep of them.

Thin on purpose: launchers ship the decorated function to workers, and ``--help`` must not wait
for the heavy packages, which :mod:`xplain.runs.job` brings.
"""

from __future__ import annotations

import sys

import hydra
from omegaconf import DictConfig

from xplain.cli import hydra_plugins
from xplain.config import CONF, named, register


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _job(cfg: DictConfig) -> float | None:
    from xplain.runs.job import run_job

    return run_job(cfg)


def main(arguments: list[str]) -> None:
    """Hydra's command line, with our sweeper and the group ``sweeps``.

    Args:
        arguments: overrides and Hydra's flags; ``--keys`` shows every key and choice.
    """
    register()
    hydra_plugins.register()
    flags = ["--help" if word == "--keys" else word for word in named(arguments)]
    before, sys.argv = sys.argv, ["xplain", *flags]  # Hydra reads nothing else
    try:
        _job()
    finally:
        sys.argv = before
