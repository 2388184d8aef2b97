"""What participants are told and asked, made from the domain's parameters and their sentences.

Nothing here knows a domain: a new one gets its briefing, its eligibility test and its quiz from
the sentences that its parameters carry anyway.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from xplain.domains.base import Parameter
from xplain.errors import InputError
from xplain.message_sets import indices
from xplain.study.protocol.plan import Fact, Question, Role, Statement
from xplain.users.setting import UserType

REWARD_OPTIONS = ("0 or more", "less than 0")
TRUE_STATEMENTS, FALSE_STATEMENTS = 2, 2


def facts_of(parameters: Sequence[Parameter]) -> tuple[Fact, ...]:
    """The parameters' sentences.

    Raises:
        InputError: a parameter lacks the sentence of those who hold it wrong.
    """
    for parameter in parameters:
        if not parameter.belief.strip():
            raise InputError(
                f"domain.values.{parameter.name}.belief",
                parameter.belief,
                "a sentence that a user who holds it wrong would say; the study needs it",
            )
    return tuple(Fact(p.name, p.message, p.belief) for p in parameters)


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
    parameters: Sequence[Parameter],
    types: Sequence[UserType],
    labels: NDArray[np.uint8],
    rewards: Mapping[str, str],
) -> tuple[Role, ...]:
    """What each type is told and asked.

    Args:
        parameters: of the domain.
        types: N user types.
        labels: [N, m, 2^n] their true labels of the trace.
        rewards: for parameters that are the reward of an action, a phrase for that action; the
            eligibility test then asks the paper's question (is the reward ≥ 0?), and for the
            others which of two sentences the participant was told.
    """
    facts = facts_of(parameters)
    return tuple(
        _role(parameters, facts, user_type, labels[t], rewards) for t, user_type in enumerate(types)
    )


def _role(
    parameters: Sequence[Parameter],
    facts: Sequence[Fact],
    user_type: UserType,
    labels: NDArray[np.uint8],
    rewards: Mapping[str, str],
) -> Role:
    wrong = tuple(j for j, fact in enumerate(facts) if fact.name in user_type.inaccurate)
    known = tuple(f.belief if j in wrong else f.message for j, f in enumerate(facts))
    questions = []
    for j, parameter in enumerate(parameters):
        value = user_type.inaccurate.get(parameter.name, parameter.accurate)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if parameter.name in rewards and number:
            text = f"{rewards[parameter.name]}: what does the robot get for it?"
            questions.append(Question(text, REWARD_OPTIONS, 0 if value >= 0 else 1))
        else:
            # The two sentences in an order that does not give the answer away.
            pair = sorted((facts[j].message, facts[j].belief))
            questions.append(
                Question("Which of these were you told?", tuple(pair), pair.index(known[j]))
            )
    return Role(user_type.name, wrong, known, tuple(questions), _quiz(facts, wrong, needed(labels)))


def _quiz(facts: Sequence[Fact], wrong: tuple[int, ...], need: int) -> tuple[Statement, ...]:
    """Two true statements: the facts that the type had to have corrected (then its other wrong
    ones, then any); two untrue ones about other facts, as far as there are any."""
    order = [*indices(need), *wrong, *range(len(facts))]
    true = list(dict.fromkeys(order))[:TRUE_STATEMENTS]
    others = [j for j in range(len(facts)) if j not in wrong and j not in true]
    rest = [j for j in [*wrong, *range(len(facts))] if j not in true and j not in others]
    # Untrue about facts the type held right from the start, so that no statement denies another.
    false = [*others, *rest, *true][:FALSE_STATEMENTS]
    return (
        *(Statement(facts[j].name, facts[j].message, True) for j in true),
        *(Statement(facts[j].name, facts[j].belief, False) for j in false),
    )
