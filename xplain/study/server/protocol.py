"""The study's protocol as the server runs it."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup
from werkzeug.datastructures import MultiDict

from xplain.participants.server import map_svg
from xplain.participants.server.database import Do
from xplain.participants.server.forms import small
from xplain.study.protocol import machine
from xplain.study.protocol.machine import Outcome, State
from xplain.study.protocol.plan import Study, StudyPlan
from xplain.study.protocol.view import page
from xplain.study.server import slots

_WIDTH = re.compile(r"[1-9][0-9]{1,4}\Z")


@dataclass(frozen=True)
class StudyProtocol:
    """Implements :class:`xplain.participants.server.protocol.Protocol`."""

    study: Study
    templates = Path(__file__).parent / "templates"
    overview = "researcher.html"

    @property
    def plan(self) -> StudyPlan:
        """Of the study."""
        return self.study.plan

    @property
    def stages(self) -> tuple[str, ...]:
        """Without questions where the plan asks none."""
        without = {
            "before": not self.plan.before,
            "eligibility": bool(self.plan.kinds),
            "questions": not self.plan.asked,
        }
        return tuple(stage for stage in machine.STAGES if not without.get(stage))

    def state(self, text: str | None = None) -> State:
        """See the interface, as for all that follows."""
        return State() if text is None else State.from_text(text)

    def advance(self, state: State, kind: str, payload: Mapping[str, Any]) -> Outcome:
        """By the pure machine."""
        return machine.advance(self.study, state, kind, payload)

    def found(self, do: Do) -> None:
        """The people's slots."""
        slots.found(do, self.plan)

    def admit(self, do: Do, person: Mapping[str, Any]) -> dict[str, Any]:
        """Reserves a slot."""
        return slots.reserve(do, self.plan, person)

    def readmit(self, do: Do, person: Mapping[str, Any], state: State) -> dict[str, Any]:
        """Takes a slot like the one that was lost."""
        return slots.retake(do, self.plan, person, state)

    def pin(self, do: Do, who: str, cell: int) -> None:
        """A slot of this type and condition."""
        slots.pin(do, self.plan, who, cell)

    def settle(self, do: Do, who: str, stage: str) -> None:
        """The slot is used up or comes back."""
        slots.settle(do, who, stage)

    def forget(self) -> None:
        """States: they are read again."""
        State.from_text.cache_clear()

    def payload(self, kind: str, form: MultiDict[str, str], state: State) -> dict[str, Any]:
        """What is missing or malformed becomes None, which the protocol refuses."""
        plan = self.plan
        if kind == "consent":
            width = (form.getlist("width") or [""])[-1]
            return {
                "agree": small(form.get("agree")),
                "text": form.get("text", "")[:64],
                "width": int(width) if _WIDTH.match(width) else None,
            }
        if kind == "screening":
            return {asked.name: form.get(asked.name, "").strip() for asked in plan.before}
        if kind == "example":
            return {"label": small(form.get("label"))}
        if kind == "eligibility" and state.user_type is not None:
            questions = plan.roles[state.user_type].eligibility
            return {"answers": [small(form.get(f"q{i}")) for i in range(len(questions))]}
        if kind == "labels":
            kept = list(state.labels[: state.step])
            sent = [small(form.get(f"label_{i}")) for i in range(state.step + 1)]
            # An earlier label that is not sent again stays as it was.
            old = [kept[i] if label is None else label for i, label in enumerate(sent[: len(kept)])]
            return {"labels": [*old, *sent[len(kept) :]]}
        if kind == "quiz":
            return {"chosen": [small(text) for text in form.getlist("true")[:100]]}
        if kind == "answers":
            return {asked.name: form.get(asked.name, "").strip() for asked in plan.asked}
        return {}

    def view(self, state: State) -> dict[str, Any]:
        """The page's values, and what the plan says of the evaluation."""
        rules = self.plan.rules
        return page(self.study, state) | {"recall": rules.recall, "n_steps": self.plan.n_steps}

    def drawing(self) -> dict[str, Any]:
        """The map after a number of steps."""
        plan, words = self.plan, self.plan.texts.words

        @functools.cache
        def drawn(steps: int) -> Markup:
            gone = plan.taken[steps] if plan.taken else ()
            return Markup(map_svg.picture(plan, steps, words, gone))

        return {
            "map": drawn,
            "legend": [(name, Markup(svg)) for name, svg in map_svg.legend(plan, words)],
            "changes": plan.changes,
            "titles": {stage: words[stage] for stage in machine.STAGES[:-1]}
            | {"briefing": words["briefing_natural" if plan.kinds else "briefing"]},
        }

    def glance(self, query: Callable[[str], list[dict[str, Any]]]) -> dict[str, Any]:
        """Which slots are left."""
        left = query(
            "SELECT stream, user_type, condition, sum(used) AS completed, "
            "sum(used = 0 AND holder IS NOT NULL) AS held, sum(holder IS NULL) AS free "
            "FROM slot GROUP BY stream, user_type, condition ORDER BY stream, user_type, condition"
        )
        roles = [role.name for role in self.plan.roles]
        cells = [f"{roles[t]}, {condition}" for t, condition in self.plan.cells]
        return {
            "slots": left,
            "roles": self.plan.roles,
            "cells": cells,
            "data": "CSV and Parquet tables",
        }

    def about(self, state: State, blinded: bool) -> dict[str, str]:
        """Stage and step; type and condition."""
        step = f", step {state.step + 1}" if state.stage == "evaluation" else ""
        found = {"Stage": state.stage.replace("_", " ") + step}
        if blinded:
            return found
        role = "" if state.user_type is None else self.plan.roles[state.user_type].name
        return found | {"Type": role, "Condition": state.condition or ""}

    def export(self, snapshot: Path, folder: Path) -> None:
        """The tidy tables."""
        from xplain.study.analysis.export import export

        export(snapshot, folder)

    def file(self, name: str) -> None:
        """None: a study's map is drawn."""
        return None
