"""Writes a saved problem for other programs:
``python -m xplain.cli.export problem=FILE.npz format=pomdp output=FILE.pomdp``.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from xplain.config import CONF, compose_for, report_errors
from xplain.errors import InputError


def export(arguments: list[str]) -> Path:
    """Writes the file, whole or not at all; returns its path."""
    cfg = compose_for("export", arguments)
    if cfg.format != "pomdp":
        raise InputError("format", cfg.format, "pomdp")
    from xplain.explanation.pomdp_file import lines
    from xplain.explanation.problem import Problem

    output = Path(cfg.output)
    unfinished = output.with_name(output.name + ".unfinished")
    problem = Problem.load(cfg.problem)
    try:
        with unfinished.open("w", encoding="ascii") as file:
            file.writelines(f"{line}\n" for line in lines(problem))
        os.replace(unfinished, output)
    finally:
        unfinished.unlink(missing_ok=True)
    return output


def main() -> None:
    """The command."""
    if "--help" in sys.argv[1:]:
        print(__doc__)
        print((CONF / "export.yaml").read_text(encoding="utf-8"))
        return
    with report_errors():
        print(export(sys.argv[1:]))


if __name__ == "__main__":
    main()
