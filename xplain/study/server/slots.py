"""Which type and condition a participant gets: permuted blocks, slots that come back.

A slot is reserved in the transaction that admits a participant, comes back when they drop out,
time out or are not eligible, and is used up only when they complete.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from xplain.errors import Refused
from xplain.participants.server.database import Do
from xplain.participants.server.protocol import Full
from xplain.randomness import stream
from xplain.study.protocol.plan import StudyPlan

PREVIEW = "preview"
"""Stream of the slots of pilots who see what the researcher chose."""

SCHEMA = (
    """
    CREATE TABLE slot (
        stream TEXT NOT NULL,
        position INTEGER NOT NULL,          -- order of assignment
        user_type INTEGER NOT NULL,
        condition TEXT NOT NULL,
        holder TEXT REFERENCES participant (id),
        used INTEGER NOT NULL DEFAULT 0,    -- 1 once its holder has completed
        PRIMARY KEY (stream, position)
    ) STRICT
    """,
    "CREATE INDEX slot_holder ON slot (holder)",
    """
    CREATE TRIGGER slot_fixed BEFORE UPDATE ON slot
    WHEN (NEW.stream, NEW.position, NEW.user_type, NEW.condition)
         IS NOT (OLD.stream, OLD.position, OLD.user_type, OLD.condition)
         OR (OLD.used AND NOT EXISTS
             (SELECT 1 FROM meta WHERE key = 'erasing' AND value = OLD.holder))
    BEGIN SELECT RAISE(ABORT, 'what a slot is never changes'); END
    """,
    """
    CREATE TRIGGER slot_kept BEFORE DELETE ON slot
    BEGIN SELECT RAISE(ABORT, 'slots are never deleted'); END
    """,
    """
    CREATE TRIGGER slot_of_the_erased AFTER INSERT ON meta WHEN NEW.key = 'erasing'
    BEGIN UPDATE slot SET holder = NULL, used = 0 WHERE holder = NEW.value; END
    """,
)


def found(do: Do, plan: StudyPlan) -> None:
    """Makes the table, and the slots of all people."""
    for statement in SCHEMA:
        do(statement)
    for block in range(plan.rules.per_cell):
        add_block(do, plan, "person", block)


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
    slot = do("SELECT * FROM slot WHERE holder = ?", (person["id"],)).fetchone()
    if slot is None:  # not pinned
        slot = _take(do, plan, person, "", ())
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


def retake(do: Do, plan: StudyPlan, person: Mapping[str, Any], state: Any) -> dict[str, Any]:
    """A slot like the one that somebody lost by being silent: the same type and condition.

    Raises:
        Full: there is none (people only).
        Refused: they did not lose any.
    """
    if state.stage != "timed_out":
        raise Refused("other_page")
    of_cell = "AND user_type = ? AND condition = ?"
    slot = _take(do, plan, person, of_cell, (state.user_type, state.condition))
    return {"position": slot["position"]}


def pin(do: Do, plan: StudyPlan, who: str, cell: int) -> None:
    """A slot for somebody who is to see this cell of the plan.

    Raises:
        Refused: there is no such cell.
    """
    if not 0 <= cell < len(plan.cells):
        raise Refused("not_understood")
    (count,) = do("SELECT count(*) FROM slot WHERE stream = ?", (PREVIEW,)).fetchone()
    do("INSERT INTO slot VALUES (?, ?, ?, ?, ?, 0)", (PREVIEW, count, *plan.cells[cell], who))


def _take(
    do: Do, plan: StudyPlan, person: Mapping[str, Any], which: str, parameters: tuple[Any, ...]
) -> Mapping[str, Any]:
    """The first free slot of the person's stream, now held by them."""
    own = person["stream"]
    free = (
        f"SELECT * FROM slot WHERE stream = ? AND holder IS NULL AND used = 0 {which} "
        "ORDER BY position LIMIT 1"
    )
    slot: Mapping[str, Any] | None = do(free, (own, *parameters)).fetchone()
    if slot is None:
        if own == "person":
            raise Full("full")
        (taken,) = do("SELECT count(*) FROM slot WHERE stream = ?", (own,)).fetchone()
        add_block(do, plan, own, taken // len(plan.cells))
        slot = do(free, (own, *parameters)).fetchone()
    assert slot is not None, "a block has every cell"
    do(
        "UPDATE slot SET holder = ? WHERE stream = ? AND position = ?",
        (person["id"], own, slot["position"]),
    )
    return slot


def settle(do: Do, who: str, stage: str) -> None:
    """The end of somebody's part: the slot is used up or comes back."""
    if stage == "done":
        do("UPDATE slot SET used = 1 WHERE holder = ?", (who,))
    else:
        do("UPDATE slot SET holder = NULL WHERE holder = ?", (who,))
