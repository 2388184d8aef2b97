"""How the participants of a study listened and answered, from its log (``study habits``)."""

from __future__ import annotations

import json
from itertools import groupby
from pathlib import Path

import numpy as np

from xplain.errors import InputError
from xplain.explanation.listening import Explained
from xplain.people.analysis.stored import rows_of
from xplain.people.study.plan import StudyPlan

STEPS = """
    SELECT step.* FROM step JOIN participant ON participant.id = step.participant
    WHERE stream = ? AND labels IS NOT NULL ORDER BY participant, k
"""


def listeners_in(database: Path, stream: str = "person") -> list[Explained]:
    """What was said to each participant of a stream, and what they answered; as far as they came.

    Args:
        database: of a study that no server has open, or a snapshot.
        stream: "person", "pilot" or "bot"; never mixed.

    Raises:
        InputError: it is no study's database, or there is no such stream.
    """
    plan, rows = rows_of(database, stream, StudyPlan, STEPS)
    people = [list(own) for _, own in groupby(rows, key=lambda row: row["participant"])]
    if not people:
        raise InputError("database", str(database), f"one with answers (stream {stream})")
    return [
        Explained(
            plan.problem,
            [row["messages"] for row in own],
            [np.array(json.loads(row["labels"]), np.uint8) for row in own],
        )
        for own in people
    ]
