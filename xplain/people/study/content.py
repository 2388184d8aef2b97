"""What participants are told and asked, made from the domain's parameters and their sentences.

Nothing here knows a domain: a new one gets its briefing, its eligibility test and its quiz from
the sentences that its parameters carry anyway.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Parameter
from xplain.domains.users.setting import UserType
from xplain.explanation.message_sets import indices
from xplain.people.plan import Fact
from xplain.people.study.plan import Known, QuizQuestion, Statement, StudyRole

NATURAL = "natural"
"""Name of the role of people who are not briefed."""
STATEMENTS = 2
"""Of the quiz about what a type had to have corrected, and as many about something else."""


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
