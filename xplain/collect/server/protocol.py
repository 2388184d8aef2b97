"""The collection of labels as the server runs it."""

from __future__ import annotations

import base64
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup
from werkzeug.datastructures import MultiDict

from xplain.collect.analysis.labels import Found, found_types, why_left_out
from xplain.collect.protocol import machine
from xplain.collect.protocol.asking import shared
from xplain.collect.protocol.plan import Collection, CollectPlan
from xplain.collect.protocol.state import FINISHED, STAGES, Outcome, State
from xplain.collect.protocol.view import page
from xplain.domains.base import Scene
from xplain.errors import Refused
from xplain.participants.server import forms, map_svg
from xplain.participants.server.database import Do
from xplain.participants.server.protocol import Query
from xplain.randomness import stream


@dataclass(frozen=True)
class Drawing:
    """What is drawn of a clip."""

    scene: Scene | None
    path: tuple[tuple[tuple[int, int], tuple[int, int]], ...] | None
    icons: Mapping[str, str]


def _without(scene: Scene | None, gone: tuple[str, ...]) -> Scene | None:
    """The map when some items are gone; the others keep their colours."""
    return scene and replace(
        scene,
        items=tuple(replace(item, cells=()) if item.name in gone else item for item in scene.items),
    )


def _beside_all(plan: CollectPlan) -> tuple[tuple[int, int], tuple[int, int]]:
    """A place for the robot where it covers nothing, if there is one."""
    taken = {cell for item in plan.scene.items for cell in item.cells} if plan.scene else set()
    return next((path for path in plan.paths if path[0] not in taken), plan.paths[0])


