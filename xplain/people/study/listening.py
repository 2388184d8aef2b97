"""How the participants of a study listened and answered, from its log (``study habits``)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from xplain.errors import InputError, one_of
from xplain.explanation.listening import Explained
from xplain.people.analysis.export import participants
from xplain.people.analysis.stored import STREAMS, plan_of, reading
from xplain.people.study.flow import StudyState
from xplain.people.study.plan import StudyPlan
from xplain.people.study.tables import steps_of


def listeners_in(database: Path, stream: str = "person") -> list[Explained]:
    """What was said to each participant of a stream, and what they answered; as far as they came.

    Args:
        database: of a study that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.

    Raises:
        InputError: it is no study's database, or there is no such stream.
    """
    one_of("stream", stream, STREAMS)
    with reading(database) as connection:
        plan = plan_of(connection, StudyPlan)
        everybody = participants(connection, StudyState)
    own = [steps_of(one) for one in everybody if one.row["stream"] == stream]
    labelled = [[step for step in steps if step["labels"]] for steps in own]
    if not any(labelled):
        raise InputError("database", str(database), f"one with answers (stream {stream})")
    return [
        Explained(
            plan.problem,
            [step["messages"] for step in steps],
            [np.array(json.loads(step["labels"]), np.uint8) for step in steps],
        )
        for steps in labelled
        if steps
    ]
