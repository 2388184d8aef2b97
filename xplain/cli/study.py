"""The commands of the user study alone; each docstring is the command's help."""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import parsed
from xplain.errors import InputError


def preregister(arguments: list[str]) -> None:
    """A document to register before the first participant, from the plan: hypotheses, design,
    measures, exclusions, analysis and sample size.

        xplain study preregister DATABASE [--out FILE]

    DATABASE holds a study that was started once: what is registered is what runs.
    """
    given = parsed("xplain study preregister", arguments, "database", out=Path)
    from xplain.people.analysis.stored import read_plan
    from xplain.people.study.plan import StudyPlan
    from xplain.people.study.preregistration import document

    plan = read_plan(given.database, StudyPlan)
    if plan is None:
        raise InputError("database", str(given.database), "one in which a study was started")
    text = document(plan)
    if given.out is None:
        print(text, end="")
        return
    given.out.write_text(text, encoding="utf-8")
    print(f"preregistration in {given.out}")


def analyse(arguments: list[str]) -> None:
    """The paper's Table 2 from an export of the study, with plots; where a condition asks, also how
    it compares with the personalized one.

        xplain study analyse FOLDER [--stream person] [--exclude FILE] [--seed 0] [--out FOLDER]

    FOLDER holds participants.csv, as exported; ``--stream`` is person, pilot or bot; ``--exclude``
    a CSV file with the columns participant and reason; ``--seed`` that of the permutation tests.
    """
    flags = {"stream": "person", "exclude": Path, "seed": 0, "out": Path}
    given = parsed("xplain study analyse", arguments, "folder", **flags)
    from rich.console import Console

    from xplain.people.study import table2
    from xplain.people.study.report import exclusions, save, show

    found = table2.analyses(
        table2.read(given.folder), given.stream, exclusions(given.exclude), seed=given.seed
    )
    out = given.out or given.folder
    files: list[str] = []
    for name, analysis in found.items():
        files += save(analysis, out, name)
        show(analysis, Console(width=None if Console().is_terminal else 150))
    print(f"{', '.join(dict.fromkeys(files))} in {out}")
