"""Lets simulated participants take part in a running study, over HTTP or in a real browser. They
are marked as bots in the data for ever, and take nobody's place.

    xplain study bots --key KEY [--url http://127.0.0.1:8080] [--count 40] [--at-once 8]
        [--pace 0] [--leaving 0] [--chromium] [--seed 0] [--save FILE]

``--key``: the researcher's key, which the server prints; ``--pace``: 1 is real time;
``--leaving``: chance to leave, a page; ``--save``: where the export (ZIP) goes afterwards.
"""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.cli.parser import Parser
from xplain.errors import InputError, XplainError

if TYPE_CHECKING:
    from xplain.participants.protocol.plan import StoredPlan
    from xplain.participants.simulation.http_client import Visitor


def main(arguments: list[str]) -> None:
    """Runs the bots and prints how far each came."""
    given = checked(parser("xplain study bots").parse_args(arguments))
    from xplain.randomness import stream
    from xplain.study.protocol.plan import StudyPlan
    from xplain.study.simulation.participant import Habits, Person

    habits = Habits(leaving=given.leaving)

    def person(plan: StudyPlan, number: int) -> Person:
        return Person(plan, habits, stream(given.seed, "bots", number))

    perform(given, StudyPlan, person)


def parser(name: str) -> Parser:
    """What every kind of bot can be told."""
    made = Parser(name)
    made.add_argument("--url", default="http://127.0.0.1:8080")
    made.add_argument("--key", required=True)
    made.add_argument("--count", type=int, default=40)
    made.add_argument("--at-once", type=int, default=8)
    made.add_argument("--pace", type=float, default=0.0)
    made.add_argument("--leaving", type=float, default=0.0)
    made.add_argument("--chromium", action="store_true")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--save", type=Path)
    return made


def checked(given: Namespace) -> Namespace:
    """The arguments, where they can be.

    Raises:
        InputError: a number out of its range, or no browser to drive.
    """
    for name, value in (("--count", given.count), ("--at-once", given.at_once)):
        if not 0 < value <= 10_000:
            raise InputError(name, value, "a whole number from 1 to 10000")
    from xplain.participants.simulation import chromium

    if given.chromium and (what := chromium.missing()):
        raise InputError("--chromium", "not here", f"install {what}")
    return given


def perform(
    given: Namespace, kind: type[StoredPlan], person_of: Callable[[Any, int], Visitor]
) -> None:
    """Lets bots take part, prints how far each came, and saves the export.

    Args:
        given: by :func:`parser`.
        kind: of the plan.
        person_of: the bot of a plan with a number.

    Raises:
        XplainError: the server went away.
    """
    from xplain.participants.simulation.bots import Researcher, crowd

    try:
        researcher = Researcher(given.url, given.key)
        person = partial(person_of, researcher.plan(kind))
        stages = crowd(researcher, given.count, given.at_once, given.pace, person, given.chromium)
        if given.save:
            given.save.write_bytes(researcher.archive())
    except (ConnectionError, TimeoutError) as error:
        raise XplainError(f"--url={given.url}: the server went away ({error})") from None
    print(", ".join(f"{number} {stage}" for stage, number in stages.most_common()))
