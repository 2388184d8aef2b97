"""The collection of labels as the server runs it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from xplain.errors import Refused
from xplain.people import map_svg, site
from xplain.people.collect.asking import FINISHED, CollectState, schedule, shared
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectPlan
from xplain.people.collect.tables import KnownSoFar, compared, export, found_types, why_left_out
from xplain.people.export import ParticipantRow
from xplain.people.site import Do
from xplain.randomness import stream


class CollectSite(site.Site[Collection]):
    """Everybody who comes is asked, and their prior takes in what others answered before."""

    PLAN = CollectPlan
    TEMPLATES = Path(__file__).parent / "templates"
    OVERVIEW = "collecting.html"
    export = staticmethod(export)

    def __init__(self, flow: Collection) -> None:
        super().__init__(flow)
        self._found: dict[tuple[str, ...], KnownSoFar | None] = {}

    @classmethod
    def of(cls, plan: CollectPlan) -> CollectSite:
        """With its questionnaires; see the base class, as for all that follows."""
        return cls(Collection(plan))

    def admit(self, do: Do, person: Mapping[str, Any]) -> dict[str, Any]:
        """The participant's number, the role whose briefing they get, and what those asked before
        hold wrong: the posteriors of the finished ones of the same stream, whose numbers are kept.
        """
        own, plan = person["stream"], self.plan
        marks = ", ".join("?" * len(FINISHED))
        rows = do(
            "SELECT number, state FROM seen WHERE stream = ? AND "
            f"json_extract(state, '$.stage') IN ({marks}) ORDER BY number",
            (own, *FINISHED),
        ).fetchall()
        before = {row["number"]: CollectState.from_text(row["state"]) for row in rows}
        kept = {
            number: state.belief
            for number, state in before.items()
            if plan.design.from_others and not why_left_out(state)
        }
        return {
            "number": person["number"],
            "role": self._role(do, person) if plan.assigned else None,
            "after": list(kept),
            "others": shared(list(kept.values())),
        }

    def _role(self, do: Do, person: Mapping[str, Any]) -> int:
        """The role that fewest people of the stream have who have not left; ties at random."""
        counts = [0] * len(self.plan.roles)
        for row in do(
            "SELECT json_extract(state, '$.role') AS role, count(*) AS number FROM seen "
            "WHERE stream = ? AND json_extract(state, '$.role') IS NOT NULL AND "
            "json_extract(state, '$.stage') NOT IN ('withdrawn', 'timed_out') GROUP BY 1",
            (person["stream"],),
        ):
            counts[row["role"]] = row["number"]
        fewest = [role for role, count in enumerate(counts) if count == min(counts)]
        return int(stream(self.plan.seed, "roles", person["number"]).choice(fewest))

    def check_cell(self, cell: int) -> None:
        """Everybody is asked by their own answers: there is one way to see it."""
        if cell:
            raise Refused("not_understood")

    def forget(self) -> None:
        """Questionnaires and types found too: they are made again."""
        super().forget()
        self.flow.kept.cache_clear()
        self._found.clear()

    def picture(self, what: tuple[int, ...]) -> Markup:
        """The map with a clip's transitions; without any, the robot where it covers nothing."""
        plan = self.plan
        if not plan.paths:
            return Markup()
        gone = plan.gone[what[0]] if plan.gone and what else ()
        taken = {cell for item in plan.scene.items for cell in item.cells} if plan.scene else set()
        beside = next((path for path in plan.paths if path[0] not in taken), plan.paths[0])
        path = tuple(plan.paths[t] for t in what) or (beside,)
        return map_svg.picture(plan, path, len(what), gone)

    def glance(self, query: site.Query) -> dict[str, Any]:
        """Labels so far, the types that are in them, and what more people would bring: of people,
        or of bots while there are none."""
        rows = query("SELECT id, stream, state FROM seen ORDER BY number")
        own = "person" if any(row["stream"] == "person" for row in rows) else "bot"
        states = {
            row["id"]: CollectState.from_text(row["state"]) for row in rows if row["stream"] == own
        }
        kept = {who: state for who, state in states.items() if not why_left_out(state)}
        key = tuple(kept)
        if key not in self._found:
            self._found = {key: found_types(self.plan, list(kept.values()))}  # people only get more
        left_out = [why_left_out(state) for state in states.values()]
        return {
            "of": own,
            "labels": sum(len(c.labels) for s in kept.values() for c in s.questions()),
            "finished": len(kept),
            "left_out": {why: left_out.count(why) for why in sorted({*left_out} - {""})},
            "found": self._found[key],
            "compared": compared(self.plan, list(kept.values())),
            "facts": {fact.name: fact.message for fact in self.plan.facts},
            "planned": self.plan.rules.people,
            "cells": ["a participant"],
            "data": "Labels for xplain discover, observers and every answer as CSV tables",
        }

    def step_of(self, state: CollectState) -> str:
        """Of the clips."""
        return f"page {len(state.answered) + 1}" if state.clip else ""

    def unequal(
        self, connection: sqlite3.Connection, people: list[ParticipantRow[CollectState]]
    ) -> Iterator[str]:
        """The prior must be that of people of the same stream who had answered every clip. Where
        one of them was erased it stands as the log has it: their part of it is all that stays."""
        numbered, clips = {one.row["number"]: one for one in people}, len(schedule(self.plan, 0))
        query = "SELECT number FROM participant WHERE erased"
        erased = {number for (number,) in connection.execute(query)}
        for one in people:
            consent = one.first("consent")
            if not consent.get("agree"):
                continue
            who = one.row["id"]
            if consent["number"] != one.row["number"]:
                yield f"{who}: admitted as {consent['number']}"
            before = [numbered.get(number) for number in consent["after"] if number not in erased]
            known = [p for p in before if p and p.row["stream"] == one.row["stream"]]
            if len(known) < len(before) or any(len(p.state.answered) < clips for p in known):
                yield f"{who}: the prior is of people who had not finished"
            elif erased.intersection(consent["after"]):
                continue
            elif shared([p.state.belief for p in known]) != consent["others"]:
                yield f"{who}: the prior differs from what others answered"
