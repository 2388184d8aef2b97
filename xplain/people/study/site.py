"""The study as the server runs it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from xplain.errors import Refused
from xplain.people import map_svg, site
from xplain.people.export import ParticipantRow
from xplain.people.plan import Pictures
from xplain.people.site import Do
from xplain.people.study.flow import Study, StudyState
from xplain.people.study.plan import ASKING, StudyPlan
from xplain.people.study.policies import at_work, faultless
from xplain.people.study.tables import export
from xplain.randomness import stream


class StudySite(site.Site[Study]):
    """Gives places, so that types and conditions are balanced."""

    PLAN = StudyPlan
    TEMPLATES = Path(__file__).parent / "templates"
    OVERVIEW = "researcher.html"
    export = staticmethod(export)

    @classmethod
    def of(cls, plan: StudyPlan) -> StudySite:
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

    # Places: permuted blocks of every type and condition. Somebody holds a place from the consent
    # on, gives it back by dropping out, timing out or not being eligible, and uses it up by
    # completing: all of this is in their states.

    def cell(self, stream_name: str, position: int) -> tuple[int, str]:
        """Type and condition of a place: in each block every cell once, in a seeded order."""
        block, place = divmod(position, len(self.plan.cells))
        rng = stream(self.plan.seed, "slots", stream_name, block)
        return self.plan.cells[int(rng.permutation(len(self.plan.cells))[place])]

    def holders(self, rows: Iterable[Mapping[str, Any]]) -> dict[tuple[str, int], StudyState]:
        """{(stream, position): state} of everybody who holds a place or has used it up.

        Args:
            rows: with stream and state.
        """
        states = [(row["stream"], self.state(row["state"])) for row in rows]
        return {(own, one.place): one for own, one in states if one.place is not None}

    def admit(self, do: Do, person: Mapping[str, Any]) -> dict[str, Any]:
        """The first free place of the person's stream, and the orders of questions. Who shall see
        a cell of the plan takes no place."""
        enter = "SELECT json_extract(payload, '$.cell') FROM event WHERE participant = ?"
        (cell,) = do(f"{enter} AND sequence = 0", (person["id"],)).fetchone()
        if cell is None:
            position: int | None = self._free(do, person["stream"])
            assert position is not None
            user_type, condition = self.cell(person["stream"], position)
        else:
            position, (user_type, condition) = None, self.plan.cells[cell]
        role = self.plan.roles[user_type]
        rng = stream(self.plan.seed, "orders", person["stream"], person["number"])
        tests = {"eligibility": role.eligibility, "quiz": role.quiz}
        orders = {name: rng.permutation(len(test)).tolist() for name, test in tests.items()}
        place = {"position": position, "user_type": user_type, "condition": condition}
        return place | {"orders": orders}

    def readmit(self, do: Do, person: Mapping[str, Any], state: StudyState) -> dict[str, Any]:
        """A place like the one that somebody lost by being silent: the same type and condition."""
        if state.position is None:
            return {}
        return {"position": self._free(do, person["stream"], state)}

    def check_cell(self, cell: int) -> None:
        """One for every type under every condition."""
        if not 0 <= cell < len(self.plan.cells):
            raise Refused("not_understood")

    def _free(self, do: Do, own: str, like: StudyState | None = None) -> int:
        """The first free place of a stream: any, or of the type and condition of a state. People
        find none where all are taken; pilots and bots always find one."""
        rows = do("SELECT stream, state FROM seen WHERE stream = ?", (own,)).fetchall()
        held, most = self.holders(rows), self.plan.rules.per_cell * len(self.plan.cells)
        for position in range(most) if own == "person" else count():
            fits = like is None or self.cell(own, position) == (like.user_type, like.condition)
            if fits and (own, position) not in held:
                return position
        raise site.Full("full")

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
        """With the title of questions in between; on a map the legend shows the robot's way."""
        drawn = super().drawing()
        legend = map_svg.legend(self.plan, self.plan.path is not None)
        asking = {"asking": self.plan.texts.words["asking"]}
        return drawn | {"titles": drawn["titles"] | asking, "legend": legend}

    @cached_property
    def pictures(self) -> Pictures:
        """After those of the trace those of the clips."""
        plan = self.plan
        of_trace = plan.pictures or (None,) * plan.n_steps
        return (*of_trace, *(clip.picture for clip in plan.clips))

    def glance(self, query: site.Query) -> dict[str, Any]:
        """Which places are left."""
        held, plan = self.holders(query("SELECT stream, state FROM seen")), self.plan
        rows = []
        for own in sorted({"person", *(name for name, _ in held)}):
            for user_type, condition in plan.cells:
                inside = [
                    one.stage == "done"
                    for (name, _), one in held.items()
                    if (name, one.user_type, one.condition) == (own, user_type, condition)
                ]
                free = plan.rules.per_cell - len(inside) if own == "person" else None
                rows.append(
                    {"stream": own, "user_type": user_type, "condition": condition}
                    | {"completed": sum(inside), "held": inside.count(False), "free": free}
                )
        cells = [f"{plan.roles[t].name}, {condition}" for t, condition in plan.cells]
        data = "CSV and Parquet tables"
        return {"slots": rows, "roles": plan.roles, "cells": cells, "data": data}

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
        """Places of another type or condition than the plan's, and places that two hold."""
        held: dict[tuple[str, int], str] = {}
        for one in people:
            state, own, place = one.state, one.row["stream"], one.state.place
            if place is None:
                continue
            if self.cell(own, place) != (state.user_type, state.condition):
                yield f"place {place} of {own}: {one.id} is of another type or condition"
            if other := held.get((own, place)):
                yield f"place {place} of {own}: held by {other} and {one.id}"
            held[own, place] = one.id
