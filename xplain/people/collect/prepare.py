"""From configuration to the plan of a collection."""

from __future__ import annotations

import base64
import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xplain.config import require_seed
from xplain.domains.base import Domain, Scene, changes_of
from xplain.errors import InputError, number
from xplain.message_sets import mask_of, names_of
from xplain.people.ahead import ahead_of
from xplain.people.collect.bot import probes
from xplain.people.collect.expectation import expect
from xplain.people.collect.flow import Collection
from xplain.people.collect.plan import (
    CollectPlan,
    Example,
    Picture,
    Role,
    Rules,
)
from xplain.people.plan import Ahead, Asked, Fact, Told, Way, facts_of
from xplain.people.wording import each, fixed, of_states, parts, worded
from xplain.questions.battery import battery
from xplain.questions.designs import Adaptive, Battery, hypotheses_of
from xplain.questions.hypotheses import Hypotheses
from xplain.questions.own_transitions import read_transitions, with_features
from xplain.randomness import derived_seed, stream
from xplain.users.types import TypeSource

if TYPE_CHECKING:
    from omegaconf import DictConfig

MEDIA = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".webp": "image/webp",
    ".gif": "image/gif",
}
MAX_IMAGE = 2 << 20
"""Bytes of one image."""
DRAWN_ROLES = 4
"""Kinds of simulated people where nobody wrote down which there may be."""


@dataclass(frozen=True)
class Source:
    """A task that people can be asked about.

    Attributes:
        name: of the task.
        hypotheses: T transitions with phrases and features.
        whole: see :class:`CollectPlan`.
        facts: [n] sentences.
        roles: {name: bitmask of what it holds wrong}, of simulated people.
        situations, gone, paths, changes, scene, ahead, pictures: see :class:`CollectPlan`.
        domain, users: of the task, where there is a model of it.
    """

    name: str
    hypotheses: Hypotheses
    facts: tuple[Fact, ...]
    roles: Mapping[str, int]
    situations: Told = ()
    gone: Told = ()
    paths: Way = ()
    changes: Told = ()
    scene: Scene | None = None
    ahead: Ahead | None = None
    pictures: tuple[Picture | None, ...] = field(default_factory=tuple)
    whole: Hypotheses | None = None
    domain: Domain | None = None
    users: TypeSource | None = None


def collect_plan(cfg: DictConfig) -> CollectPlan:
    """The plan that a configuration describes, with what it lets one expect.

    Raises:
        XplainError: the configuration cannot be used; the text says what to change.
    """
    from hydra.utils import instantiate

    require_seed(cfg)
    config = fixed(cfg)
    rules = Rules(points=config["points"], **config["rules"])  # refused before the work
    error = number("expected_error", config["expected_error"])
    if not 0 <= error < 0.5:
        raise InputError("expected_error", error, "a share in [0, 0.5)")
    design = instantiate(cfg.queries)
    if not isinstance(design, Adaptive | Battery):
        raise InputError("queries", config["queries"]["_target_"], "battery or adaptive")
    if isinstance(design, Adaptive) and design.in_turn:
        raise InputError("queries.in_turn", True, "false: people are asked as they come")
    if config["briefing"] not in ("none", "assigned"):
        raise InputError("briefing", config["briefing"], "none or assigned")
    source = source_of(cfg)
    if config["briefing"] == "assigned" and source.domain is None:
        raise InputError(
            "briefing", "assigned", "none for one's own transitions: they name no types"
        )
    plan = assemble(source, design, rules, config)
    return with_expectation(plan, source, error)


def source_of(cfg: DictConfig) -> Source:
    """The task: a domain of conf/domain/, or a table of one's own transitions."""
    from hydra.utils import instantiate

    if cfg.transitions is not None:
        return own_source(Path(cfg.transitions), cfg.facts, cfg.seed)
    if cfg.facts is not None:
        raise InputError("facts", cfg.facts, "only with transitions=TABLE; a domain has sentences")
    return domain_source(instantiate(cfg.domain), instantiate(cfg.users), cfg.seed)


def domain_source(domain: Domain, users: TypeSource, seed: int) -> Source:
    """What a domain knows of itself.

    Raises:
        InputError: a parameter lacks a sentence.
    """
    whole = hypotheses_of(domain, None)
    known = whole.told_apart_by_features()
    types = users.types(domain, stream(seed, "users"))
    names = known.messages
    assert known.states is not None, "hypotheses of a domain know states"
    assert whole.states is not None, "the same"
    cells = [tuple(domain.position(int(state)) for state in pair) for pair in known.states]
    paths = tuple((a, b) for a, b in cells if a is not None and b is not None)
    drawn = domain.scene is not None and len(paths) == len(cells)
    return Source(
        name=domain.name,
        hypotheses=known,
        whole=whole,
        facts=facts_of(domain.parameters),
        roles={one.name: mask_of(one.inaccurate, names) for one in types},
        situations=of_states(domain, "situation", known.states[:, 0]),
        gone=of_states(domain, "gone", known.states[:, 0]),
        paths=paths if drawn else (),
        changes=() if drawn else _changes(domain, known),
        scene=domain.scene if drawn else None,
        ahead=ahead_of(domain, whole.states, whole.labels, lambda t: whole.phrases[t]),
        domain=domain,
        users=users,
    )


