"""A document to register before the first participant, from the plan: hypotheses, design,
measures, exclusions, analysis and sample size.

    xplain study preregister DATABASE [--out FILE]

DATABASE holds a study that was started once: what is registered is what runs.
"""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import parsed


def main(arguments: list[str]) -> None:
    """Prints the document, or writes it into a file."""
    given = parsed("xplain study preregister", arguments, "database", out=Path)
    from xplain.errors import InputError
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
