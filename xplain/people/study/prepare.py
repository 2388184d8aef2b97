"""From configuration to the plan of a study."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from xplain.domains.base import Parameter, transition_feature_names
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError, one_of, whole_number
from xplain.experiment.explanations import Costs
from xplain.experiment.pipeline import observe
from xplain.explanation.asking import Limits, Pool, Questions, alike_first, nearest_first
from xplain.explanation.habits import Habits
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.learning.data.queries import sample_trace
from xplain.learning.labelers import Labeler
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import Perfect, label_table
from xplain.people.material import Material, Transitions, fixed, own_table, parts
from xplain.people.plan import Clip, Fact, lab_questions
from xplain.people.study.flow import Study
from xplain.people.study.plan import (
    ASKING,
    PERSONALIZED,
    Known,
    QuizQuestion,
    Statement,
    StudyPlan,
    StudyRole,
    StudyRules,
    Training,
)
from xplain.randomness import stream

NATURAL = "natural"
"""Name of the role of people who are not briefed."""
STATEMENTS = 2
"""Of the quiz about what a type had to have corrected, and as many about something else."""


def roles_of(
    facts: Sequence[Fact],
    parameters: Sequence[Parameter],
    types: Sequence[UserType],
    labels: NDArray[np.uint8],
    wording: Mapping[str, Any],
) -> tuple[StudyRole, ...]:
    """What each type is told and asked.

    Args:
        facts: of the plan.
        parameters: [n] of the domain.
        types: N user types.
        labels: [N, m, 2^n] their true labels of the trace.
        wording: of the study. ``rewards``: for parameters that are the reward of an action, a
            phrase for that action; the eligibility test then asks the paper's question (is the
            reward ≥ 0?), and for the others which of two sentences the participant was told.
            ``known``: what everybody is told. ``words``: of the questions.
    """
    known = tuple(Known(**one) for one in wording["known"])
    roles = []
    for t, user_type in enumerate(types):
        wrong = tuple(j for j, fact in enumerate(facts) if fact.name in user_type.inaccurate)
        roles.append(
            StudyRole(
                user_type.name,
                wrong,
                tuple(f.belief if j in wrong else f.message for j, f in enumerate(facts)),
                _eligibility(parameters, facts, user_type, wording),
                _quiz(facts, known, wrong, needed(labels[t]), t),
            )
        )
    return tuple(roles)


def natural_role(
    facts: Sequence[Fact], known: Sequence[Known], labels: NDArray[np.uint8]
) -> StudyRole:
    """The one role of people as they are: no briefing, and a quiz about what simulated people need.

    Args:
        facts, known: of the plan.
        labels: [M, m, 2^n] true labels of the trace, of the kinds of simulated people.
    """
    need = int(np.bitwise_or.reduce([needed(of_kind) for of_kind in labels]))
    return StudyRole(NATURAL, (), (), (), _quiz(facts, known, (), need, 0))


def _eligibility(
    parameters: Sequence[Parameter],
    facts: Sequence[Fact],
    user_type: UserType,
    wording: Mapping[str, Any],
) -> tuple[QuizQuestion, ...]:
    """A question a fact, with the answer of somebody who knows what this type was told."""
    words, rewards, questions = wording["words"], wording["rewards"], []
    for fact, parameter in zip(facts, parameters, strict=True):
        value = user_type.inaccurate.get(parameter.name, parameter.accurate)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if parameter.name in rewards and number:
            text = words["reward_question"].format(action=rewards[parameter.name])
            options = (words["reward_good"], words["reward_bad"])
            questions.append(QuizQuestion(text, options, 0 if value >= 0 else 1))
        else:
            # The two sentences in an order that does not give the answer away.
            pair = sorted((fact.message, fact.belief))
            told = fact.belief if parameter.name in user_type.inaccurate else fact.message
            questions.append(QuizQuestion(words["which_told"], tuple(pair), pair.index(told)))
    return tuple(questions)


def _quiz(
    facts: Sequence[Fact], known: Sequence[Known], wrong: tuple[int, ...], need: int, number: int
) -> tuple[Statement, ...]:
    """Two statements about facts that the type had to have corrected (then its other wrong ones,
    then any), and two about something else: what everybody was told, or facts that it held right.

    Of either two, one is true and one is not. What everybody was told sounds the other way round
    (a true sentence is bad news there), so that going by how a sentence sounds is right as often
    as not.

    Args:
        facts, known: of the plan.
        wrong: facts that the type believes incorrectly.
        need: bitmask of the facts that it had to have corrected.
        number: of the type; odd ones get the other one of two for true.
    """
    order = list(dict.fromkeys([*indices(need), *wrong, *range(len(facts))]))
    about = [(facts[j].name, facts[j].message, facts[j].belief) for j in order]
    chosen, rest = about[:STATEMENTS], [about[i] for i, j in enumerate(order) if j not in wrong]
    common = [(f"known_{i}", one.right, one.wrong) for i, one in enumerate(known)]
    turned = common[number % len(common) :] + common[: number % len(common)] if common else []
    every = dict.fromkeys([*turned, *rest, *about[::-1]])
    others = [one for one in every if one not in chosen][:STATEMENTS]
    statements = []
    for group in (chosen, others):
        for i, (name, right, false) in enumerate(group):
            true = (i + number) % 2 == 0
            statements.append(Statement(name, right if true else false, true))
    return tuple(sorted(statements, key=lambda statement: not statement.true))


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
    StudyRules(**config["rules"])  # refused before the work, not after it
    config["conditions"] = conditions_of(config)
    one_of("briefing", config["briefing"], ("assigned", "none"))
    material, learned = _material_and_types(cfg, config)
    gaps = []
    for trace in traces_of(material, config["trace"], config["max_steps"], cfg.seed)[:TRIED]:
        table, clips = learned_table(material, learned, trace), None
        if ASKING in config["conditions"]:
            clips = may_ask(material, learned, trace, Pool(clips=config["ask"]["clips"]))
        plan = drafted(material, trace, table, config, learned, clips)
        gaps.append(Study.of(plan).difference())
        if gaps[-1] >= LEAST_DIFFERENCE:
            # What is stored is what runs, from the first participant on.
            return StudyPlan.from_text(plan.text)
    raise InputError(
        "conditions",
        " and ".join(config["conditions"]),
        f"conditions that differ by a message (or question) a participant or more, on average; on "
        "the best of "
        f"{len(gaps)} traces these differ by {max(gaps):.1f}: another seed than {cfg.seed}, more "
        "trace.candidates, a smaller trace.min_steps, other users or another lambda",
    )


def conditions_of(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The conditions; where something may be asked, with the personalized explainer that asks.

    Raises:
        InputError: asking by a condition or a key alone, of what a study cannot ask.
    """
    conditions, ask = config["conditions"], config.get("ask", {"kinds": []})
    if not ask["kinds"]:
        if ASKING in conditions:
            raise InputError(f"conditions.{ASKING}", "set", "with ask=clips")
        return dict(conditions)
    if [*ask["kinds"]] != ["clips"]:
        raise InputError("ask.kinds", [*ask["kinds"]], "clips in a study: ask=clips")
    Limits(ask["cost"], ask["most"], ask["when"])
    Pool(clips=ask["clips"])
    if ASKING in conditions:
        return dict(conditions)
    if PERSONALIZED not in conditions:
        wanted = f"with {PERSONALIZED}, whose explainer asks, or one of its own"
        raise InputError(f"conditions.{ASKING}", None, wanted)
    return {**conditions, ASKING: conditions[PERSONALIZED]}


