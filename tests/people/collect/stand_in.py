"""A collection about a street: a domain that has no texts of its own, with few simulated people."""

from dataclasses import replace
from typing import Any

from omegaconf import OmegaConf

from tests.people.study.stand_in import AHEAD, TYPES, Street
from xplain.domains.users.types import Explicit
from xplain.experiment.config import CONF
from xplain.people.collect.bot import Habits
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectPlan, CollectRules
from xplain.people.collect.prepare import assemble
from xplain.people.material import Material
from xplain.questions.designs import Adaptive, Battery

FAULTLESS = Habits(error=0.0, mistake=0.0)
RULES: dict[str, Any] = {"people": 6, "repeats": 2, "attention": True, "timeout_minutes": 30}
STREET = Street()


def wording(**changes: Any) -> dict[str, Any]:
    """Returns the texts that every task has."""
    files = ("neutral.yaml", "texts/en.yaml")
    shipped = OmegaConf.merge(*(OmegaConf.load(CONF / "collect" / file) for file in files))
    texts: Any = OmegaConf.to_container(shipped)
    texts["words"] |= OmegaConf.to_container(OmegaConf.load(CONF / "words" / "en.yaml"))
    questions = [
        {"name": "age", "label": "Your age", "kind": "number", "low": 18, "high": 110},
        {"name": "comment", "label": "Anything else?", "kind": "text", "max_length": 200},
    ]
    return {str(key): value for key, value in texts.items()} | {"questions": questions} | changes


def street_plan(
    design: Adaptive | Battery | None = None,
    points: int = 12,
    briefing: str = "none",
    seed: int = 3,
    words: dict[str, Any] | None = None,
    **rules: Any,
) -> CollectPlan:
    """Makes a plan for the street."""
    users = Explicit({one.name: list(one.inaccurate) for one in TYPES})
    config = {"seed": seed, "briefing": briefing, "wording": words or wording(), "points": points}
    plan = assemble(
        Material.of_domain(STREET, users, seed),
        design or Adaptive(),
        CollectRules(points=points, **RULES | rules),
        config,
    )
    return at_work(plan).plan


def at_work(plan: CollectPlan) -> Collection:
    """Makes a collection with a practice step that looks odd, from the text of its plan."""
    return Collection(CollectPlan.from_text(replace(plan, ahead=AHEAD).text))


def street_collection(*args: Any, **changes: Any) -> Collection:
    """Makes the collection of the street's plan."""
    return Collection.of(street_plan(*args, **changes))


def telling() -> Collection:
    """Makes a collection in which every question has other messages; the street's questions need no
    messages."""
    plan = street_plan()
    transitions = plan.hypotheses.n_transitions
    listed = tuple((told % transitions, told) for told in range(2, 14))
    return Collection(replace(plan, questions=listed))
