"""Which type and condition a participant gets: permuted blocks, slots that come back.

A slot is reserved in the transaction that admits a participant, comes back when they drop out,
time out or are not eligible, and is used up only when they complete.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from xplain.errors import Refused
from xplain.participants.server.database import Do
from xplain.randomness import stream
from xplain.study.protocol.plan import StudyPlan


class Full(Refused):
    """No slot is free now."""


def add_block(do: Do, plan: StudyPlan, stream_name: str, block: int) -> None:
    """One more permuted block: every (type, condition) once, in a seeded order."""
    order = stream(plan.seed, "slots", stream_name, block).permutation(len(plan.cells))
    for i, cell in enumerate(order):
        user_type, condition = plan.cells[cell]
        do(
            "INSERT INTO slot VALUES (?, ?, ?, ?, NULL, 0)",
            (stream_name, block * len(plan.cells) + i, user_type, condition),
        )


def reserve(do: Do, plan: StudyPlan, person: Mapping[str, Any]) -> dict[str, Any]:
    """Takes the first free slot of the person's stream, and draws the orders of questions:
    what the consent event carries.

    Raises:
        Full: people only; pilots and bots get more slots.
    """
    own = person["stream"]
    free = (
        "SELECT * FROM slot WHERE stream = ? AND holder IS NULL AND used = 0 "
        "ORDER BY position LIMIT 1"
    )
    slot = do(free, (own,)).fetchone()
    if slot is None:
        if own == "person":
            raise Full("All places are taken at the moment.")
        (taken,) = do("SELECT count(*) FROM slot WHERE stream = ?", (own,)).fetchone()
        add_block(do, plan, own, taken // len(plan.cells))
        slot = do(free, (own,)).fetchone()
    do(
        "UPDATE slot SET holder = ? WHERE stream = ? AND position = ?",
        (person["id"], own, slot["position"]),
    )
    role = plan.roles[slot["user_type"]]
    rng = stream(plan.seed, "orders", own, person["number"])
    orders = {
        name: rng.permutation(len(items)).tolist()
        for name, items in (("eligibility", role.eligibility), ("quiz", role.quiz))
    }
    return {
        "position": slot["position"],
        "user_type": slot["user_type"],
        "condition": slot["condition"],
        "orders": orders,
    }


def settle(do: Do, who: str, stage: str) -> None:
    """The end of somebody's part: the slot is used up or comes back."""
    if stage == "done":
        do("UPDATE slot SET used = 1 WHERE holder = ?", (who,))
    else:
        do("UPDATE slot SET holder = NULL WHERE holder = ?", (who,))
