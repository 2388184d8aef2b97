"""The experiment: one run, or a sweep of them."""

from __future__ import annotations

import sys

import hydra
from hydra._internal.utils import get_args_parser

from xplain.errors import InputError, XplainError
from xplain.experiment.config import CONF, named
from xplain.report.summary import SWEEP
from xplain.runs import hydra_plugins
from xplain.runs.folder import SweepFolder
from xplain.runs.start import job, start


def main(arguments: list[str]) -> None:
    """Hydra's command line, with our sweeper and the group ``sweeps``.

    Args:
        arguments: overrides and Hydra's flags; ``--keys`` shows every key and choice.

    Raises:
        SystemExit: 1 when jobs of a sweep failed.
    """
    words = ["--help" if word == "--keys" else word for word in arguments]
    known, left = get_args_parser().parse_known_args(words)
    overrides = [*known.overrides, *left]
    if unknown := [word for word in left if word.startswith("-")]:
        key, _, value = unknown[0].lstrip("-").partition("=")
        after = arguments[arguments.index(unknown[0]) + 1 :]
        value = value or (after[0] if after and "=" not in after[0] else "VALUE")
        raise XplainError(
            f"{unknown[0]}: no such flag; keys are written without dashes: {key}={value}"
        )
    if known.help or known.hydra_help or known.cfg or known.info or known.shell_completion:
        _show([*overrides, *(word for word in words if word not in overrides)])
        return
    for flag in ("config_path", "package", "experimental_rerun"):
        if (value := getattr(known, flag)) is not None:
            raise InputError(f"--{flag.replace('_', '-')}", value, "--config-dir or --config-name")
    name = known.config_name
    folder = start(overrides, known.multirun or None, known.config_dir, config_name=name)
    if folder is not None and (folder / SWEEP).exists():
        sweep = SweepFolder(folder)
        if any(sweep.state(job) != "finished" for job in sweep.jobs()):
            raise SystemExit(1)


def _show(words: list[str]) -> None:
    """What Hydra tells of the configuration: it runs nothing. Overrides come before flags: Hydra
    takes none on both sides of a flag."""
    hydra_plugins.register()
    before, sys.argv = sys.argv, ["xplain", *named(words)]  # Hydra reads nothing else
    try:
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(job)()
    finally:
        sys.argv = before
