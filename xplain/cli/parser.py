"""Flags of commands whose options are no keys of a configuration."""

from __future__ import annotations

import argparse
from typing import NoReturn

from xplain.errors import XplainError


class Parser(argparse.ArgumentParser):
    """Says in one line what is wrong, as everywhere; the door answers ``--help``."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, add_help=False)

    def error(self, message: str) -> NoReturn:
        """Raises XplainError with argparse's message and where the help is."""
        raise XplainError(f"{message}; see {self.prog} --help")
