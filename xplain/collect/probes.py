"""What a plan asks simulated people, so that changed code is noticed before it changes a running
collection."""

from __future__ import annotations

from xplain.collect.protocol.plan import Collection, CollectPlan
from xplain.collect.simulation.observer import Habits, observer, take_part
from xplain.errors import XplainError

PROBES = 4
"""Simulated people whose questions a changed code would have to repeat."""


def probes(collection: Collection) -> tuple[str, ...]:
    """The clips and the last posterior of some simulated people, one text a person."""
    found = []
    for number in range(PROBES):
        person = observer(collection.plan, Habits(0.1, mistake=0), 0, number)
        state = take_part(collection, person, number, {})
        clips = [(one.transitions, one.told) for one in state.answered]
        found.append(f"{clips} {[float(share).hex() for share in state.belief.values()]}")
    return tuple(found)


def collection_of(plan: CollectPlan) -> Collection:
    """A plan at work.

    Raises:
        XplainError: the installed code asks differently from the code that made the plan.
    """
    collection = Collection(plan)
    if probes(collection) != plan.probes:
        raise XplainError(
            "database: this version of xplain asks differently from the one that started the "
            "collection; go on with that version, or start anew in another database"
        )
    return collection
