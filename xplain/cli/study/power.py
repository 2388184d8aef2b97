"""Power curves for the planned study, and what they hang on, from simulated participants.

    xplain study power [--out FOLDER] [--people 200] [--studies 2000] [--n 50] [key=value ...]

``--people``: simulated ones a cell; ``--studies``: planned studies a point; ``--n``: participants
a condition, for the sensitivity. Keys are those of conf/study.yaml.
"""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import Parser
from xplain.config import composed
from xplain.errors import whole_number


def main(arguments: list[str]) -> None:
    """Writes the curves, as tables and plots, into the folder, and prints their figures."""
    parser = Parser("xplain study power")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("--out", type=Path, default=Path("outputs/study/power"))
    parser.add_argument("--people", type=int, default=200)
    parser.add_argument("--studies", type=int, default=2000)
    parser.add_argument("--n", type=int, default=50)
    given = parser.parse_intermixed_args(arguments)
    for key in ("people", "studies", "n"):
        whole_number(f"--{key}", getattr(given, key), 2)
    import pandas as pd

    from xplain.people.study import power
    from xplain.people.study.policies import study_of
    from xplain.people.study.prepare import study_plan

    study = study_of(study_plan(composed("study", given.overrides)))
    rows = pd.DataFrame(power.write(study, given.out, given.people, given.studies, given.n))
    for key, whose in (("simulated_holm", "simulated people"), ("paper_effect_holm", "the paper")):
        figures = rows.pivot(index="n_per_condition", columns="measure", values=key)
        print(f"power, corrected for three tests; effects of {whose}\n{figures.round(2)}\n")
    print(f"power.csv, sensitivity.csv and their plots in {given.out}")
