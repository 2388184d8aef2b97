"""A street, a domain that no code of the pages knows: a study and a collection about it, and people
who take part.

A street has crossings. At each the robot goes straight on, or walks around (one step longer).
Whoever believes that going straight is bad there expects it to walk around.
"""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from omegaconf import OmegaConf

from tests.people.visitors import take_part
from xplain.domains.base import Item, Parameter, Scene
from xplain.domains.mdp import MDP
from xplain.domains.users.setting import Setting, UserType
from xplain.domains.users.types import Explicit
from xplain.experiment.config import CONF
from xplain.explanation.label_table import LabelTable
from xplain.people.bots import Bot
from xplain.people.collect.bot import Habits as Observing
from xplain.people.collect.bot import Observer
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import CollectPlan, CollectRules
from xplain.people.collect.prepare import assemble
from xplain.people.flow import Flow
from xplain.people.material import Material
from xplain.people.plan import Ahead
from xplain.people.store import Store
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.prepare import conditions_of, make_draft
from xplain.questions.designs import Adaptive, Battery

FAULTLESS = Habits(0, 0, 0, 0, mistake=0)
"""Habits of a participant who never errs, forgets or leaves."""

SCREENS = 4
"""Screens of the street's briefing: the task, its four facts on two screens, and the participants'
job."""

PLACES = ("bridge", "market", "school", "tunnel")
AHEAD = Ahead(("Qback <Qand> & Qforth", "Qfetched"), (((0, 1), (0, 0)),) * 2)
"""The street itself leads nowhere but to its end."""


