"""From configuration to the plan of a collection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from xplain.domains.base import Domain, changes_of
from xplain.domains.users.hypotheses import hypotheses_of
from xplain.domains.users.types import TypeSource
from xplain.errors import InputError, one_of
from xplain.explanation.message_sets import mask_of
from xplain.people.collect.plan import (
    CollectPlan,
    CollectRole,
    CollectRules,
    Example,
)
from xplain.people.material import Source, each, fixed, of_states, own_table, parts, way_of
from xplain.people.plan import Fact, Told, lab_questions
from xplain.questions.designs import Adaptive, Battery, battery
from xplain.randomness import derived_seed, run_seed, stream


def collect_plan(cfg: DictConfig) -> CollectPlan:
    """The plan that a configuration describes.

    Raises:
        XplainError: the configuration cannot be used; the text says what to change.
    """
    run_seed(cfg.seed)
    config = fixed(cfg)
    rules = CollectRules(points=config["points"], **config["rules"])  # refused before the work
    design = instantiate(cfg.queries)
    if not isinstance(design, Adaptive | Battery):
        raise InputError("queries", config["queries"]["_target_"], "battery or adaptive")
    if isinstance(design, Adaptive) and design.in_turn:
        raise InputError("queries.in_turn", True, "false: people are asked as they come")
    one_of("briefing", config["briefing"], ("none", "assigned"))
    source = source_of(cfg)
    if config["briefing"] == "assigned" and source.domain is None:
        raise InputError(
            "briefing", "assigned", "none for one's own transitions: they name no types"
        )
    plan = assemble(source, design, rules, config)
    # What is stored is what runs, from the first participant on.
    return CollectPlan.from_text(plan.text)


def source_of(cfg: DictConfig) -> Source:
    """The task: a domain of conf/domain/, or a table of one's own transitions."""
    if cfg.transitions is not None:
        return own_table(Path(cfg.transitions), cfg.facts, cfg.seed)
    if cfg.facts is not None:
        raise InputError("facts", cfg.facts, "only with transitions=TABLE; a domain has sentences")
    return domain_source(instantiate(cfg.domain), instantiate(cfg.users), cfg.seed)


def domain_source(domain: Domain, users: TypeSource, seed: int) -> Source:
    """What a domain knows of itself."""
    whole = hypotheses_of(domain, None)
    known = whole.told_apart_by_features()
    types = users.types(domain, stream(seed, "users"))
    names = known.messages
    assert known.states is not None, "hypotheses of a domain know states"
    assert whole.states is not None, "the same"
    paths = way_of(domain, known.states.tolist())
    return Source(
        name=domain.name,
        hypotheses=known,
        whole=whole,
        facts=domain.parameters,
        roles={one.name: mask_of(one.inaccurate, names) for one in types},
        situations=of_states(domain, "situation", known.states[:, 0]),
        gone=of_states(domain, "gone", known.states[:, 0]),
        paths=paths or (),
        changes=() if paths else _changes(domain, known.states, known.phrases),
        scene=domain.scene if paths else None,
        domain=domain,
        users=users,
    )


def _changes(domain: Domain, states: NDArray[np.int64], phrases: Sequence[str]) -> Told:
    """What each transition changes; the phrases of such domains name the action first."""
    actions = [
        next((a for a, name in enumerate(domain.actions) if phrase.startswith(name)), 0)
        for phrase in phrases
    ]
    return changes_of(domain, np.column_stack([states[:, 0], actions, states[:, 1]]))


def assemble(
    source: Source, design: Adaptive | Battery, rules: CollectRules, config: Mapping[str, Any]
) -> CollectPlan:
    """A plan from its parts.

    Raises:
        XplainError: a part contradicts another.
    """
    known, wording = source.hypotheses, config["wording"]
    if rules.listening > len(source.facts):
        most = f"at most one message a fact: {len(source.facts)}"
        raise InputError("rules.listening", rules.listening, most)
    subject = wording["words"]["robot"] if source.domain else ""
    own, in_words = parts("collect", config, wording, source, f"{subject} {{phrase}}")
    known = replace(known, phrases=tuple(map(in_words, known.phrases)))
    listed: tuple[tuple[int, int], ...] = ()
    if isinstance(design, Battery):
        seed = derived_seed(config["seed"], "queries")
        which, told = battery(known, design.redundancy, seed, rules.points)
        pairs = zip(which.tolist(), told.tolist(), strict=True)
        listed = tuple(pairs)[: rules.points]
    return CollectPlan(
        **own,
        example=Example(**wording["example"]),
        rules=rules,
        asked=lab_questions(wording["questions"])[0],
        roles=tuple(_role(name, held, own["facts"]) for name, held in source.roles.items()),
        assigned=config["briefing"] == "assigned",
        hypotheses=known,
        whole=source.whole,
        subject=subject,
        questions=listed,
        design=design if isinstance(design, Adaptive) else Adaptive(),
        situations=each(source.situations, in_words),
        gone=each(source.gone, in_words),
        paths=source.paths,
        attention=wording["attention"],
    )


def _role(name: str, held: int, facts: Sequence[Fact]) -> CollectRole:
    briefing = tuple(f.belief if held >> j & 1 else f.message for j, f in enumerate(facts))
    return CollectRole(name, held, briefing)
