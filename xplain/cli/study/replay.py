"""Recomputes every belief and message of a study from its log, and compares.

    xplain study replay DATABASE [--head DIGEST]

``--head`` is the head of the log that an earlier export printed: everything up to it must be as it
was then. The database is one that no server has open. Exit code 1 where anything differs.
"""

from __future__ import annotations

import sys
from pathlib import Path

from xplain.cli.parser import Parser


def main(arguments: list[str]) -> None:
    """Compares, and ends the process with exit code 1 where anything differs."""
    parser = Parser("xplain study replay")
    parser.add_argument("database", type=Path)
    parser.add_argument("--head", default="")
    given = parser.parse_args(arguments)
    from xplain.event_log import head_of
    from xplain.study.analysis.replay import replay
    from xplain.study.policies import study_of
    from xplain.study.stored import plan_of, reading

    with reading(given.database) as connection:
        found = replay(connection, study_of(plan_of(connection)), given.head)
        head = head_of(connection)
    for difference in found.differences:
        print(difference, file=sys.stderr)
    verdict = f"{len(found.differences)} differences" if found.differences else "all equal"
    print(
        f"{found.participants} participants, {found.events} answers, {found.steps} steps "
        f"replayed{f', {found.erased} erased' if found.erased else ''}: {verdict}\n"
        f"head of the log: {head}"
    )
    if found.differences:
        sys.exit(1)