class Street:
    """The smallest domain with four facts; the value of one parameter is not a number."""

    name = "street"
    actions = ("straight", "around")
    feature_names = ("crossing", "aside")

    def __init__(self, map_shown: bool = True) -> None:
        self.map_shown = map_shown
        self.parameters = tuple(
            Parameter(
                place,
                True if place == "tunnel" else 0.0,
                False if place == "tunnel" else -3.0,
                f"The {place} is fine for the robot & quick.",
                f"The {place} is bad for the <robot>.",
            )
            for place in PLACES
        )
        n = len(PLACES)
        self.state_features = np.array([[s % (n + 1), s // (n + 1)] for s in range(2 * n + 2)])
        self.starts = np.array([0])

    def model(self, values: Mapping[str, Any]) -> MDP:
        n = len(PLACES)
        states = 2 * (n + 1)  # crossings 0 … n, then the ways around them
        successor = np.zeros((states, 2, 1), dtype=np.int64)
        probability = np.zeros((states, 2, 1))
        reward = np.zeros((states, 2, 1))
        for j, place in enumerate(PLACES):
            value = values[place]
            cost = (0.0 if value else -3.0) if isinstance(value, bool) else float(value)
            successor[j, 0], successor[j, 1], successor[n + 1 + j, 0] = j + 1, n + 1 + j, j + 1
            probability[j], probability[n + 1 + j, 0] = 1.0, 1.0
            reward[j, 0] = cost + 5.0 * (j == n - 1)
            reward[n + 1 + j, 0] = 5.0 * (j == n - 1)
        terminal = np.zeros(states, dtype=bool)
        terminal[[n, 2 * n + 1]] = True
        return MDP(successor, probability, reward, 0.9, terminal)

    def describe(self, transition: Any) -> str:
        return f"goes {self.actions[int(transition[1])]} at the {PLACES[int(transition[0])]}"

    def position(self, state: int) -> tuple[int, int] | None:
        n = len(PLACES)
        return (1 if state > n else 0, state % (n + 1)) if self.map_shown else None

    @property
    def scene(self) -> Scene | None:
        if not self.map_shown:
            return None
        items = tuple(Item(place, place[0].upper(), ((0, j),)) for j, place in enumerate(PLACES))
        return Scene(2, len(PLACES) + 1, (), items)


TYPES = (
    UserType("X", {"bridge": -3.0, "market": -3.0}),
    UserType("Y", {"market": -3.0, "school": -3.0}),
    UserType("Z", {"school": -3.0, "tunnel": False}),
)


def english_words() -> dict[str, str]:
    """Returns all texts of the pages in English."""
    shared = yaml.safe_load((CONF / "words" / "en.yaml").read_text(encoding="utf-8"))
    own = yaml.safe_load((CONF / "study" / "texts" / "en.yaml").read_text(encoding="utf-8"))
    return {**shared, **own["words"]}


CONFIG: dict[str, Any] = {
    "seed": 3,
    "lambda": 1.0,
    "message_cost": 1.0,
    "inexplicability_cost": 1.0,
    "discount": 0.95,
    "discount_per": "action",
    "prior": "uniform",
    "conditions": {
        "personalized": {"_target_": "xplain.solvers.greedy.QMDP"},
        "conformant": {"_target_": "xplain.solvers.greedy.Conformant"},
    },
    "belief": {"_target_": "xplain.explanation.belief.Independent"},
    "rules": {"per_cell": 2, "max_attempts": 2, "timeout_minutes": 30},
    "briefing": "assigned",
    "before": [],
    "questions": [
        {"name": "age", "label": "Your age", "kind": "number", "low": 18, "high": 110},
        {"name": "comment", "label": "Anything else?", "kind": "text", "max_length": 200},
    ],
    "wording": {
        "title": "A street",
        "contact": "nobody",
        "consent": ["Do you want to?"],
        "introduction": ["A robot walks."],
        "introduction_natural": [],
        "briefed": {"consent": ["Not all is right."], "debriefing": ["On purpose."]},
        "task": ["Label."],
        "asking": {"task": ["Now and then one more."], "debriefing": ["Asked or not, bye."]},
        "debriefing": ["Bye."],
        "known": [],
        "facts": {},
        "phrases": {},
        "words": english_words(),
        "example": {"belief": "b", "action": "a", "message": "m"},
        "rewards": {"bridge": "Crossing the bridge"},
        "ahead": None,
        "icons": {"market": "M3 12L12 4L21 12"},
    },
}


def street_plan(map_shown: bool = True, **changes: Any) -> StudyPlan:
    """Makes a plan for the street; its only optimal trace goes straight at every crossing."""
    setting = Setting.build(Street(map_shown), TYPES)
    trace = np.array([[j, 0, j + 1] for j in range(len(PLACES))])
    labels = setting.label_table(trace)
    config = CONFIG | changes
    config["conditions"] = conditions_of(config)
    material, p = Material.of(setting), 0.02 + 0.96 * labels
    rows = material.rows_of(trace)
    clips = None
    if "asking" in config["conditions"]:  # the robot makes no other steps than those of the trace
        told = [*material.clips]
        told[rows[0]] = replace(told[rows[0]], situation=("Qthen <Qso> & Qso.",))
        material, clips = replace(material, clips=tuple(told)), (rows, LabelTable.dense(p))
    plan = make_draft(material, rows, LabelTable.dense(p), config, asks=clips)
    return StudyPlan.from_text(replace(plan, ahead=AHEAD if map_shown else None).text)


ASK = {"kinds": ["clips"], "cost": 0.1, "most": 10, "when": "anytime", "clips": 150}
"""Settings of a study in which one condition asks."""


def street_study(**changes: Any) -> Study:
    """Makes the study of the street's plan."""
    return Study.of(street_plan(**changes))


FAULTLESS_OBSERVER = Observing(error=0.0, mistake=0.0)


def wording(**changes: Any) -> dict[str, Any]:
    """Returns the texts that every task has."""
    files = ("neutral.yaml", "texts/en.yaml")
    shipped = OmegaConf.merge(*(OmegaConf.load(CONF / "collect" / file) for file in files))
    texts: Any = OmegaConf.to_container(shipped)
    texts["words"] |= OmegaConf.to_container(OmegaConf.load(CONF / "words" / "en.yaml"))
    own = {"questions": CONFIG["questions"], **changes}
    return {str(key): value for key, value in texts.items()} | own


def collection_plan(
    design: Adaptive | Battery | None = None,
    points: int = 12,
    briefing: str = "none",
    seed: int = 3,
    words: dict[str, Any] | None = None,
    **rules: Any,
) -> CollectPlan:
    """Makes a plan for the street."""
    usual = {"people": 6, "repeats": 2, "attention": True, "timeout_minutes": 30}
    users = Explicit({one.name: list(one.inaccurate) for one in TYPES})
    config = {"seed": seed, "briefing": briefing, "wording": words or wording(), "points": points}
    plan = assemble(
        Material.of_domain(Street(), users, seed),
        design or Adaptive(),
        CollectRules(points=points, **{**usual, **rules}),
        config,
    )
    return at_work(plan).plan


def at_work(plan: CollectPlan) -> Collection:
    """Makes a collection with a practice step that looks odd, from the text of its plan."""
    return Collection(CollectPlan.from_text(replace(plan, ahead=AHEAD).text))


def street_collection(*args: Any, **changes: Any) -> Collection:
    """Makes the collection of the street's plan."""
    return Collection.of(collection_plan(*args, **changes))


def telling() -> Collection:
    """Makes a collection in which every question has other messages; the street's questions need no
    messages."""
    plan = collection_plan()
    transitions = plan.hypotheses.n_transitions
    listed = tuple((told % transitions, told) for told in range(2, 14))
    return Collection(replace(plan, questions=listed))


KINDS = ("study", "collect")
ASKING = "asking"
"""A study all of whose people are asked, where pages are meant."""


@cache
def flow_of(kind: str) -> Flow[Any, Any]:
    """Makes one flow for all tests; no result depends on its cache."""
    if kind == "study":
        return street_study()
    if kind == ASKING:
        own = {"asking": CONFIG["conditions"]["personalized"]}
        return street_study(ask=ASK, conditions=own)
    return street_collection(listening=2)


def bot_of(flow: Flow[Any, Any], *seeds: int, **habits: Any) -> Bot[Any, Any]:
    """Makes a participant who never errs, except for these habits."""
    rng = np.random.default_rng(seeds)
    if isinstance(flow, Study):
        return StudyBot(flow.plan, replace(FAULTLESS, **habits), rng)
    roles, own = flow.plan.roles, replace(FAULTLESS_OBSERVER, **habits)
    return Observer(flow.plan, roles[seeds[-1] % len(roles)].held, own, rng)


def filled(kind: str, path: Path, people: int = 3) -> list[str]:
    """Makes a database in which this number of people reached the end; returns their ids in order
    of arrival."""
    with closing(Store(path, flow_of(kind))) as store:
        ends = take_part(store, (bot_of(store.flow, number) for number in range(people)))
        assert {*ends} == {"done"}
        return [one.id for one in store.present()]
