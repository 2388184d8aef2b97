"""From configuration to the plan of a study."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from xplain.by_type import ByType, LabelTable
from xplain.config import CONF
from xplain.data.rollouts import sample_trace
from xplain.domains.base import Domain, Parameter, Scene, cell_name, changes_of, transition_features
from xplain.errors import InputError, whole_number
from xplain.experiment.explanations import Costs
from xplain.experiment.pipeline import learn, observe
from xplain.learning.clustering import Perfect
from xplain.learning.labelers import Labeler
from xplain.learning.user_types import p_explicable
from xplain.randomness import stream
from xplain.study.policies import difference, with_probes
from xplain.study.protocol import content
from xplain.study.protocol.plan import Asked, Known, Rules, StudyPlan, Texts, Training
from xplain.study.settings import fixed
from xplain.users.setting import Setting

if TYPE_CHECKING:
    from omegaconf import DictConfig

InWords = Callable[[str], str]
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
    parameters = _worded(domain.parameters, wording["facts"], in_words)
    labels = setting.label_table(transitions)
    costs = Costs(trade_off=config["lambda"], **{key: config[key] for key in COSTS})
    names = tuple(user_type.name for user_type in types)
    uniform = np.full(len(types), 1 / len(types))
    plan = StudyPlan(
        seed=config["seed"],
        domain=domain.name,
        texts=_texts(wording, in_words),
        known=tuple(Known(**one) for one in wording["known"]),
        training=Training(**wording["training"]),
        rules=Rules(**config["rules"]),
        before=tuple(_asked(question) for question in config["before"]),
        asked=tuple(_asked(question) for question in config["questions"]),
        facts=content.facts_of(parameters),
        roles=content.roles_of(parameters, types, labels, wording),
        trace=tuple(in_words(domain.describe(transition)) for transition in transitions),
        path=_path(domain, transitions),
        scene=domain.scene and _named(_without(domain.scene, wording["hide"]), in_words),
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


def _texts(wording: Mapping[str, Any], in_words: InWords) -> Texts:
    """Raises InputError: the words of a page are missing."""
    words = wording["words"]
    for key in known_words():
        if not str(words.get(key) or "").strip():
            raise InputError(f"wording.words.{key}", words.get(key), "what the page says here")
    paragraphs = ("consent", "introduction", "task", "debriefing")
    return Texts(
        title=wording["title"],
        contact=wording["contact"],
        words=words,
        **{key: tuple(in_words(text) for text in wording[key]) for key in paragraphs},
    )


def known_words() -> list[str]:
    """Keys of everything that the study's pages say, as the English files have them."""
    files = ("words/en.yaml", "study/texts/en.yaml")
    shared, own = (yaml.safe_load((CONF / file).read_text(encoding="utf-8")) for file in files)
    return [*shared, *own["words"]]


def _asked(question: Mapping[str, Any]) -> Asked:
    lists = {key: tuple(question.get(key, ())) for key in ("choices", "ends")}
    return Asked(**{**question, **lists})


def phrases_of(phrases: Mapping[str, str], on_a_map: bool) -> InWords:
    """Turns a domain's phrases into what people read.

    Args:
        phrases: parts of phrases, and what they become; the longest that fits is taken.
        on_a_map: whether (row, column) and "row r, column c", from 0, become a letter and a number
            as on the map.
    """
    parts = sorted(phrases, key=len, reverse=True)
    pattern = re.compile("|".join(rf"(?<!\w){re.escape(part)}(?!\w)" for part in parts))

    def cell(found: re.Match[str]) -> str:
        row, column = (int(number) for number in found.groups())
        return cell_name(row, column)

    def in_words(text: str) -> str:
        if parts:
            text = pattern.sub(lambda found: phrases[found[0]], text)
        if on_a_map:
            text = re.sub(r"\((\d+), (\d+)\)", cell, text)
            text = re.sub(r"row (\d+), column (\d+)", cell, text)
        return text

    return in_words


def _worded(
    parameters: Sequence[Parameter], facts: Mapping[str, Mapping[str, str]], in_words: InWords
) -> tuple[Parameter, ...]:
    """The parameters with the study's own sentences.

    Raises:
        InputError: sentences for a parameter that there is not.
    """
    names = [parameter.name for parameter in parameters]
    for name in facts:
        if name not in names:
            raise InputError(f"wording.facts.{name}", name, ", ".join(names))
    worded = [replace(parameter, **facts.get(parameter.name, {})) for parameter in parameters]
    return tuple(replace(p, message=in_words(p.message), belief=in_words(p.belief)) for p in worded)


def _named(scene: Scene, in_words: InWords) -> Scene:
    items = tuple(replace(item, name=in_words(item.name)) for item in scene.items)
    return replace(scene, items=items)


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
