"""Recomputes every belief and message of a study from its log, and compares.

    xplain study replay DATABASE [--head DIGEST]

``--head`` is the head of the log that an earlier export printed: everything up to it must be as it
was then. The database is one that no server has open. Exit code 1 where anything differs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.cli.parser import Parser

if TYPE_CHECKING:
    from xplain.participants.protocol.replay import Findings
    from xplain.participants.stored import Plan


def main(arguments: list[str]) -> None:
    """Compares, and ends the process with exit code 1 where anything differs."""
    from xplain.study.analysis.replay import replay
    from xplain.study.policies import study_of
    from xplain.study.protocol.plan import StudyPlan

    compare(arguments, StudyPlan, study_of, replay)


def compare(
    arguments: list[str],
    kind: type[Plan],
    at_work: Callable[[Plan], Any],
    replay: Callable[..., Findings],
) -> None:
    """Replays the database of any protocol, and says what was compared and what differs.

    Args:
        arguments: of the command line.
        kind: of the plan.
        at_work: what the protocol advances with, of a plan.
        replay: of the connection, the plan at work and the head of the log.
    """
    parser = Parser(f"xplain {kind.COMMAND} replay")
    parser.add_argument("database", type=Path)
    parser.add_argument("--head", default="")
    given = parser.parse_args(arguments)
    from xplain.participants.event_log import head_of
    from xplain.participants.stored import plan_of, reading

    with reading(given.database) as connection:
        found = replay(connection, at_work(plan_of(connection, kind)), given.head)
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
