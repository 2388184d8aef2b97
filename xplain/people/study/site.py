"""The study as the server runs it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from xplain.errors import Refused
from xplain.people.analysis.export import ParticipantRow
from xplain.people.plan import Pictures
from xplain.people.server import map_svg, site
from xplain.people.server.database import Do
from xplain.people.study.flow import Study, StudyState
from xplain.people.study.plan import ASKING, StudyPlan
from xplain.people.study.policies import at_work, faultless, probes
from xplain.people.study.tables import export
from xplain.randomness import stream

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

FREE = """
    SELECT * FROM slot WHERE stream = :stream AND holder IS NULL AND used = 0
    AND (:user_type IS NULL OR (user_type, condition) = (:user_type, :condition))
    ORDER BY position LIMIT 1
"""


def _count(do: Do, stream_name: str) -> int:
    """Slots of a stream, free ones and others."""
    (count,) = do("SELECT count(*) FROM slot WHERE stream = ?", (stream_name,)).fetchone()
    return int(count)


class StudySite(site.Site[Study]):
    """Gives places, so that types and conditions are balanced."""

    PLAN = StudyPlan
    TEMPLATES = Path(__file__).parent / "templates"
    OVERVIEW = "researcher.html"
    BLIND = True
    export = staticmethod(export)
    probes = staticmethod(probes)

    @classmethod
    def as_planned(cls, plan: StudyPlan) -> StudySite:
        """With its policies; see the base class, as for all that follows."""
        return cls(at_work(plan))

    def announcement(self) -> str:
        """Where some are asked, what that is worth to people who never err."""
        if ASKING not in self.plan.conditions:
            return ""
        met = faultless(self.flow).items()
        costs = ", ".join(f"{np.mean([o.cost for o in every]):.2f} {name}" for name, every in met)
        asked = np.mean([one.n_questions for name, every in met if name == ASKING for one in every])
        return (
            f"study: λ · messages + inexplicable labels + κ · questions of people who never err: "
            f"{costs} ({asked:.1f} questions)\n"
        )

    # Places: permuted blocks of every type and condition. A slot is reserved in the transaction
    # that admits a participant, comes back when they drop out, time out or are not eligible, and
    # is used up only when they complete.

    def found(self, do: Do) -> None:
        """Makes the table, and the slots of all people."""
        for statement in SCHEMA:
            do(statement)
        for _ in range(self.plan.rules.per_cell):
            self._add_block(do, "person")

    def _add_block(self, do: Do, stream_name: str) -> None:
        """One more permuted block: every (type, condition) once, in a seeded order."""
        cells, taken = self.plan.cells, _count(do, stream_name)
        rng = stream(self.plan.seed, "slots", stream_name, taken // len(cells))
        for position, cell in enumerate(rng.permutation(len(cells)), taken):
            do(
                "INSERT INTO slot VALUES (?, ?, ?, ?, NULL, 0)",
                (stream_name, position, *cells[cell]),
            )

    def admit(self, do: Do, person: Mapping[str, Any]) -> dict[str, Any]:
        """Takes the first free slot of the person's stream, and draws the orders of questions."""
        slot = do("SELECT * FROM slot WHERE holder = ?", (person["id"],)).fetchone()
        if slot is None:  # not pinned
            slot = self._take(do, person)
        role = self.plan.roles[slot["user_type"]]
        rng = stream(self.plan.seed, "orders", person["stream"], person["number"])
        tests = {"eligibility": role.eligibility, "quiz": role.quiz}
        orders = {name: rng.permutation(len(test)).tolist() for name, test in tests.items()}
        taken = {key: slot[key] for key in ("position", "user_type", "condition")}
        return taken | {"orders": orders}

    def readmit(self, do: Do, person: Mapping[str, Any], state: StudyState) -> dict[str, Any]:
        """A slot like the one that somebody lost by being silent: the same type and condition."""
        if state.stage != "timed_out":
            raise Refused("other_page")
        return {"position": self._take(do, person, state)["position"]}

    def pin(self, do: Do, who: str, cell: int) -> None:
        """A slot for somebody who is to see this cell of the plan."""
        cells = self.plan.cells
        if not 0 <= cell < len(cells):
            raise Refused("not_understood")
        do(
            "INSERT INTO slot VALUES (?, ?, ?, ?, ?, 0)",
            (PREVIEW, _count(do, PREVIEW), *cells[cell], who),
        )

    def _take(
        self, do: Do, person: Mapping[str, Any], like: StudyState | None = None
    ) -> Mapping[str, Any]:
        """The first free slot of the person's stream, now held by them: any, or of the type and
        condition of a state. People find none where all are taken; pilots and bots get more."""
        own, cell = person["stream"], like or StudyState()
        wanted = {"stream": own, "user_type": cell.user_type, "condition": cell.condition}
        slot: Mapping[str, Any] | None = do(FREE, wanted).fetchone()
        if slot is None and own == "person":
            raise site.Full("full")
        if slot is None:
            self._add_block(do, own)
            slot = do(FREE, wanted).fetchone()
        assert slot is not None, "a block has every cell"
        where = (person["id"], own, slot["position"])
        do("UPDATE slot SET holder = ? WHERE stream = ? AND position = ?", where)
        return slot

    def settle(self, do: Do, who: str, stage: str) -> None:
        """The slot is used up or comes back."""
        change = "used = 1" if stage == "done" else "holder = NULL"
        do(f"UPDATE slot SET {change} WHERE holder = ?", (who,))

    # Pages ---------------------------------------------------------------------------------------

    def picture(self, what: int | tuple[str, int]) -> Markup:
        """The map after a number of steps, or with one clip."""
        plan = self.plan
        if isinstance(what, tuple):
            clip = plan.clips[what[1]]
            return map_svg.picture(plan, clip.way or None, 1, clip.gone)
        gone = plan.taken[what] if plan.taken else ()
        return map_svg.picture(plan, plan.path, what, gone)

    def drawing(self) -> dict[str, Any]:
        """Who is not briefed reads of the task; on a map a trace is shown."""
        drawn, words = super().drawing(), self.plan.texts.words
        legend = map_svg.legend(self.plan, self.plan.path is not None)
        title = words["briefing_natural" if self.plan.kinds else "briefing"]
        own = {"briefing": title, "asking": words["asking"]}
        return drawn | {"titles": drawn["titles"] | own, "legend": legend}

    @cached_property
    def pictures(self) -> Pictures:
        """After those of the trace those of the clips."""
        plan = self.plan
        of_trace = plan.pictures or (None,) * plan.n_steps
        return (*of_trace, *(clip.picture for clip in plan.clips))

    def glance(self, query: site.Query) -> dict[str, Any]:
        """Which slots are left."""
        left = query(
            "SELECT stream, user_type, condition, sum(used) AS completed, "
            "sum(used = 0 AND holder IS NOT NULL) AS held, sum(holder IS NULL) AS free "
            "FROM slot GROUP BY stream, user_type, condition ORDER BY stream, user_type, condition"
        )
        roles = self.plan.roles
        cells = [f"{roles[t].name}, {condition}" for t, condition in self.plan.cells]
        data = "CSV and Parquet tables"
        return {"slots": left, "roles": roles, "cells": cells, "data": data}

    def step_of(self, state: StudyState) -> str:
        """Of the evaluation."""
        if state.stage == "asking":
            return f"before step {state.step + 1}"
        return f"step {state.step + 1}" if state.stage == "evaluation" else ""

    def about(self, state: StudyState, blinded: bool) -> dict[str, str]:
        """Also type and condition."""
        role = "" if state.user_type is None else self.plan.roles[state.user_type].name
        hidden = {} if blinded else {"Type": role, "Condition": state.condition or ""}
        return super().about(state, blinded) | hidden

    def unequal(
        self, connection: sqlite3.Connection, people: list[ParticipantRow[StudyState]]
    ) -> Iterator[str]:
        """Slots whose holder is of another type, or has left."""
        for slot in connection.execute(
            "SELECT slot.*, participant.state AS state, "
            "iif(entry = 'preview', 'preview', participant.stream) AS whose FROM slot "
            "JOIN participant ON participant.id = slot.holder"
        ):
            state = StudyState.from_text(slot["state"])
            cell = (state.user_type, state.condition, slot["whose"])
            done = state.stage == "done"
            if (
                cell != (slot["user_type"], slot["condition"], slot["stream"])
                or bool(slot["used"]) != done
                or (state.over and not done)
            ):
                yield f"slot {slot['stream']} {slot['position']}: {slot['holder']}"
