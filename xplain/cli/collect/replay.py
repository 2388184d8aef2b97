"""Recomputes every question and posterior of a collection from its log, and compares.

    xplain collect replay DATABASE

The database is one that no server has open. Exit code 1 where anything differs.
"""

from __future__ import annotations

import sys
from pathlib import Path

from xplain.cli.parser import Parser


def main(arguments: list[str]) -> None:
    """Compares, and ends the process with exit code 1 where anything differs."""
    parser = Parser("xplain collect replay")
    parser.add_argument("database", type=Path)
    given = parser.parse_args(arguments)
    from xplain.collect.analysis.replay import replay
    from xplain.collect.probes import collection_of
    from xplain.collect.stored import plan_of
    from xplain.study.stored import reading

    with reading(given.database) as connection:
        found = replay(connection, collection_of(plan_of(connection)))
    for difference in found.differences:
        print(difference, file=sys.stderr)
    verdict = f"{len(found.differences)} differences" if found.differences else "all equal"
    print(
        f"{found.participants} participants, {found.events} answers, {found.steps} clips "
        f"replayed: {verdict}"
    )
    if found.differences:
        sys.exit(1)
