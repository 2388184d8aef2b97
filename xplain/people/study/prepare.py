"""From configuration to the plan of a study."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from xplain.domains.base import Parameter
from xplain.domains.users.setting import UserType
from xplain.errors import InputError, one_of
from xplain.experiment.explanations import Costs
from xplain.explanation.asking import Limits, Pool, Questions
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.people.material import InWords, each, fixed, own_table, parts
from xplain.people.plan import Fact, lab_questions
from xplain.people.study.plan import (
    ASKING,
    PERSONALIZED,
    Clip,
    Known,
    QuizQuestion,
    Statement,
    StudyPlan,
    StudyRole,
    StudyRules,
    Training,
)
from xplain.people.study.policies import difference
from xplain.people.study.task import (
    Learned,
    MayAsk,
    OfDomain,
    OfTable,
    ShownTask,
    StudyTask,
    fitting,
    learned_types,
    needed,
)

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
        wrong: facts that the type holds wrong.
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
    task, learned = _task_and_types(cfg, config)
    gaps = []
    for transitions in task.traces(config["trace"], config["max_steps"], cfg.seed)[:TRIED]:
        table = task.table(learned, transitions)
        clips = None
        if ASKING in config["conditions"]:
            clips = task.may_ask(learned, transitions, Pool(clips=config["ask"]["clips"]))
        plan = drafted(task.seen(transitions), table, config, learned, clips)
        gaps.append(difference(plan))
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


def _task_and_types(cfg: DictConfig, config: Mapping[str, Any]) -> tuple[StudyTask, Learned]:
    """What is explained, and the types that the policies know.

    Raises:
        InputError: a key that does not go with the others.
    """
    if cfg.transitions is None:
        if cfg.facts is not None:
            raise InputError("facts", cfg.facts, "only with transitions=TABLE")
        setting, learned = learned_types(cfg)
        return OfDomain(setting), learned
    if config["briefing"] != "none":
        wanted = "none, for people as they are: one's own transitions name no types"
        raise InputError("briefing", config["briefing"], wanted)
    if cfg.types is None:
        wanted = "types.npz of xplain discover, from labels of these transitions"
        raise InputError("types", None, wanted)
    own = own_table(Path(cfg.transitions), cfg.facts, cfg.seed)
    known = own.hypotheses
    return OfTable(own), fitting(cfg.types, own.name, known.messages, known.feature_names)


def drafted(
    seen: ShownTask,
    table: LabelTable,
    config: Mapping[str, Any],
    learned: Learned | None = None,
    may_ask: MayAsk | None = None,
) -> StudyPlan:
    """A plan from its parts.

    Args:
        seen: the task and the evaluation trace.
        table: of the labelers.
        config: the study's resolved configuration (the keys of conf/study.yaml).
        learned: names and shares of the types of the table; None: those of the task.
        may_ask: what the condition that asks may ask about, if there is one.

    Raises:
        XplainError: a part contradicts another.
    """
    types, natural = seen.types, config["briefing"] == "none"
    table_of_ones_own = config.get("transitions") is not None
    wording = _worded(config["wording"], natural, table_of_ones_own, may_ask is not None)
    own, in_words = parts("study", config, wording, seen, wording["words"]["robot_does"])
    costs = Costs(config["lambda"], **{key: config[key] for key in COSTS})
    # Roles and types have the same names; people as they are may be of any types that were found.
    names = tuple(one.name for one in types) if learned is None or not natural else learned.names
    shares = np.full(len(names), 1 / len(names)) if learned is None else learned.shares
    facts, known = own["facts"], tuple(Known(**one) for one in wording["known"])
    habits = instantiate(config["belief"]).habits(learned and learned.habits)
    before, asked = lab_questions(config["before"], config["questions"])
    roles = roles_of(facts, seen.facts, types, seen.labels, wording)
    problem = costs.problem(table, tuple(fact.name for fact in facts), names, shares)
    if may_ask:
        ask = config["ask"]
        limits = Limits(ask["cost"], ask["most"], ask["when"])
        problem = replace(problem, questions=Questions(may_ask.learned, limits, may_ask.shows))
    return StudyPlan(
        **own,
        known=known,
        training=Training(**wording["training"]),
        rules=StudyRules(**config["rules"]),
        before=before,
        asked=asked,
        roles=(natural_role(facts, known, seen.labels),) if natural else roles,
        kinds=tuple(role.wrong for role in roles) if natural else (),
        trace=tuple(map(in_words, seen.trace)),
        path=seen.path,
        problem=problem.with_habits(habits),
        clips=tuple(_in_words(clip, in_words) for clip in may_ask.clips) if may_ask else (),
        clip_labels=may_ask.labels if may_ask else None,
        true_labels=seen.labels,
        conditions=config["conditions"],
        belief=config["belief"],
        taken=each(seen.taken, in_words),
    )


def _in_words(clip: Clip, in_words: InWords) -> Clip:
    situation, gone, changes = each((clip.situation, clip.gone, clip.changes), in_words)
    return replace(
        clip, phrase=in_words(clip.phrase), situation=situation, gone=gone, changes=changes
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
