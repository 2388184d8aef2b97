"""From configuration to the plan of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from xplain.by_type import LabelTable
from xplain.data.rollouts import sample_trace
from xplain.domains.base import Domain, Scene, changes_of, transition_features
from xplain.errors import InputError, whole_number
from xplain.experiment.explanations import Costs
from xplain.experiment.pipeline import learn, observe
from xplain.learning.user_types import p_explicable
from xplain.randomness import stream
from xplain.study.policies import with_probes
from xplain.study.protocol import content
from xplain.study.protocol.plan import Asked, Rules, StudyPlan, Texts, Training
from xplain.study.settings import fixed
from xplain.users.setting import Setting

if TYPE_CHECKING:
    from omegaconf import DictConfig

COSTS = ("message_cost", "inexplicability_cost", "discount", "discount_per", "prior")
"""Keys of the configuration that the explanation problem takes as they are."""


def study_plan(cfg: DictConfig) -> StudyPlan:
    """The plan that a configuration describes.

    The label probabilities are those of the paper's study: labelers under perfect clustering,
    learned from simulated observers of each type.

    Raises:
        XplainError: the configuration cannot be used; the text says what to change.
    """
    from hydra.utils import instantiate

    config = fixed(cfg)
    Rules(**config["rules"])  # refused before the work, not after it
    observed = observe(
        instantiate(cfg.domain),
        instantiate(cfg.users),
        instantiate(cfg.observers),
        instantiate(cfg.queries),
        cfg.seed,
    )
    setting = observed.setting
    transitions = choose_trace(setting, config["trace"], config["max_steps"], cfg.seed)
    learned = learn(
        observed.dataset,
        instantiate(cfg.labeler),
        instantiate(cfg.clusterer),
        cfg.seed,
        observed.truth,
    )
    if len(learned.labelers) != len(setting.types):
        wanted = f"{len(setting.types)} types (use perfect)"
        raise InputError("clusterer", len(learned.labelers), wanted)
    features = transition_features(setting.domain, transitions)
    table = p_explicable(learned.labelers, features, setting.n_messages)
    return assemble(setting, transitions, table, config)


def choose_trace(
    setting: Setting, trace: Mapping[str, Any], max_steps: int, seed: int
) -> NDArray[np.int64]:
    """The one trace that every participant evaluates: [m, 3].

    Of ``candidates`` random ones, the shortest of those for which the types need the most facts
    corrected: a trace that most types understand anyway would measure nothing.

    Args:
        setting: domain and types.
        trace: ``start`` (a cell of the map, or None for any) and ``candidates``.
        max_steps: a trace ends at a terminal state or here.
        seed: of the stream.

    Raises:
        InputError: no trace starts at that cell.
    """
    domain, starts = setting.domain, setting.domain.starts
    if trace["start"] is not None:
        cell = tuple(trace["start"])
        starts = np.array([s for s in starts if domain.position(int(s)) == cell], dtype=np.int64)
        if not len(starts):
            raise InputError("trace.start", list(cell), "a cell where traces start")
    whole_number("trace.candidates", trace["candidates"], 1)

    def draw(index: int) -> NDArray[np.int64]:
        rng = stream(seed, "trace", index)
        return sample_trace(setting.models[0], setting.optimal[0], starts, rng, max_steps)

    def worth(transitions: NDArray[np.int64]) -> tuple[int, int]:
        labels = setting.label_table(transitions)
        facts = sum(content.needed(of_type).bit_count() for of_type in labels)
        return facts, -len(transitions)

    return max((draw(index) for index in range(trace["candidates"])), key=worth)


def assemble(
    setting: Setting,
    transitions: NDArray[np.int64],
    p_explicable: LabelTable,
    config: Mapping[str, Any],
) -> StudyPlan:
    """A plan from its parts.

    Args:
        setting: domain and types.
        transitions: [m, 3] the evaluation trace.
        p_explicable: [N, m, 2^n] of the labelers.
        config: the study's resolved configuration (the keys of conf/study.yaml).

    Raises:
        XplainError: a part contradicts another.
    """
    domain, types, wording = setting.domain, setting.types, config["wording"]
    labels = setting.label_table(transitions)
    costs = Costs(trade_off=config["lambda"], **{key: config[key] for key in COSTS})
    names = tuple(user_type.name for user_type in types)
    uniform = np.full(len(types), 1 / len(types))
    plan = StudyPlan(
        seed=config["seed"],
        domain=domain.name,
        texts=_texts(wording),
        training=Training(**wording["training"]),
        rules=Rules(**config["rules"]),
        asked=tuple(_asked(question) for question in config["questions"]),
        facts=content.facts_of(domain.parameters),
        roles=content.roles_of(domain.parameters, types, labels, wording["rewards"]),
        trace=tuple(domain.describe(transition) for transition in transitions),
        path=_path(domain, transitions),
        scene=domain.scene and _without(domain.scene, wording["hide"]),
        problem=costs.problem(p_explicable, setting.message_names, names, uniform),
        true_labels=labels,
        conditions=config["conditions"],
        belief=config["belief"],
        probes={},
        icons=wording["icons"],
        config=config,
        changes=changes_of(domain, transitions) if domain.scene is None else (),
    )
    # What is stored is what runs, from the first participant on.
    return StudyPlan.from_text(with_probes(plan).text)


def _texts(wording: Mapping[str, Any]) -> Texts:
    paragraphs = ("consent", "introduction", "task", "goodbye")
    return Texts(
        title=wording["title"],
        contact=wording["contact"],
        **{key: tuple(wording[key]) for key in paragraphs},
    )


def _asked(question: Mapping[str, Any]) -> Asked:
    return Asked(**{**question, "choices": tuple(question.get("choices", ()))})


def _path(
    domain: Domain, transitions: NDArray[np.int64]
) -> tuple[tuple[tuple[int, int], tuple[int, int]], ...] | None:
    """The robot's way as (cell before, cell after), m of them; None where there is no map."""
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    cells = [cell for state in states if (cell := domain.position(state)) is not None]
    if domain.scene is None or len(cells) < len(states):
        return None
    return tuple(pairwise(cells))


def _without(scene: Scene, hide: Sequence[str]) -> Scene:
    """The map without the items of these symbols.

    Raises:
        InputError: there is no such symbol on the map.
    """
    symbols = [item.symbol for item in scene.items]
    for symbol in hide:
        if symbol not in symbols:
            raise InputError("wording.hide", symbol, f"symbols on the map: {', '.join(symbols)}")
    return replace(scene, items=tuple(i for i in scene.items if i.symbol not in hide))
