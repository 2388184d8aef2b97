"""Makes the plan of a study from a configuration."""

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from hydra.utils import get_class, instantiate
from numpy.typing import NDArray
from omegaconf import DictConfig

from xplain.domains.base import Parameter
from xplain.domains.users.setting import Setting, UserType
from xplain.errors import InputError, whole_number
from xplain.experiment.explanations import Costs
from xplain.experiment.from_config import component
from xplain.explanation.asking import Limits, Pool, Questions, alike_first, nearest_first
from xplain.explanation.belief import Facts
from xplain.explanation.label_table import LabelTable
from xplain.explanation.message_sets import indices
from xplain.learning.data.queries import sample_trace
from xplain.learning.saved import LearnedTypes
from xplain.learning.user_types import Perfect, label_table
from xplain.people.material import (
    Material,
    Transitions,
    learn_domain_types,
    make_plan_fields,
    read_own_task,
    select_plan_keys,
)
from xplain.people.plan import lab_questions
from xplain.people.study.flow import Study
from xplain.people.study.plan import (
    ASKING,
    PERSONALIZED,
    QuizQuestion,
    Statement,
    StudyPlan,
    StudyRole,
    StudyRules,
)
from xplain.randomness import stream

NATURAL = "natural"
"""Name of the role in a study without a briefing."""
STATEMENTS = 2
"""Number of quiz statements about facts that a type needed; the same number is about other
facts."""


def roles_of(
    facts: Sequence[Parameter],
    types: Sequence[UserType],
    labels: NDArray[np.uint8],
    wording: Mapping[str, Any],
) -> tuple[StudyRole, ...]:
    """Makes the briefing and the tests of each type.

    Args:
        facts: [n] facts of the plan.
        types: N user types.
        labels: [N, m, 2^n] true labels of the trace's m transitions, by type and message set.
        wording: texts of the study, with these keys among others:
        * ``rewards``: {name of a parameter: phrase for an action}, for each parameter that is the
          reward of an action. About these parameters, the eligibility test asks the paper's
          question (is the reward ≥ 0?). About other parameters, it asks which of two sentences was
          in the briefing.
        * ``known``: the facts that everybody is told.
        * ``words``: texts of the questions.
    """
    known = read_known(wording)
    held = [
        tuple(j for j, fact in enumerate(facts) if fact.name in one.inaccurate) for one in types
    ]
    return tuple(
        StudyRole(
            user_type.name,
            wrong,
            tuple(f.belief if j in wrong else f.message for j, f in enumerate(facts)),
            _make_eligibility(facts, user_type, wording),
            _make_quiz(facts, known, wrong, find_needed(labels[t]), t),
        )
        for t, (user_type, wrong) in enumerate(zip(types, held, strict=True))
    )


def read_known(wording: Mapping[str, Any]) -> tuple[Parameter, ...]:
    """Reads the facts that everybody is told (``known``), each with its true sentence ``right`` and
    a false sentence ``wrong``."""
    return tuple(
        Parameter(
            f"known_{i}", True, False, *(" ".join(one[key].split()) for key in ("right", "wrong"))
        )
        for i, one in enumerate(wording["known"])
    )


def natural_role(
    facts: Sequence[Parameter], known: Sequence[Parameter], labels: NDArray[np.uint8]
) -> StudyRole:
    """Makes the only role of a study without a briefing. Its quiz is about the facts that some kind
    of simulated people must be told to understand the trace.

    Args:
        facts: the facts of the plan.
        known: the facts that everybody is told.
        labels: [M, m, 2^n] true labels of the trace's m transitions, by kind of simulated people
            and message set.
    """
    need = int(np.bitwise_or.reduce([find_needed(of_kind) for of_kind in labels]))
    return StudyRole(NATURAL, (), (), (), _make_quiz(facts, known, (), need, 0))


def _make_eligibility(
    facts: Sequence[Parameter],
    user_type: UserType,
    wording: Mapping[str, Any],
) -> tuple[QuizQuestion, ...]:
    """Makes a question for each fact; the right answer is what this type's briefing says."""
    words, rewards, questions = wording["words"], wording["rewards"], []
    for fact in facts:
        value = user_type.inaccurate.get(fact.name, fact.accurate)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if fact.name in rewards and number:
            text = words["reward_question"].format(action=rewards[fact.name])
            options = (words["reward_good"], words["reward_bad"])
            questions.append(QuizQuestion(text, options, 0 if value >= 0 else 1))
        else:
            # The order of the two sentences does not reveal the answer.
            pair = sorted((fact.message, fact.belief))
            told = fact.belief if fact.name in user_type.inaccurate else fact.message
            questions.append(QuizQuestion(words["which_told"], tuple(pair), pair.index(told)))
    return tuple(questions)