def _material_and_types(cfg: DictConfig, config: Mapping[str, Any]) -> tuple[Material, Learned]:
    """What is explained, and the types that the policies know.

    Raises:
        InputError: a key that does not go with the others.
    """
    if cfg.transitions is None:
        if cfg.facts is not None:
            raise InputError("facts", cfg.facts, "only with transitions=TABLE")
        setting, learned = learned_types(cfg)
        return Material.of(setting), learned
    if config["briefing"] != "none":
        wanted = "none, for people as they are: one's own transitions name no types"
        raise InputError("briefing", config["briefing"], wanted)
    if cfg.types is None:
        wanted = "types.npz of xplain discover, from labels of these transitions"
        raise InputError("types", None, wanted)
    own = own_table(Path(cfg.transitions), cfg.facts, cfg.seed)
    known = own.hypotheses
    assert known is not None, "a table comes with hypotheses"
    return own, fitting(cfg.types, own.name, known.messages, known.feature_names)


# What is explained -------------------------------------------------------------------------------


@dataclass(frozen=True)
class MayAsk:
    """Q clips that may be asked about while a trace of m transitions is explained, nearest first.

    Attributes:
        clips: as pages show them; texts not yet in a lab's words.
        learned: of the labelers.
        labels: true ones, of M kinds of (simulated) people.
        shows: [Q, m] whether a clip is of this transition of the trace.
    """

    clips: tuple[Clip, ...]
    learned: LabelTable
    labels: LabelTable
    shows: NDArray[np.bool_]


def learned_table(material: Material, learned: Learned, rows: Transitions) -> LabelTable:
    """What the labelers say of some transitions."""
    made = None if material.transitions is None else material.transitions[rows]
    return label_table(learned.labelers, material.features[rows][:, learned.columns], made)


