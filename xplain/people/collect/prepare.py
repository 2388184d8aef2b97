"""Makes the plan of a collection from a configuration."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from xplain.domains.base import Parameter
from xplain.errors import InputError
from xplain.explanation.message_sets import mask_of
from xplain.people.collect.plan import (
    CollectPlan,
    CollectRole,
    CollectRules,
)
from xplain.people.material import Material, make_plan_fields, read_own_task, select_plan_keys
from xplain.people.plan import lab_questions
from xplain.questions.designs import Adaptive, Battery, battery
from xplain.randomness import derive_seed, run_seed


def collect_plan(cfg: DictConfig) -> CollectPlan:
    """Makes the plan that a configuration describes.

    Raises:
        XplainError: the configuration cannot be used; the text says what to change.
    """
    run_seed(cfg.seed)
    config = select_plan_keys(cfg)
    rules = CollectRules(points=config["points"], **config["rules"])  # raises its errors early
    design = instantiate(cfg.queries)
    if not isinstance(design, Adaptive | Battery):
        raise InputError("queries", config["queries"]["_target_"], "battery or adaptive")
    if isinstance(design, Adaptive) and design.in_turn:
        raise InputError(
            "queries.in_turn", True, "false: people take part at any time, not in turn"
        )
    plan = assemble(material_of(cfg), design, rules, config)
    # The first participant too must get the plan as it is stored.
    return CollectPlan.from_text(plan.text)


def material_of(cfg: DictConfig) -> Material:
    """Makes the task: a domain of conf/domain/, or a table of a lab's own transitions."""
    return read_own_task(cfg) or Material.of_domain(
        instantiate(cfg.domain), instantiate(cfg.users), cfg.seed
    )


def assemble(
    material: Material, design: Adaptive | Battery, rules: CollectRules, config: Mapping[str, Any]
) -> CollectPlan:
    """Makes a plan from the material, the design of the questions, the rules and the texts.

    Raises:
        XplainError: two of these values contradict each other.
    """
    known, wording = material.hypotheses, config["wording"]
    assert known is not None, "questions need hypotheses"
    if rules.listening > len(material.facts):
        most = f"at most one message for each fact: {len(material.facts)}"
        raise InputError("rules.listening", rules.listening, most)
    subject = wording["words"]["robot"] if material.whole is not None else ""
    own, in_words = make_plan_fields("collect", config, wording, material, f"{subject} {{phrase}}")
    known = replace(known, phrases=tuple(map(in_words, known.phrases)))
    listed: tuple[tuple[int, int], ...] = ()
    if isinstance(design, Battery):
        seed = derive_seed(config["seed"], "queries")
        which, told = battery(known, design.redundancy, seed, rules.points)
        pairs = zip(which.tolist(), told.tolist(), strict=True)
        listed = tuple(pairs)[: rules.points]
    return CollectPlan(
        **own,
        rules=rules,
        asked=lab_questions(wording["questions"])[0],
        roles=tuple(
            _make_role(one.name, mask_of(one.inaccurate, known.messages), own["facts"])
            for one in material.types
        ),
        assigned=config["briefing"] == "assigned",
        hypotheses=known,
        whole=material.whole,
        subject=subject,
        questions=listed,
        design=design if isinstance(design, Adaptive) else Adaptive(),
        shown=tuple(clip.reword(in_words) for clip in material.clips),
        attention=wording["attention"],
    )


def _make_role(name: str, held: int, facts: Sequence[Parameter]) -> CollectRole:
    briefing = tuple(f.belief if held >> j & 1 else f.message for j, f in enumerate(facts))
    return CollectRole(name, held, briefing)
