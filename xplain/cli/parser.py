"""Flags of commands whose options are no keys of a configuration."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from xplain.errors import XplainError


class Parser(argparse.ArgumentParser):
    """Says in one line what is wrong, as everywhere; the door answers ``--help``."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, add_help=False)

    def error(self, message: str) -> NoReturn:
        """Raises XplainError with argparse's message and where the help is."""
        raise XplainError(f"{message}; see {self.prog} --help")


def parsed(prog: str, words: list[str], *names: str, **flags: Any) -> argparse.Namespace:
    """What a command was given.

    Args:
        prog: the command.
        words: that followed it.
        names: of what has to be given, in order; ``database`` and ``folder`` are paths, and
            ``overrides`` any number of ``key=value`` between the flags.
        flags: with their defaults, or the type of one without; ``...`` stands for a text that has
            to be given, False for a switch.
    """
    parser = Parser(prog)
    for name in names:
        many = "*" if name == "overrides" else None
        parser.add_argument(name, nargs=many, type=Path if name in ("database", "folder") else str)
    for name, default in flags.items():
        flag = f"--{name.replace('_', '-')}"
        if default is False:
            parser.add_argument(flag, action="store_true")
        elif isinstance(default, type) or default is ...:
            kind = str if default is ... else default
            parser.add_argument(flag, type=kind, required=default is ...)
        else:
            parser.add_argument(flag, type=type(default), default=default)
    return parser.parse_intermixed_args(words)
