"""Completion in shells: commands, keys, choices and values.

Hydra writes the shell's part (``-sc install=bash``), which asks ``-sc query=bash`` at each tab;
Hydra completes one configuration, this the one of the command in question.
"""

from __future__ import annotations

import os

from xplain.cli.commands import COMMANDS
from xplain.experiment.config import CONF


def main(words: list[str]) -> None:
    """``-sc`` with what follows it.

    Args:
        words: ``install=SHELL``, ``uninstall=SHELL`` or ``query=SHELL``.
    """
    if words[:1] == ["query=bash"]:
        print(" ".join(completions(os.environ.get("COMP_LINE", ""))))
        return
    from xplain.cli import run

    run.main(["--shell-completion", *words])


def completions(line: str) -> list[str]:
    """What the last word of a command line may become.

    Args:
        line: from the program's name to the cursor.
    """
    typed = line.lstrip().partition(" ")[2].lstrip()
    name = max((n for n in COMMANDS if typed.startswith(f"{n} ")), key=len, default="")
    begun = [
        command[typed.rfind(" ") + 1 :]
        for command in COMMANDS
        if command.startswith(typed) and command.count(" ") == typed.count(" ")
    ]
    if name and not COMMANDS[name].config:
        return begun
    config = COMMANDS[name].config if name else "config"
    return sorted({*begun, *_keys(config, typed[len(name) :].lstrip())})


def _keys(config: str, line: str) -> list[str]:
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.plugins.completion_plugin import DefaultCompletionPlugin

    from xplain.runs import hydra_plugins

    hydra_plugins.register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        return list(plugin._query(config_name=config, line=line))
