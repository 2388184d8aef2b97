"""The experiment: one run, or a sweep of them.

Thin on purpose: launchers ship the decorated function to workers, and ``--help`` must not wait
for the heavy packages, which :mod:`xplain.runs.job` brings.
"""

from __future__ import annotations

import sys
from contextlib import nullcontext

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from xplain.cli import hydra_plugins
from xplain.config import CONF, named, register
from xplain.errors import XplainError


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _job(cfg: DictConfig) -> float | None:
    from xplain.report.stages import stages

    alone = HydraConfig.get().mode == RunMode.RUN
    with stages().stage("loading") if alone and sys.stderr.isatty() else nullcontext():
        from xplain.runs.job import run_job

    return run_job(cfg)


def main(arguments: list[str]) -> None:
    """Hydra's command line, with our sweeper and the group ``sweeps``.

    Args:
        arguments: overrides and Hydra's flags; ``--keys`` shows every key and choice.
    """
    words = _overrides_first(named(arguments))
    register()
    hydra_plugins.register()
    flags = ["--help" if word == "--keys" else word for word in words]
    before, sys.argv = sys.argv, ["xplain", *flags]  # Hydra reads nothing else
    try:
        _job()
    finally:
        sys.argv = before


def _overrides_first(arguments: list[str]) -> list[str]:
    """The words with overrides before flags: Hydra takes none on both sides of a flag.

    Raises:
        XplainError: a key that was written as a flag.
    """
    known, left = get_args_parser().parse_known_args([w for w in arguments if w != "--keys"])
    unknown = [word for word in left if word.startswith("-")]
    if unknown:
        key, _, value = unknown[0].lstrip("-").partition("=")
        after = arguments[arguments.index(unknown[0]) + 1 :]
        value = value or (after[0] if after and "=" not in after[0] else "VALUE")
        raise XplainError(
            f"{unknown[0]}: no such flag; keys are written without dashes: {key}={value}"
        )
    overrides = [*known.overrides, *left]
    return [*overrides, *(word for word in arguments if word not in overrides)]
