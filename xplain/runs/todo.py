"""What a sweep still has to do, decided from how far its jobs are: no file is touched here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from xplain.runs.folder import State


@dataclass(frozen=True)
class Todo:
    """What one start of a sweep does; jobs go by their fingerprints.

    Attributes:
        finished: done already.
        copied: where the same results are already, outside of this sweep.
        run: all others that were asked for, in the sweep's order.
    """

    finished: tuple[str, ...]
    copied: Mapping[str, Path]
    run: tuple[str, ...]


def decide(states: Mapping[str, State], resume: str, elsewhere: Mapping[str, Path]) -> Todo:
    """What is to be done.

    Args:
        states: of all jobs, in the sweep's order.
        resume: ``missing`` (all that is not finished), ``failed`` (only jobs that failed) or
            ``none`` (all of them anew, copying none).
        elsewhere: folders of finished results that may be copied.
    """
    if resume == "none":
        return Todo((), {}, tuple(states))
    finished = tuple(key for key, state in states.items() if state == "finished")
    wanted = [
        key
        for key, state in states.items()
        if (state == "failed" if resume == "failed" else state != "finished")
    ]
    copied = {key: elsewhere[key] for key in wanted if key in elsewhere}
    return Todo(finished, copied, tuple(key for key in wanted if key not in copied))