def _make_quiz(
    facts: Sequence[Parameter],
    known: Sequence[Parameter],
    wrong: tuple[int, ...],
    need: int,
    number: int,
) -> tuple[Statement, ...]:
    """Makes the quiz of a type: two statements about facts that the type needs, and two about other
    facts. A type needs a fact if the fact's message is in the smallest message set with which the
    type finds the trace explicable.

    If the type needs fewer than two facts, the first two statements are also about other facts that
    the type believes incorrectly, and then about any facts. The last two statements are about facts
    that everybody is told, or that the type believes correctly. Of each two statements, one is
    true. The true sentences of ``known`` are about limits and losses, unlike the messages. So the
    tone of a sentence does not reveal if it is true.

    Args:
        facts: the facts of the plan.
        known: the facts that everybody is told.
        wrong: positions of the facts that the type believes incorrectly.
        need: bitmask of the facts that the type needs.
        number: index of the type; decides which of two statements is true.
    """
    order = list(dict.fromkeys([*indices(need), *wrong, *range(len(facts))]))
    about, first = [facts[j] for j in order], number % max(len(known), 1)
    chosen, rest = about[:STATEMENTS], [facts[j] for j in order if j not in wrong]
    every = {one.name: one for one in (*known[first:], *known[:first], *rest, *about[::-1])}
    others = [one for one in every.values() if one not in chosen][:STATEMENTS]
    statements = [
        Statement(one.name, one.belief if (i + number) % 2 else one.message, (i + number) % 2 == 0)
        for group in (chosen, others)
        for i, one in enumerate(group)
    ]
    return tuple(sorted(statements, key=lambda statement: not statement.true))


LEAST_DIFFERENCE = 1.0
"""Minimum mean difference between the conditions, in messages for each participant."""
TRIED = 20
"""Maximum number of traces on which the conditions are compared, best first."""
COSTS = ("message_cost", "inexplicability_cost", "discount", "discount_per", "prior")
"""Configuration keys that are passed to the explanation problem unchanged."""


def study_plan(cfg: DictConfig) -> StudyPlan:
    """Makes the plan that a configuration describes.

    As in the paper's study, labelers under perfect clustering give the label probabilities. They
    are learned from simulated observers of each type.

    Raises:
        XplainError: the configuration cannot be used; the text says what to change.
    """

    if cfg.seed is None:
        cfg = cfg.copy()
        cfg.seed = secrets.randbelow(2**31)
    config = select_plan_keys(cfg)
    StudyRules(**config["rules"])  # errors come before the expensive work
    config["conditions"] = conditions_of(config)
    material, types = _make_material_and_types(cfg)
    gaps = []
    for trace in traces_of(material, config["trace"], config["max_steps"], cfg.seed)[:TRIED]:
        table, asked = make_learned_table(material, types, trace), None
        if ASKING in config["conditions"]:
            asked = may_ask(material, types, trace, config["ask"]["clips"])
        clips = None if asked is None else (asked, make_learned_table(material, types, asked))
        plan = make_draft(material, trace, table, config, types, clips)
        gaps.append(Study.of(plan).difference())
        if gaps[-1] >= LEAST_DIFFERENCE:
            # The first participant too must get the plan as it is stored.
            return StudyPlan.from_text(plan.text)
    raise InputError(
        "conditions",
        " and ".join(config["conditions"]),
        "conditions that differ on average by one message (or question) or more for each "
        f"participant; on the best of {len(gaps)} traces they differ by {max(gaps):.1f}. Try "
        f"another seed than {cfg.seed}, more trace.candidates, a smaller trace.min_steps, other "
        "users or another lambda",
    )