def _changes(domain: Domain, known: Hypotheses) -> Told:
    """What each transition changes; the phrases of such domains name the action first."""
    assert known.states is not None, "hypotheses of a domain know states"
    actions = [
        next((a for a, name in enumerate(domain.actions) if phrase.startswith(name)), 0)
        for phrase in known.phrases
    ]
    transitions = np.column_stack([known.states[:, 0], actions, known.states[:, 1]])
    return changes_of(domain, transitions)


def own_source(table: Path, facts: str | None, seed: int) -> Source:
    """One's own transitions, and the sentences of the facts.

    Raises:
        InputError: a table cannot be read, a fact has no sentences, or an image cannot be shown.
    """
    own = read_transitions(table)
    known = with_features(own.hypotheses)
    shown = zip(own.images, own.alts, strict=True)
    pictures = tuple(_picture(table.parent, image, alt) for image, alt in shown)
    return Source(
        name=table.stem,
        hypotheses=known,
        facts=read_facts(facts, known.messages),
        roles=drawn_roles(known, seed),
        pictures=pictures if any(pictures) else (),
    )


def read_facts(path: str | None, names: Sequence[str]) -> tuple[Fact, ...]:
    """The sentences of facts, from a CSV table with the columns fact, message and belief.

    Raises:
        InputError: no such table, or a fact without a sentence in it.
    """
    wanted = "a .csv file with the columns fact, message, belief: the robot's value, and what "
    wanted += f"somebody who holds it wrong would say, of {', '.join(names)}"
    if path is None:
        raise InputError("facts", None, wanted)
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            rows = {(row.get("fact") or "").strip(): row for row in csv.DictReader(file)}
    except (OSError, UnicodeDecodeError, csv.Error):
        raise InputError("facts", str(path), wanted) from None
    found = []
    for name in names:
        row = rows.get(name, {})
        message, belief = ((row.get(key) or "").strip() for key in ("message", "belief"))
        if not message or not belief:
            raise InputError("facts", name, f"a message and a belief in {path}")
        found.append(Fact(name, message, belief))
    return tuple(found)


def drawn_roles(known: Hypotheses, seed: int) -> dict[str, int]:
    """Some fact sets that behave differently, none of them empty, for simulated people."""
    sets = np.unique(known.essential[known.essential > 0])
    chosen = stream(seed, "roles").permutation(sets)[:DRAWN_ROLES].tolist()
    return {"+".join(names_of(held, known.messages)): held for held in chosen}


def _picture(folder: Path, image: str, alt: str) -> Picture | None:
    if not image:
        return None
    path = folder / image
    if path.suffix.lower() not in MEDIA:
        raise InputError("transitions.image", image, f"a file that ends in {', '.join(MEDIA)}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError("transitions.image", image, f"a file in {folder} ({error})") from None
    if len(content) > MAX_IMAGE:
        raise InputError("transitions.image", image, f"at most {MAX_IMAGE >> 20} MB")
    return Picture(MEDIA[path.suffix.lower()], base64.b64encode(content).decode(), alt)


def assemble(
    source: Source, design: Adaptive | Battery, rules: Rules, config: Mapping[str, Any]
) -> CollectPlan:
    """A plan from its parts, without expectation and probes.

    Raises:
        XplainError: a part contradicts another.
    """
    known, wording = source.hypotheses, config["wording"]
    for key in ("icons", "hide"):
        if wording[key] and source.domain is None:
            raise InputError(f"wording.{key}", [*wording[key]], "none: these steps have no map")
    own, in_words = parts("collect", config, wording, source.scene)
    known = replace(known, phrases=tuple(map(in_words, known.phrases)))
    facts = worded(source.facts, wording["facts"], in_words)
    listed: tuple[tuple[int, int], ...] = ()
    if isinstance(design, Battery):
        seed = derived_seed(config["seed"], "queries")
        which, told = battery(known, design.redundancy, seed, rules.points)
        pairs = zip(which.tolist(), told.tolist(), strict=True)
        listed = tuple(pairs)[: rules.points]
    subject = wording["words"]["robot"] if source.domain else ""
    ahead = source.ahead
    return CollectPlan(
        **own,
        domain=source.name,
        example=Example(**wording["example"]),
        rules=rules,
        asked=tuple(map(Asked.of, wording["questions"])),
        facts=facts,
        roles=tuple(_role(name, held, facts) for name, held in source.roles.items()),
        assigned=config["briefing"] == "assigned",
        hypotheses=known,
        whole=source.whole,
        subject=subject,
        ahead=ahead
        and replace(ahead, steps=tuple(f"{subject} {in_words(step)}" for step in ahead.steps)),
        questions=listed,
        design=design if isinstance(design, Adaptive) else Adaptive(),
        situations=each(source.situations, in_words),
        gone=each(source.gone, in_words),
        paths=source.paths,
        changes=each(source.changes, in_words),
        pictures=source.pictures,
        attention=wording["attention"],
        expectation={},
        probes=(),
    )


def with_expectation(plan: CollectPlan, source: Source, error: float) -> CollectPlan:
    """The plan with what simulated observers let one expect, as it is stored."""
    plan = replace(plan, expectation=expect(plan, error, source.domain, source.users))
    plan = replace(plan, probes=probes(Collection(plan)))
    # What is stored is what runs, from the first participant on.
    return CollectPlan.from_text(plan.text)


def _role(name: str, held: int, facts: Sequence[Fact]) -> Role:
    briefing = tuple(f.belief if held >> j & 1 else f.message for j, f in enumerate(facts))
    return Role(name, held, briefing)
