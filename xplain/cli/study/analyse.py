"""The paper's Table 2 from an export of the study, with plots.

    xplain study analyse FOLDER [--stream person] [--exclude FILE] [--seed 0] [--out FOLDER]

FOLDER holds participants.csv, as exported; ``--stream`` is person, pilot or bot; ``--exclude`` a
CSV file with the columns participant and reason; ``--seed`` that of the permutation tests.
"""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import parsed


def main(arguments: list[str]) -> None:
    """Writes and prints Table 2 of an export."""
    flags = {"stream": "person", "exclude": Path, "seed": 0, "out": Path}
    given = parsed("xplain study analyse", arguments, "folder", **flags)
    from rich.console import Console

    from xplain.people.study.report import exclusions, save, show
    from xplain.people.study.table2 import analyse, read

    analysis = analyse(read(given.folder), given.stream, exclusions(given.exclude), seed=given.seed)
    out = given.out or given.folder
    save(analysis, out)
    show(analysis, Console(width=None if Console().is_terminal else 150))
    print(f"table2.csv, flow.csv, measures.png in {out}")