def may_ask(material: Material, learned: Learned, trace: Transitions, pool: Pool) -> MayAsk:
    """The clips of a pool: of every transition."""
    order = nearest_first(material.features, material.features[trace])
    order = order[alike_first(learned_table(material, learned, order), pool.clips)]
    return MayAsk(
        tuple(material.clips[row] for row in order),
        learned_table(material, learned, order),
        LabelTable.dense(material.labels(order)).compact(len(material.facts)),
        order[:, None] == trace,
    )


def traces_of(
    material: Material, rules: Mapping[str, Any], max_steps: int, seed: int
) -> list[Transitions]:
    """Traces that every participant could evaluate, the best first, none twice: of a domain
    ``candidates`` random ones from ``start`` (a cell of the map, or None for any), of a table those
    of ``rows``, lists of its rows from 1.

    The shortest of those for which the types need the most facts corrected come first: one that
    most types understand anyway would measure nothing, and one of two or three steps hardly
    anything.

    Raises:
        InputError: there is none as ``rules`` want it.
    """
    drawn = (_given if material.setting is None else _drawn)(material, rules, max_steps, seed)
    least = whole_number("trace.min_steps", rules["min_steps"], 1)
    long = {one.tobytes(): one for one in drawn if len(one) >= least}
    if not long:
        longest = max(len(one) for one in drawn)
        raise InputError("trace.min_steps", least, f"{longest} steps or fewer here")

    def worth(trace: Transitions) -> tuple[int, int]:
        facts = sum(needed(of_type).bit_count() for of_type in material.labels(trace))
        return facts, -len(trace)

    return sorted(long.values(), key=worth, reverse=True)


def _given(
    material: Material, rules: Mapping[str, Any], max_steps: int, seed: int
) -> list[Transitions]:
    last, wanted = len(material.clips), rules["rows"]
    allowed = f"lists of rows of the table, such as [[1, 2], [3, 1]], from 1 to {last}"
    if not wanted or not all(isinstance(one, list) and one for one in wanted):
        raise InputError("trace.rows", wanted, allowed)
    for row in (row for one in wanted for row in one):
        if not isinstance(row, int) or not 1 <= row <= last:
            raise InputError("trace.rows", row, allowed)
    return [np.array(one, dtype=np.int64)[:max_steps] - 1 for one in wanted]


def _drawn(
    material: Material, rules: Mapping[str, Any], max_steps: int, seed: int
) -> list[Transitions]:
    setting = material.setting
    assert setting is not None, "drawn from a domain"
    starts = setting.domain.starts
    if rules["rows"]:
        raise InputError("trace.rows", rules["rows"], "only with transitions=TABLE")
    if rules["start"] is not None:
        cell = tuple(rules["start"])
        starts = np.array([s for s in starts if setting.domain.position(int(s)) == cell], np.int64)
        if not len(starts):
            raise InputError("trace.start", list(cell), "a cell where traces start")
    found = []
    for index in range(whole_number("trace.candidates", rules["candidates"], 1)):
        rng, model = stream(seed, "trace", index), setting.models[0]
        steps = sample_trace(model, setting.optimal[0], starts, rng, max_steps)
        found.append(material.rows_of(steps))
    return found


def drafted(
    material: Material,
    trace: Transitions,
    table: LabelTable,
    config: Mapping[str, Any],
    learned: Learned | None = None,
    asks: MayAsk | None = None,
) -> StudyPlan:
    """A plan from its parts.

    Args:
        material: what is explained.
        trace: [m] the transitions of the evaluation.
        table: of the labelers.
        config: the study's resolved configuration (the keys of conf/study.yaml).
        learned: names and shares of the types of the table; None: those of the task.
        asks: what the condition that asks may ask about, if there is one.

    Raises:
        XplainError: a part contradicts another.
    """
    types, natural = material.types, config["briefing"] == "none"
    table_of_ones_own = config.get("transitions") is not None
    wording = _worded(config["wording"], natural, table_of_ones_own, asks is not None)
    own, in_words = parts("study", config, wording, material, wording["words"]["robot_does"])
    costs = Costs(config["lambda"], **{key: config[key] for key in COSTS})
    # Roles and types have the same names; people as they are may be of any types that were found.
    names = tuple(one.name for one in types) if learned is None or not natural else learned.names
    shares = np.full(len(names), 1 / len(names)) if learned is None else learned.shares
    labels = material.labels(trace)
    shown = [*(material.clips[row] for row in trace), *(asks.clips if asks else ())]
    facts, known = own["facts"], tuple(Known(**one) for one in wording["known"])
    habits = instantiate(config["belief"]).habits(learned and learned.habits)
    before, asked = lab_questions(config["before"], config["questions"])
    roles = roles_of(facts, material.facts, types, labels, wording)
    problem = costs.problem(table, tuple(fact.name for fact in facts), names, shares)
    if asks:
        ask = config["ask"]
        limits = Limits(ask["cost"], ask["most"], ask["when"])
        problem = replace(problem, questions=Questions(asks.learned, limits, asks.shows))
    return StudyPlan(
        **own,
        known=known,
        training=Training(**wording["training"]),
        rules=StudyRules(**config["rules"]),
        before=before,
        asked=asked,
        roles=(natural_role(facts, known, labels),) if natural else roles,
        kinds=tuple(role.wrong for role in roles) if natural else (),
        shown=tuple(clip.worded(in_words) for clip in shown),
        problem=problem.with_habits(habits),
        clip_labels=asks.labels if asks else None,
        true_labels=labels,
        conditions=config["conditions"],
        belief=config["belief"],
        taken=tuple(tuple(map(in_words, gone)) for gone in material.taken(trace)),
    )