@dataclass(frozen=True)
class CollectProtocol:
    """Implements :class:`xplain.participants.server.protocol.Protocol`."""

    collection: Collection
    _found: dict[tuple[str, ...], Found | None] = field(default_factory=dict)
    templates = Path(__file__).parent / "templates"
    overview = "collecting.html"

    @property
    def plan(self) -> CollectPlan:
        """Of the collection."""
        return self.collection.plan

    @property
    def stages(self) -> tuple[str, ...]:
        """Without the lab's questions where there are none."""
        asked = bool(self.plan.asked)
        return tuple(stage for stage in STAGES if asked or stage != "questions")

    def state(self, text: str | None = None) -> State:
        """See the interface, as for all that follows."""
        return State() if text is None else State.from_text(text)

    def advance(self, state: State, kind: str, payload: Mapping[str, Any]) -> Outcome:
        """By the pure machine."""
        return machine.advance(self.collection, state, kind, payload)

    def found(self, do: Do) -> None:
        """Nothing: nobody needs a place."""

    def admit(self, do: Do, person: Mapping[str, Any]) -> dict[str, Any]:
        """The participant's number, the role whose briefing they get, and what those asked before
        hold wrong: the posteriors of the finished ones of the same stream, whose numbers are kept.
        """
        own, plan = person["stream"], self.plan
        marks = ", ".join("?" * len(FINISHED))
        rows = do(
            "SELECT number, state FROM participant WHERE stream = ? AND "
            f"json_extract(state, '$.stage') IN ({marks}) ORDER BY number",
            (own, *FINISHED),
        ).fetchall()
        before = [(row["number"], State.from_text(row["state"])) for row in rows]
        kept = [(number, state) for number, state in before if not why_left_out(state)]
        return {
            "number": person["number"],
            "role": self._role(do, person) if plan.assigned else None,
            "after": [number for number, _ in kept] if plan.design.from_others else [],
            "others": shared([state.belief for _, state in kept])
            if plan.design.from_others
            else {},
        }

    def _role(self, do: Do, person: Mapping[str, Any]) -> int:
        """The role that fewest people of the stream have who have not left; ties at random."""
        counts = [0] * len(self.plan.roles)
        for row in do(
            "SELECT json_extract(state, '$.role') AS role, count(*) AS number FROM participant "
            "WHERE stream = ? AND json_extract(state, '$.role') IS NOT NULL AND "
            "json_extract(state, '$.stage') NOT IN ('withdrawn', 'timed_out') GROUP BY 1",
            (person["stream"],),
        ):
            counts[row["role"]] = row["number"]
        fewest = [role for role, count in enumerate(counts) if count == min(counts)]
        return int(stream(self.plan.seed, "roles", person["number"]).choice(fewest))

    def readmit(self, do: Do, person: Mapping[str, Any], state: State) -> dict[str, Any]:
        """Nothing: nobody needs a place."""
        return {}

    def pin(self, do: Do, who: str, cell: int) -> None:
        """There are no cells."""
        raise Refused("not_here")

    def settle(self, do: Do, who: str, stage: str) -> None:
        """Nothing to give back."""

    def forget(self) -> None:
        """Questionnaires, states and types found: they are made again."""
        self.collection.kept.clear()
        self._found.clear()
        State.from_text.cache_clear()

    def payload(self, kind: str, form: MultiDict[str, str], state: State) -> dict[str, Any]:
        """What is missing or malformed becomes None, which the protocol refuses."""
        plan = self.plan
        if kind == "consent":
            return {"agree": forms.small(form.get("agree")), "text": form.get("text", "")[:64]}
        if kind == "example":
            return {"label": forms.small(form.get("label"))}
        if kind == "labels" and state.clip is not None:
            steps = range(state.clip.size)
            return {"labels": [forms.small(form.get(f"label_{i}")) for i in steps]}
        if kind == "beliefs":
            facts = range(len(plan.facts))
            return {"stated": [forms.small(form.get(f"fact_{j}")) for j in facts]}
        if kind == "answers":
            return {one.name: form.get(one.name, "").strip() for one in plan.asked}
        return {}

    def view(self, state: State) -> dict[str, Any]:
        """The page's values."""
        return page(self.collection, state)

    def drawing(self) -> dict[str, Any]:
        """The map with a clip's transitions."""
        plan, words = self.plan, self.plan.texts.words

        @functools.lru_cache(4096)
        def drawn(transitions: tuple[int, ...]) -> Markup:
            if not plan.paths:
                return Markup("")
            path = tuple(plan.paths[t] for t in transitions) or (_beside_all(plan),)
            gone = plan.gone[transitions[0]] if plan.gone and transitions else ()
            drawing = Drawing(_without(plan.scene, gone), path, plan.icons)
            return Markup(map_svg.picture(drawing, len(transitions), words))

        legend = map_svg.legend(Drawing(plan.scene, None, plan.icons), words)
        return {
            "map": drawn,
            "legend": [(name, Markup(svg)) for name, svg in legend],
            "changes": plan.changes,
            "titles": {stage: words[stage] for stage in STAGES[:-1]},
        }

    def file(self, name: str) -> tuple[str, bytes] | None:
        """The image of a transition, by its number."""
        number = forms.small(name)
        if number is None or number >= len(self.plan.pictures):
            return None
        picture = self.plan.pictures[number]
        return (picture.media, base64.b64decode(picture.content)) if picture else None

    def glance(self, query: Query) -> dict[str, Any]:
        """Labels so far, the types that are in them, and what more people would bring: of people,
        or of bots while there are none."""
        rows = query("SELECT id, stream, state FROM participant ORDER BY number")
        own = "person" if any(row["stream"] == "person" for row in rows) else "bot"
        states = {row["id"]: State.from_text(row["state"]) for row in rows if row["stream"] == own}
        kept = {who: state for who, state in states.items() if not why_left_out(state)}
        key = tuple(kept)
        if key not in self._found:
            self._found.clear()  # people only get more
            self._found[key] = found_types(self.plan, list(kept.values()))
        left_out = [why_left_out(state) for state in states.values()]
        return {
            "of": own,
            "labels": sum(len(c.labels) for s in kept.values() for c in s.questions()),
            "finished": len(kept),
            "left_out": {why: left_out.count(why) for why in sorted({*left_out} - {""})},
            "found": self._found[key],
            "facts": {fact.name: fact.message for fact in self.plan.facts},
            "expectation": self.plan.expectation,
            "data": "Labels for xplain discover, observers and every answer as CSV tables",
        }

    def about(self, state: State, blinded: bool) -> dict[str, str]:
        """Stage and clip."""
        clip = f", page {len(state.answered) + 1}" if state.stage == "clips" else ""
        return {"Stage": state.stage.replace("_", " ") + clip}

    def export(self, snapshot: Path, folder: Path) -> None:
        """Labels, observers, and all that belongs to them."""
        from xplain.collect.analysis.export import export

        export(snapshot, folder)
