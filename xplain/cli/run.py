"""The experiment: one run, or a sweep of them, as Hydra's command line has it."""

from __future__ import annotations

from itertools import groupby

from xplain.errors import XplainError
from xplain.experiment.config import require_names
from xplain.runs import command

FLAGS = (
    *("help", "hydra-help", "version", "cfg", "resolve", "package", "run", "multirun"),
    *("shell-completion", "config-path", "config-name", "config-dir", "info"),
)
"""Hydra's."""


def main(arguments: list[str]) -> None:
    """Runs what the command line of this process says.

    Args:
        arguments: of the command line.

    Raises:
        XplainError: a flag that Hydra has not, or where it cannot take it.
        SystemExit: 1 when jobs of a sweep failed.
    """
    for i, word in enumerate(arguments):
        key, _, value = word.removeprefix("--").partition("=")
        if word.startswith("--") and key not in FLAGS:
            after = arguments[i + 1 : i + 2]
            value = value or (after[0] if after and "=" not in after[0] else "VALUE")
            raise XplainError(
                f"{word}: no such flag; keys are written without dashes: {key}={value}"
            )
    turns = [kind for kind, _ in groupby("=" in w and not w.startswith("-") for w in arguments)]
    if turns.count(True) > 1:
        raise XplainError("-m and other flags stand before all keys, or after all of them")
    require_names(arguments)
    command.main()
