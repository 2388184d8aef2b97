"""Writes a saved problem for other programs:
``xplain export problem=FILE.npz format=pomdp output=FILE.pomdp``.
"""

from __future__ import annotations

from pathlib import Path

from xplain.errors import InputError
from xplain.experiment.config import composed
from xplain.storage import written_whole


def export(arguments: list[str]) -> Path:
    """Writes the file, whole or not at all; returns its path."""
    cfg = composed("export", arguments)
    if cfg.format != "pomdp":
        raise InputError("format", cfg.format, "pomdp")
    from xplain.explanation.pomdp_file import lines
    from xplain.explanation.problem_file import load

    output = Path(cfg.output)
    problem = load(cfg.problem)
    with written_whole(output) as file:
        file.writelines(f"{line}\n" for line in lines(problem))
    return output


def main(arguments: list[str]) -> None:
    """Writes the file and prints its path."""
    print(export(arguments))
