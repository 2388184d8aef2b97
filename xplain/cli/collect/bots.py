"""Lets simulated people give labels in a running collection, over HTTP or in a real browser. They
are marked as bots in the data for ever, and never mixed with people.

    xplain collect bots --key KEY [--url http://127.0.0.1:8080] [--count 40] [--at-once 8]
        [--error 0.05] [--lapse 0] [--leaving 0] [--pace 0] [--chromium] [--seed 0] [--save FILE]

``--key``: the researcher's key, which the server prints; ``--error``: share of wrong answers;
``--lapse``: share of pages clicked through; ``--leaving``: chance to leave, a page; ``--pace``: 1
is real time; ``--save``: where the export (ZIP) goes afterwards.
"""

from __future__ import annotations

from xplain.cli.study.bots import checked, parser, perform


def main(arguments: list[str]) -> None:
    """Runs the bots and prints how far each came."""
    made = parser("xplain collect bots")
    made.add_argument("--error", type=float, default=0.05)
    made.add_argument("--lapse", type=float, default=0.0)
    given = checked(made.parse_args(arguments))
    from xplain.collect.protocol.plan import CollectPlan
    from xplain.collect.simulation.observer import Habits, Observer, observer

    habits = Habits(given.error, given.lapse, leaving=given.leaving)

    def person(plan: CollectPlan, number: int) -> Observer:
        return observer(plan, habits, given.seed, number)

    perform(given, CollectPlan, person)