def conditions_of(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns {condition: configuration of its solver}. If ``ask`` allows questions, these include
    the condition ASKING; by default it has the solver of the condition "personalized".

    Raises:
        InputError: the condition ASKING is configured but ``ask`` allows no questions; ``ask``
            allows questions but no solver for ASKING is known; or a study cannot ask questions of
            this kind.
    """
    conditions, ask = dict(config["conditions"]), config.get("ask", {"kinds": []})
    if not ask["kinds"]:
        if ASKING in conditions:
            raise InputError(f"conditions.{ASKING}", "set", "only with ask=clips")
        return conditions
    if [*ask["kinds"]] != ["clips"]:
        raise InputError("ask.kinds", [*ask["kinds"]], "clips in a study: ask=clips")
    Limits(ask["cost"], ask["most"], ask["when"])
    Pool(clips=ask["clips"])
    asking = conditions.get(ASKING, conditions.get(PERSONALIZED))
    if asking is None:
        wanted = f"a condition of this name, or {PERSONALIZED}, whose explainer then asks"
        raise InputError(f"conditions.{ASKING}", None, wanted)
    return {**conditions, ASKING: asking}


def _make_material_and_types(cfg: DictConfig) -> tuple[Material, LearnedTypes]:
    """Makes the task, and the types that the policies know: types from a file (``types``), or types
    that are learned from observers.

    Raises:
        InputError: keys exclude each other, or types have other features or messages.
    """
    material, perfect = read_own_task(cfg), get_class(cfg.clusterer._target_) is Perfect
    if material and cfg.types is None:
        wanted = "types.npz of xplain discover, from labels of these transitions"
        raise InputError("types", None, wanted)
    if cfg.briefing == "assigned" and (cfg.types is not None or not perfect):
        # It is unknown which found type belongs to which participant.
        wanted = "none with types=FILE, or with another clusterer than perfect"
        raise InputError("briefing", cfg.briefing, wanted)
    if not material:
        domain = component(cfg, "domain")
        if cfg.types is None:
            setting, learned = learn_domain_types(cfg, domain)
            return Material.of(setting), learned
        users = component(cfg, "users").types(domain, stream(cfg.seed, "users"))
        material = Material.of(Setting.build(domain, users))
    types, facts = LearnedTypes.load(cfg.types), [one.name for one in material.facts]
    for mine, theirs, what in (
        (facts, types.messages, "messages"),
        (sorted(material.feature_names), sorted(types.feature_names), "features"),
    ):
        if [*mine] != [*theirs]:
            wanted = f"types with the {what} of {material.name}: {', '.join(mine)}"
            raise InputError("types", f"{cfg.types}: {', '.join(theirs)}", wanted)
    return material, types


# What is explained -------------------------------------------------------------------------------


def make_learned_table(material: Material, types: LearnedTypes, rows: Transitions) -> LabelTable:
    """Returns the label table of transitions, computed by the labelers of learned types.

    Args:
        material: the task.
        types: the learned types.
        rows: indices of the transitions in the task.
    """
    made = None if material.setting is None else material.setting.reachable[rows]
    columns = [material.feature_names.index(name) for name in types.feature_names]
    return label_table(types.labelers, material.features[rows][:, columns], made)


def facts_of_types(
    material: Material, types: LearnedTypes | None, trace: Transitions, asked: Transitions
) -> Facts | None:
    """Computes what the belief update needs about the facts that people may believe incorrectly.

    Args:
        material: the task.
        types: the learned types; None if the plan uses the types of the task.
        trace, asked: indices of the transitions of the trace, and of the transitions of the
            questions.

    Returns:
        Tables and estimates about these facts. None if it is unknown which facts each learned type
        believes incorrectly.
    """
    if types is None or types.wrong is None:
        return None
    columns = [material.feature_names.index(name) for name in types.feature_names]
    of_trace, of_asked = (
        types.everything(material.features[rows][:, columns].tolist()) if len(rows) else None
        for rows in (trace, asked)
    )
    return None if of_trace is None else Facts(of_trace, types.wrong, of_asked, types.new)


def may_ask(material: Material, types: LearnedTypes, trace: Transitions, clips: int) -> Transitions:
    """Returns at most ``clips`` transitions that the explainer may ask about while it explains a
    trace. They are sorted by their distance to the trace, and then selected by
    :func:`xplain.explanation.asking.alike_first`, which prefers transitions with different
    labels."""
    order = nearest_first(material.features, material.features[trace])
    return order[alike_first(make_learned_table(material, types, order), clips)]


def traces_of(
    material: Material, rules: Mapping[str, Any], max_steps: int, seed: int
) -> list[Transitions]:
    """Returns distinct traces that participants can evaluate, best first.

    Traces for which the types need more messages come first; among equals, shorter traces come
    first. A trace that most types understand without messages would measure nothing, and a trace of
    two or three steps very little.

    Args:
        material: the task: a domain, or a lab's table of transitions.
        rules: how traces are found (``trace`` in conf/study.yaml). In a domain, ``candidates``
            random traces are drawn. In a table, ``rows`` lists the traces, each as a list of rows,
            counted from 1. ``min_steps`` is the minimum length.
        max_steps: maximum length; a longer trace is cut after this step.
        seed: seed of the random traces.

    Raises:
        InputError: no trace meets ``rules``.
    """
    drawn = (_read_traces if material.setting is None else _draw_traces)(
        material, rules, max_steps, seed
    )
    least = whole_number("trace.min_steps", rules["min_steps"], 1)
    long = {one.tobytes(): one for one in drawn if len(one) >= least}
    if not long:
        longest = max(len(one) for one in drawn)
        raise InputError("trace.min_steps", least, f"{longest} steps or fewer here")

    def rate(trace: Transitions) -> tuple[int, int]:
        facts = sum(find_needed(of_type).bit_count() for of_type in material.labels(trace))
        return facts, -len(trace)

    return sorted(long.values(), key=rate, reverse=True)


def _read_traces(
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


def _draw_traces(
    material: Material, rules: Mapping[str, Any], max_steps: int, seed: int
) -> list[Transitions]:
    setting = material.setting
    assert setting is not None, "drawn from a domain"
    if rules["rows"]:
        raise InputError("trace.rows", rules["rows"], "only with transitions=TABLE")
    count = whole_number("trace.candidates", rules["candidates"], 1)
    rngs = (stream(seed, "trace", index) for index in range(count))
    starts = setting.domain.starts
    drawn = (sample_trace(setting.models[0], starts, rng, max_steps) for rng in rngs)
    return [material.rows_of(steps) for steps in drawn]


def make_draft(
    material: Material,
    trace: Transitions,
    table: LabelTable,
    config: Mapping[str, Any],
    learned: LearnedTypes | None = None,
    asks: tuple[Transitions, LabelTable] | None = None,
) -> StudyPlan:
    """Makes the plan for a task and a trace.

    Args:
        material: the task.
        trace: [m] indices of the trace's transitions.
        table: the label table of the trace.
        config: the study's resolved configuration (the keys of conf/study.yaml).
        learned: the learned types of the table; None if the table has the types of the task.
        asks: indices of the transitions that the condition ASKING may ask about, and their label
            table; None without questions.

    Raises:
        XplainError: two arguments contradict each other.
    """
    types, natural = material.types, config["briefing"] == "none"
    table_of_ones_own = config.get("transitions") is not None
    wording = _choose_texts(config["wording"], natural, table_of_ones_own, asks is not None)
    own, in_words = make_plan_fields(
        "study", config, wording, material, wording["words"]["robot_does"]
    )
    costs = Costs(config["lambda"], **{key: config[key] for key in COSTS})
    # Roles and types have the same names; without a briefing any found types are possible.
    names = tuple(one.name for one in types) if learned is None or not natural else learned.names
    shares = np.full(len(names), 1 / len(names)) if learned is None else learned.prior
    labels, question_rows = material.labels(trace), asks[0] if asks else trace[:0]
    shown = [material.clips[row] for row in (*trace, *question_rows)]
    facts, known = own["facts"], read_known(wording)
    before, asked = lab_questions(config["before"], config["questions"])
    roles = roles_of(facts, types, labels, wording)
    problem = costs.problem(table, tuple(fact.name for fact in facts), names, shares)
    clip_labels = None
    if asks:
        ask = config["ask"]
        limits = Limits(ask["cost"], ask["most"], ask["when"])
        shows = question_rows[:, None] == trace
        problem = replace(problem, questions=Questions(asks[1], limits, shows))
        clip_labels = LabelTable.dense(material.labels(question_rows)).compact(len(facts))
    wrong = facts_of_types(material, learned, trace, question_rows)
    people = instantiate(config["belief"]).people
    return StudyPlan(
        **own,
        known=known,
        rules=StudyRules(**config["rules"]),
        before=before,
        asked=asked,
        roles=(natural_role(facts, known, labels),) if natural else roles,
        kinds=tuple(role.wrong for role in roles) if natural else (),
        shown=tuple(clip.reword(in_words) for clip in shown),
        problem=people(problem, learned and learned.habits, wrong),
        clip_labels=clip_labels,
        true_labels=labels,
        conditions=config["conditions"],
        belief=config["belief"],
        taken=tuple(tuple(map(in_words, gone)) for gone in material.list_taken(trace)),
    )


def _choose_texts(
    wording: Mapping[str, Any], natural: bool, table: bool, asks: bool
) -> Mapping[str, Any]:
    """Returns the texts of one kind of study.

    Args:
        wording: the texts of all kinds of studies.
        natural: True for a study without a briefing.
        table: True for a lab's own table of transitions, where each step is a whole sentence; False
            for a domain.
        asks: True if questions are asked; their description is then part of the texts.
    """
    own: dict[str, Any] = {**wording, **(wording["asking"] if asks else {})}
    if asks:
        own["task"] = [*wording["task"], *own["task"]]
    if table:
        own["words"] = {**own["words"], "robot_does": "{phrase}"}
    if natural:
        return own | {"introduction": own["introduction_natural"] or own["introduction"]}
    return own | {key: [*own[key], *more] for key, more in own["briefed"].items()}


def find_needed(labels: NDArray[np.uint8]) -> int:
    """Finds the smallest message set with which a type finds the whole trace explicable.

    Args:
        labels: [m, 2^n] the type's true labels.

    Returns:
        A bitmask. Among the smallest sets, the first in the order of messages is chosen. The set of
        all messages always suffices, because the type then has the robot's model, in which the
        trace is optimal.
    """
    explaining = np.flatnonzero(labels.all(axis=0))
    return int(min(explaining, key=lambda mask: (int(mask).bit_count(), indices(int(mask)))))
