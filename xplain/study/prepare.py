"""From configuration to the plan of a study, and from a plan to its policies at work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from xplain.data.rollouts import sample_trace
from xplain.domains.base import Domain, Scene, transition_features
from xplain.errors import InputError, XplainError
from xplain.experiment.pipeline import Costs
from xplain.randomness import derived_seed, stream
from xplain.study.protocol import content, machine
from xplain.study.protocol.plan import Asked, Rules, Study, StudyPlan, Texts, Training
from xplain.study.settings import fixed
from xplain.users.setting import Setting

if TYPE_CHECKING:
    from omegaconf import DictConfig

PROBES = 16
"""Walks with random labels, a condition, that a changed code would have to repeat."""


def study_plan(cfg: DictConfig) -> StudyPlan:
    """The plan that a configuration describes.

    The label probabilities are those of the paper's study: labelers under perfect clustering,
    learned from simulated observers of each type.

    Raises:
        XplainError: the configuration cannot be used; the text says what to change.
    """
    from hydra.utils import instantiate

    from xplain.learning.user_types import learn_types

    config = fixed(cfg)
    Rules(**config["rules"])  # refused before the work, not after it
    seed = cfg.seed
    domain: Domain = instantiate(cfg.domain)
    types = instantiate(cfg.users).types(domain, stream(seed, "users"))
    setting = Setting.build(domain, types)
    transitions = choose_trace(setting, config["trace"], config["max_steps"], seed)
    trainer = instantiate(cfg.labeler)
    dataset, truth = instantiate(cfg.observers).collect(setting, seed)
    clustering = instantiate(cfg.clusterer).cluster(
        dataset, trainer, derived_seed(seed, "clusterer"), truth
    )
    learned = learn_types(dataset, clustering, trainer, derived_seed(seed, "labelers"))
    if len(learned.labelers) != len(types):
        raise InputError("clusterer", len(learned.labelers), f"{len(types)} types (use perfect)")
    features = transition_features(domain, transitions)
    tables = [labeler.table(features, setting.n_messages) for labeler in learned.labelers]
    return assemble(setting, transitions, np.stack(tables), config)


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
    if trace["candidates"] < 1:
        raise InputError("trace.candidates", trace["candidates"], "a whole number ≥ 1")

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
    p_explicable: NDArray[np.float64],
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
    domain, types = setting.domain, setting.types
    labels = setting.label_table(transitions)
    costs = Costs(
        trade_off=config["lambda"],
        **{
            key: config[key]
            for key in (
                "message_cost",
                "inexplicability_cost",
                "discount",
                "discount_per",
                "prior",
            )
        },
    )
    names = tuple(user_type.name for user_type in types)
    uniform = np.full(len(types), 1 / len(types))
    states = [*transitions[:, 0].tolist(), int(transitions[-1, 2])]
    cells = [domain.position(state) for state in states]
    wording = config["wording"]
    plan = StudyPlan(
        seed=config["seed"],
        domain=domain.name,
        texts=Texts(
            title=wording["title"],
            consent=tuple(wording["consent"]),
            introduction=tuple(wording["introduction"]),
            task=tuple(wording["task"]),
            goodbye=tuple(wording["goodbye"]),
            contact=wording["contact"],
        ),
        training=Training(**wording["training"]),
        rules=Rules(**config["rules"]),
        asked=tuple(
            Asked(**asked | {"choices": tuple(asked.get("choices", ()))})
            for asked in config["questions"]
        ),
        facts=content.facts_of(domain.parameters),
        roles=content.roles_of(domain.parameters, types, labels, wording["rewards"]),
        trace=tuple(domain.describe(transition) for transition in transitions),
        path=None
        if domain.scene is None or None in cells
        else tuple(pairwise(cell for cell in cells if cell is not None)),
        scene=domain.scene and _shown(domain.scene, wording["hide"]),
        problem=costs.problem(p_explicable, setting.message_names, names, uniform),
        true_labels=labels,
        conditions=config["conditions"],
        belief=config["belief"],
        probes={},
        icons=wording["icons"],
        config=config,
    )
    object.__setattr__(plan, "probes", probes(_at_work(plan)))
    # What is stored is what runs, from the first participant on.
    return StudyPlan.from_text(plan.text)


def _shown(scene: Scene, hide: Sequence[str]) -> Scene:
    """The map without the items of these symbols.

    Raises:
        InputError: there is no such symbol on the map.
    """
    symbols = [item.symbol for item in scene.items]
    for symbol in hide:
        if symbol not in symbols:
            raise InputError("wording.hide", symbol, f"symbols on the map: {', '.join(symbols)}")
    return replace(scene, items=tuple(i for i in scene.items if i.symbol not in hide))


def study_of(plan: StudyPlan) -> Study:
    """A plan with its policies at work.

    Raises:
        XplainError: the installed code decides differently from the code that made the plan.
    """
    study = _at_work(plan)
    if probes(study) != plan.probes:
        raise XplainError(
            "database: this version of xplain decides differently from the one that started the "
            "study; go on with that version, or start a new study in another database"
        )
    return study


def _at_work(plan: StudyPlan) -> Study:
    from hydra.utils import instantiate

    seed = derived_seed(plan.seed, "solver")
    policies = {
        condition: instantiate(dict(solver)).plan(plan.problem, seed)
        for condition, solver in plan.conditions.items()
    }
    return Study(plan, policies, instantiate(dict(plan.belief)))


def probes(study: Study) -> dict[str, tuple[str, ...]]:
    """What the protocol decides for participants who label at random: by condition, one text a
    walk, with the messages of every step and the last belief to the last bit."""
    found: dict[str, tuple[str, ...]] = {}
    for condition in study.plan.conditions:
        walks = []
        for walk in range(PROBES):
            rng = stream(0, "probes", walk)
            state = machine.State(stage="eligibility", user_type=0, condition=condition)
            right = [question.answer for question in study.plan.roles[0].eligibility]
            state = machine.advance(study, state, "eligibility", {"answers": right}).state
            messages = [state.new]
            while state.stage == "evaluation":
                # Mostly 1, so that beliefs stay apart rather than settle at once.
                labels = (rng.random(state.step + 1) < 0.8).astype(int).tolist()
                state = machine.advance(study, state, "labels", {"labels": labels}).state
                messages.append(state.new)
            walks.append(f"{messages} {[float(b).hex() for b in state.belief]}")
        found[condition] = tuple(walks)
    return found