def _worded(
    wording: Mapping[str, Any], natural: bool, table: bool, asks: bool
) -> Mapping[str, Any]:
    """The texts for people who are briefed, or as they are; the steps of one's own table are whole
    sentences; where some are asked in between, what is said of it."""
    if table:
        words, example = wording["words"], wording["training"]
        said = {**example, "action": words["robot_does"].format(phrase=example["action"])}
        words = {**words, "robot_does": "{phrase}"}
        wording = {**wording, "training": said, "words": words}
    if asks:
        said = wording["asking"]
        wording = {**wording, "task": [*wording["task"], *said["task"]]}
        wording["debriefing"] = said["debriefing"]
    if natural:
        return {
            **wording,
            "introduction": wording["introduction_natural"] or wording["introduction"],
        }
    told = {key: [*wording[key], *wording["briefed"][key]] for key in ("consent", "debriefing")}
    return {**wording, **told}


# Types that are known ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Learned:
    """Types as labels tell them.

    Attributes:
        names, labelers, shares: [N] of each type: its name, its labeler, its share of the people.
        columns: positions of the features that the labelers know among the domain's.
        habits: how people err, as far as their labels tell.
    """

    names: tuple[str, ...]
    labelers: tuple[Labeler, ...]
    shares: NDArray[np.float64]
    columns: tuple[int, ...]
    habits: Habits | None = None


def learned_types(cfg: DictConfig) -> tuple[Setting, Learned]:
    """The types that the policies know: those of a file (``types``), or learned from observers.

    Raises:
        InputError: the file's types know other features or messages than the domain has, or
            participants shall be told what one type knows, and types are found: nothing says which
            of them is whose.
    """
    domain, users, trainer = (instantiate(cfg[key]) for key in ("domain", "users", "labeler"))
    finder = instantiate(cfg.clusterer, _partial_=True)(labeler=trainer)
    if cfg.briefing == "assigned" and (cfg.types is not None or not isinstance(finder, Perfect)):
        wanted = "none with types that were found, by types=FILE or another clusterer than perfect"
        raise InputError("briefing", cfg.briefing, wanted)
    names = transition_feature_names(domain)
    if cfg.types is None:
        observers, queries = instantiate(cfg.observers), instantiate(cfg.queries)
        observed = observe(domain, users, observers, queries, cfg.seed)
        assert observed.setting is not None
        types = finder.find(observed, cfg.seed)
        columns = tuple(range(len(names)))
        learned = Learned(types.names, types.labelers, types.prior, columns, types.habits)
        return observed.setting, learned
    setting = Setting.build(domain, users.types(domain, stream(cfg.seed, "users")))
    return setting, fitting(cfg.types, domain.name, setting.message_names, names)


def fitting(path: str, name: str, messages: Sequence[str], features: Sequence[str]) -> Learned:
    """The types of a file, for a task with these messages and features.

    Raises:
        InputError: they know others.
    """
    known = LearnedTypes.load(path)
    for own, theirs, what in (
        (tuple(messages), known.messages, "messages"),
        (tuple(sorted(features)), tuple(sorted(known.feature_names)), "features"),
    ):
        if own != theirs:
            wanted = f"types whose {what} are those of {name}: {', '.join(own)}"
            raise InputError("types", f"{path}: {', '.join(theirs)}", wanted)
    columns = tuple(features.index(one) for one in known.feature_names)
    return Learned(known.names, known.labelers, known.prior, columns, known.habits)


def needed(labels: NDArray[np.uint8]) -> int:
    """The smallest message set with which a type finds the whole trace explicable.

    Args:
        labels: [m, 2^n] the type's true labels.

    Returns:
        A bitmask; ties by message order. All messages together always do: then the type's model
        is the robot's, and the trace is optimal in it.
    """
    explaining = np.flatnonzero(labels.all(axis=0))
    return int(min(explaining, key=lambda mask: (int(mask).bit_count(), indices(int(mask)))))
