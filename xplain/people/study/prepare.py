"""From configuration to the plan of a study."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from xplain.data.rollouts import sample_trace
from xplain.domains.base import Domain, changes_of, transition_features
from xplain.errors import InputError, whole_number
from xplain.experiment.explanations import Costs
from xplain.explanation.label_table import LabelTable
from xplain.learning.user_types import label_table
from xplain.people.ahead import ahead_of
from xplain.people.plan import Ahead, Asked, Way, facts_of
from xplain.people.study import content
from xplain.people.study.known_types import Learned, learned_types, matched
from xplain.people.study.plan import Known, Rules, StudyPlan, Training
from xplain.people.study.policies import at_work, difference, probes
from xplain.people.wording import InWords, each, fixed, of_states, parts, worded
from xplain.randomness import stream
from xplain.users.setting import Setting

if TYPE_CHECKING:
    from omegaconf import DictConfig

LEAST_DIFFERENCE = 1.0
"""Messages by which the conditions differ, a participant, on average."""
TRIED = 20
"""Traces on which the conditions are compared, the best ones first."""
COSTS = ("message_cost", "inexplicability_cost", "discount", "discount_per", "prior")
"""Keys of the configuration that the explanation problem takes as they are."""


def study_plan(cfg: DictConfig) -> StudyPlan:
    """The plan that a configuration describes.

    The label probabilities are those of the paper's study: labelers under perfect clustering,
    learned from simulated observers of each type.

    Raises:
        XplainError: the configuration cannot be used; the text says what to change.
    """

    if cfg.seed is None:
        cfg = cfg.copy()
        cfg.seed = secrets.randbelow(2**31)
    config = fixed(cfg)
    Rules(**config["rules"])  # refused before the work, not after it
    if config["briefing"] not in ("assigned", "none"):
        raise InputError("briefing", config["briefing"], "assigned or none")
    setting, learned = learned_types(cfg)
    if config["briefing"] == "assigned" and learned.key:
        learned = learned.ordered(matched(setting, learned, cfg.seed))
    traces = ranked_traces(setting, config["trace"], config["max_steps"], cfg.seed)[:TRIED]
    gaps = []
    for transitions in traces:
        features = transition_features(setting.domain, transitions)[:, learned.columns]
        table = label_table(learned.labelers, features, transitions)
        plan = drafted(setting, transitions, table, config, learned)
        gaps.append(difference(plan))
        if gaps[-1] >= LEAST_DIFFERENCE:
            return stored(plan)
    raise InputError(
        "conditions",
        " and ".join(config["conditions"]),
        f"conditions that differ by a message a participant or more, on average; on the best of "
        f"{len(gaps)} traces these differ by {max(gaps):.1f}: another seed than {cfg.seed}, more "
        "trace.candidates, a smaller trace.min_steps, other users or another lambda",
    )


def ranked_traces(
    setting: Setting, trace: Mapping[str, Any], max_steps: int, seed: int
) -> list[NDArray[np.int64]]:
    """Traces [m, 3] that every participant could evaluate, the best first, none twice.

    Of ``candidates`` random ones of at least ``min_steps``, the shortest of those for which the
    types need the most facts corrected: a trace that most types understand anyway would measure
    nothing, and one of two or three steps hardly anything.

    Args:
        setting: domain and types.
        trace: ``start`` (a cell of the map, or None for any), ``candidates`` and ``min_steps``.
        max_steps: a trace ends at a terminal state or here.
        seed: of the stream.

    Raises:
        InputError: no trace starts at that cell, or none is as long.
    """
    domain, starts = setting.domain, setting.domain.starts
    if trace["start"] is not None:
        cell = tuple(trace["start"])
        starts = np.array([s for s in starts if domain.position(int(s)) == cell], dtype=np.int64)
        if not len(starts):
            raise InputError("trace.start", list(cell), "a cell where traces start")
    whole_number("trace.candidates", trace["candidates"], 1)
    whole_number("trace.min_steps", trace["min_steps"], 1)

    def draw(index: int) -> NDArray[np.int64]:
        rng = stream(seed, "trace", index)
        return sample_trace(setting.models[0], setting.optimal[0], starts, rng, max_steps)

    def worth(transitions: NDArray[np.int64]) -> tuple[int, int]:
        labels = setting.label_table(transitions)
        facts = sum(content.needed(of_type).bit_count() for of_type in labels)
        return facts, -len(transitions)

    drawn = [draw(index) for index in range(trace["candidates"])]
    long = [one for one in drawn if len(one) >= trace["min_steps"]]
    if not long:
        longest = max(len(one) for one in drawn)
        raise InputError("trace.min_steps", trace["min_steps"], f"{longest} steps or fewer here")
    distinct = {one.tobytes(): one for one in long}
    return sorted(distinct.values(), key=worth, reverse=True)


def stored(plan: StudyPlan) -> StudyPlan:
    """A draft with what its policies decide, as it comes from the database: what is stored is what
    runs, from the first participant on."""
    return StudyPlan.from_text(replace(plan, probes=probes(at_work(plan))).text)


def drafted(
    setting: Setting,
    transitions: NDArray[np.int64],
    table: LabelTable,
    config: Mapping[str, Any],
    learned: Learned | None = None,
) -> StudyPlan:
    """A plan from its parts, without probes.

    Args:
        setting: domain and types.
        transitions: [m, 3] the evaluation trace.
        table: of the labelers.
        config: the study's resolved configuration (the keys of conf/study.yaml).
        learned: names and shares of the types of the table; None: those of the setting.

    Raises:
        XplainError: a part contradicts another.
    """
    domain, types, natural = setting.domain, setting.types, config["briefing"] == "none"
    wording = _worded(config["wording"], natural)
    own, in_words = parts("study", config, wording, domain.scene)
    parameters = worded(domain.parameters, wording["facts"], in_words)
    labels = setting.label_table(transitions)
    costs = Costs(trade_off=config["lambda"], **{key: config[key] for key in COSTS})
    # Roles and types have the same names; people as they are may be of any types that were found.
    names = tuple(one.name for one in types) if learned is None or not natural else learned.names
    shares = np.full(len(names), 1 / len(names)) if learned is None else learned.shares
    facts, known = facts_of(parameters), tuple(Known(**one) for one in wording["known"])
    roles = content.roles_of(parameters, types, labels, wording)
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    changes = () if domain.scene else changes_of(domain, transitions)
    return StudyPlan(
        **own,
        domain=domain.name,
        known=known,
        training=Training(**wording["training"]),
        rules=Rules(**config["rules"]),
        before=tuple(map(Asked.of, config["before"])),
        asked=tuple(map(Asked.of, config["questions"])),
        facts=facts,
        roles=(content.natural_role(facts, known, labels),) if natural else roles,
        kinds=tuple(role.wrong for role in roles) if natural else (),
        trace=tuple(in_words(domain.describe(transition)) for transition in transitions),
        path=_path(domain, states),
        problem=costs.problem(table, setting.message_names, names, shares),
        true_labels=labels,
        conditions=config["conditions"],
        belief=config["belief"],
        probes={},
        changes=each(changes, in_words),
        ahead=_ahead(
            setting, lambda phrase: wording["words"]["robot_does"].format(phrase=in_words(phrase))
        ),
        taken=each(of_states(domain, "gone", states), in_words),
    )


def _worded(wording: Mapping[str, Any], natural: bool) -> Mapping[str, Any]:
    """The texts for people who are briefed, or for people as they are."""
    if natural:
        return {
            **wording,
            "introduction": wording["introduction_natural"] or wording["introduction"],
        }
    told = {key: [*wording[key], *wording["briefed"][key]] for key in ("consent", "debriefing")}
    return {**wording, **told}


def _ahead(setting: Setting, in_words: InWords) -> Ahead | None:
    """The odd step of the practice, which makes sense to every type."""
    made = setting.reachable
    return ahead_of(
        setting.domain,
        made[:, [0, 2]],
        setting.label_by_model(made),
        lambda row: in_words(setting.domain.describe(made[row])),
    )


def _path(domain: Domain, states: Sequence[int]) -> Way | None:
    """The robot's way; None where there is no map."""
    cells = [cell for state in states if (cell := domain.position(state)) is not None]
    return tuple(pairwise(cells)) if domain.scene and len(cells) == len(states) else None
