"""From configuration to the plan of a study."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from xplain.by_type import ByType, LabelTable
from xplain.config import CONF
from xplain.data.rollouts import sample_trace
from xplain.domains.base import Domain, changes_of, transition_features
from xplain.errors import InputError, whole_number
from xplain.experiment.explanations import Costs
from xplain.experiment.pipeline import learn, observe
from xplain.learning.clustering import Perfect
from xplain.learning.labelers import Labeler
from xplain.learning.user_types import p_explicable
from xplain.participants.protocol.plan import Asked, facts_of
from xplain.participants.settings import fixed
from xplain.participants.wording import InWords, named, phrases_of, texts_of, worded
from xplain.randomness import stream
from xplain.study.policies import difference, with_probes
from xplain.study.protocol import content
from xplain.study.protocol.plan import Known, Rules, StudyPlan, Training
from xplain.users.setting import Setting

if TYPE_CHECKING:
    from omegaconf import DictConfig

LEAST_DIFFERENCE = 1.0
"""Messages by which the conditions differ, a participant, on average."""
LEAST_AGREEMENT = 0.8
"""Share of labels in which a learned type is the true one."""
MATCHING_TRACES, MATCHING_STEPS = 50, 40
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

    if cfg.seed is None:
        cfg = cfg.copy()
        cfg.seed = secrets.randbelow(2**31)
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
    clusterer = instantiate(cfg.clusterer)
    learned = learn(
        observed.dataset,
        instantiate(cfg.labeler),
        clusterer,
        cfg.seed,
        observed.truth,
    )
    order = list(range(len(setting.types)))
    if not isinstance(clusterer, Perfect):  # which finds the types in their order
        order = matched(setting, learned.labelers, cfg.seed)
    features = transition_features(setting.domain, transitions)
    labelers = [learned.labelers[one] for one in order]
    table = p_explicable(labelers, features, setting.n_messages)
    plan = assemble(setting, transitions, table, config)
    if (gap := difference(plan)) < LEAST_DIFFERENCE:
        raise InputError(
            "conditions",
            " and ".join(plan.conditions),
            f"conditions that differ by a message a participant or more, on average; on the best "
            f"trace these differ by {gap:.1f}: another seed, other types, or trace.min_steps",
        )
    return plan


def matched(setting: Setting, labelers: Sequence[Labeler], seed: int) -> list[int]:
    """Which labeler is that of each type: found by their labels, never by their order.

    Labels of transitions of the robot, with every message set, are compared. Labelers and types
    are paired so that as few labels as can be differ.

    Args:
        setting: with N types.
        labelers: found in data, in any order.
        seed: of the draws of transitions.

    Raises:
        InputError: not N labelers, or one that fits no type, or two types as well.
    """
    if len(labelers) != len(setting.types):
        wanted = f"as many learned types as the study has: {len(setting.types)}"
        raise InputError("clusterer", len(labelers), wanted)
    shown = np.unique(
        np.concatenate(
            [
                sample_trace(
                    setting.models[0],
                    setting.optimal[0],
                    setting.domain.starts,
                    stream(seed, "matching", index),
                    MATCHING_STEPS,
                )
                for index in range(MATCHING_TRACES)
            ]
        ),
        axis=0,
    )
    features = transition_features(setting.domain, shown)
    table = p_explicable(labelers, features, setting.n_messages)
    assert not isinstance(table, ByType), "a study has few messages"
    learned = table > 0.5
    true = setting.label_table(shown).astype(bool)
    agreement = np.array([[(one == own).mean() for one in learned] for own in true])
    _, order = linear_sum_assignment(-agreement)
    for t, user_type in enumerate(setting.types):
        own = agreement[t, order[t]]
        others = np.delete(agreement[t], order[t])
        if own < LEAST_AGREEMENT or (len(others) and own <= others.max()):
            raise InputError(
                "observers",
                f"{user_type.name}: {100 * own:.0f} % of labels agree",
                f"labels in which each type of the study is found again: at least "
                f"{100 * LEAST_AGREEMENT:.0f} % agree, and with no other type as many",
            )
    return [int(one) for one in order]


def choose_trace(
    setting: Setting, trace: Mapping[str, Any], max_steps: int, seed: int
) -> NDArray[np.int64]:
    """The one trace that every participant evaluates: [m, 3].

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
    return max(long, key=worth)


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
    in_words = phrases_of(wording["phrases"], domain.scene is not None)
    parameters = worded(domain.parameters, wording["facts"], in_words)
    labels = setting.label_table(transitions)
    costs = Costs(trade_off=config["lambda"], **{key: config[key] for key in COSTS})
    names = tuple(user_type.name for user_type in types)
    uniform = np.full(len(types), 1 / len(types))
    plan = StudyPlan(
        seed=config["seed"],
        domain=domain.name,
        texts=texts_of(wording, CONF / "study" / "texts" / "en.yaml", in_words),
        known=tuple(Known(**one) for one in wording["known"]),
        training=Training(**wording["training"]),
        rules=Rules(**config["rules"]),
        before=tuple(map(Asked.of, config["before"])),
        asked=tuple(map(Asked.of, config["questions"])),
        facts=facts_of(parameters),
        roles=content.roles_of(parameters, types, labels, wording),
        trace=tuple(in_words(domain.describe(transition)) for transition in transitions),
        path=_path(domain, transitions),
        scene=domain.scene and named(domain.scene, wording["hide"], in_words),
        problem=costs.problem(p_explicable, setting.message_names, names, uniform),
        true_labels=labels,
        conditions=config["conditions"],
        belief=config["belief"],
        probes={},
        icons={in_words(name): path for name, path in wording["icons"].items()},
        config=config,
        changes=_changes(domain, transitions, in_words),
        taken=tuple(
            tuple(in_words(name) for name in names) for names in _taken(domain, transitions)
        ),
    )
    # What is stored is what runs, from the first participant on.
    return StudyPlan.from_text(with_probes(plan).text)


def _changes(
    domain: Domain, transitions: NDArray[np.int64], in_words: InWords
) -> tuple[tuple[str, ...], ...]:
    if domain.scene is not None:
        return ()
    return tuple(tuple(map(in_words, told)) for told in changes_of(domain, transitions))


def _taken(domain: Domain, transitions: NDArray[np.int64]) -> list[tuple[str, ...]]:
    """Names of the items that are off the map after 0 … m steps, of domains that say so."""
    taken = getattr(domain, "gone", None)
    if taken is None:
        return []
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    return [tuple(taken(state)) for state in states]


def _path(
    domain: Domain, transitions: NDArray[np.int64]
) -> tuple[tuple[tuple[int, int], tuple[int, int]], ...] | None:
    """The robot's way as (cell before, cell after), m of them; None where there is no map."""
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    cells = [cell for state in states if (cell := domain.position(state)) is not None]
    if domain.scene is None or len(cells) < len(states):
        return None
    return tuple(pairwise(cells))
