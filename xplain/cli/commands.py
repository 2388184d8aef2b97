"""A command: a function with click's options, its help, and its position in the command line."""

import inspect
from collections.abc import Callable
from functools import partial, wraps
from pathlib import Path
from typing import Any

import click

FILE = click.Path(path_type=Path)
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


class Command(click.Command):
    """A command.

    Attributes:
        meaning: description in one line.
        config: name of the command's file in conf/, or "".
        text: help, before the names of the subcommands and the file.
    """

    meaning: str
    config: str
    text: str

    def get_help(self, ctx: click.Context) -> str:
        """Returns the help: the text, a line for each subcommand, and the file in conf/."""
        from xplain.experiment.config import CONF

        parts = [self.text, "\n".join(lines_of(str(self.name)))]
        if self.config:
            parts.append((CONF / f"{self.config}.yaml").read_text(encoding="utf-8"))
        return "\n\n".join(part for part in parts if part)


COMMANDS: dict[str, Command] = {}
"""All commands by name, in the order of the help text."""


def command(name: str, meaning: str, config: str = "", of: str = "", **settings: Any) -> Decorator:
    """Registers a function as a command.

    Args:
        name: name on the command line.
        meaning: description in one line.
        config: name of the command's file in conf/, if any.
        of: ``study`` or ``collect``, if both have a command with this function. The function
            receives this word as its first argument, and the word replaces NAME in the help.
        settings: settings of click's parser.
    """

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        options = getattr(function, "__click_params__", [])[::-1]
        called = partial(function, of) if of else function
        settings["help_option_names"] = ["--help", "-h"]
        made = Command(name, callback=called, params=options, context_settings=settings)
        made.meaning, made.config = meaning, config
        made.text = inspect.cleandoc(function.__doc__ or "").replace("NAME", of)
        COMMANDS[name] = made
        return function

    return register


def keys(function: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a command accept ``key=value`` words, and ``--config-dir FOLDER`` like Hydra's own
    command line. The function receives one list of words."""

    @wraps(function)
    def with_keys(*given: Any, words: tuple[str, ...], config_dir: str | None, **more: Any) -> Any:
        from xplain.experiment.config import search_path

        return function(*given, [*words, *search_path("--config-dir", config_dir)], **more)

    words = click.argument("words", nargs=-1)
    return words(click.option("--config-dir", "-cd")(with_keys))


def lines_of(group: str) -> list[str]:
    """Returns the help's line for each command of a group, followed by a line with the names of its
    subcommands, if any.

    Args:
        group: name of the command with the subcommands; "" for the top level.
    """
    lines = []
    for name, made in COMMANDS.items():
        if name.rpartition(" ")[0] == group:
            lines.append(f"  {name:{18 if group else 11}} {made.meaning}")
            below = [other.rpartition(" ")[2] for other in COMMANDS if other.startswith(f"{name} ")]
            lines += [f"  {name} ...".ljust(14) + ", ".join(below)] if below else []
    return lines
