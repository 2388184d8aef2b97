"""Explanation problems in Cassandra's ``.pomdp`` text, which the field's programs read.

The reduced problem, flat: states are (k, H, type) and one absorbing end; actions are *explain* and
the n messages; observations are "nothing" and the distinguishable answers at each (k, H), numbered.
Explicit and numeric, without names: parsers are fast on that. Rewards alone have wildcards, one
line a (state, action): SARSOP refuses rewards that name an end state and an observation.

A message already given, or without effect, is no action of the problem. The format knows no such
thing: here it leads to the end at a price above any cost, so no optimal policy takes it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from math import comb

import numpy as np

from xplain.errors import InputError, TooLargeError
from xplain.explanation.problem import Problem

EXPLAIN, NOTHING = 0, 0
MAX_LINES = 20_000_000


def lines(problem: Problem) -> Iterator[str]:
    """The file's lines.

    Raises:
        InputError: only steps discount, or something may be asked, which the format cannot say.
        TooLargeError: more than MAX_LINES lines.
    """
    if problem.discount_per == "step" and problem.discount < 1:
        raise InputError(
            "discount_per", "step", "the format discounts every action; needs action, or γ = 1"
        )
    if problem.questions:
        raise InputError(
            "problem", "has questions", "one without: no question discounts or is asked twice"
        )
    types, steps, n = problem.n_types, problem.n_steps, problem.n_messages
    sets = 1 << n
    end = types * steps * sets
    fewest = 3 * end * (n + 1)
    _check_lines(fewest)
    answers = {
        (k, shown): _answers(problem, k, shown) for k in range(steps - 1) for shown in range(sets)
    }
    _check_lines(fewest + types * sum(len(answer) for answer in answers.values()))

    def state(k: int, shown: int, t: int) -> int:
        return (k * sets + shown) * types + t if k < steps else end

    observations = 1 + max((len(answer) for answer in answers.values()), default=0)
    yield f"discount: {problem.discount!r}"
    yield "values: reward"
    yield f"states: {end + 1}"
    yield f"actions: {n + 1}"
    yield f"observations: {observations}"
    start = np.zeros(end + 1)
    start[:types] = problem.prior
    yield "start: " + " ".join(repr(float(p)) for p in start)

    prices = problem.trade_off * problem.message_cost
    effective = problem.messages_with_effect
    forbidden = -1.0 - float(prices.sum()) - problem.inexplicability_cost * steps * (steps + 1) / 2
    for k, shown, t in product(range(steps), range(sets), range(types)):
        here, after = state(k, shown, t), state(k + 1, shown, t)
        zeros = float((1 - problem.table.label_probabilities(k + 1, shown)[t]).sum())
        yield f"T: {EXPLAIN} : {here} : {after} 1.0"
        yield f"R: {EXPLAIN} : {here} : * : * {-problem.inexplicability_cost * zeros!r}"
        # At the last step what is answered changes nothing.
        for o, weights in enumerate(answers.get((k, shown), []), start=1):
            if weights[t] > 0:
                yield f"O: {EXPLAIN} : {after} : {o} {weights[t]!r}"
        if k == 0:
            yield f"O: {EXPLAIN} : {here} : {NOTHING} 1.0"
        for j in range(n):
            may_be_said = j in effective and not shown >> j & 1
            reward = -float(prices[j]) if may_be_said else forbidden
            after = state(k, shown | 1 << j, t) if may_be_said else end
            yield f"T: {j + 1} : {here} : {after} 1.0"
            yield f"R: {j + 1} : {here} : * : * {reward!r}"
            yield f"O: {j + 1} : {here} : {NOTHING} 1.0"
    for action in range(n + 1):
        yield f"T: {action} : {end} : {end} 1.0"
        yield f"O: {action} : {end} : {NOTHING} 1.0"


def _check_lines(expected: int) -> None:
    if expected > MAX_LINES:
        raise TooLargeError(
            f"format=pomdp: about {expected:.1e} lines, more than {MAX_LINES:.0e}; "
            "fewer messages or a shorter trace fit"
        )


def _answers(problem: Problem, step: int, shown: int) -> list[list[float]]:
    """P(answer | type) for the distinguishable answers to *explain* at (k, H): transitions with
    equal columns answer by their number of 1s, those that all types label alike not at all."""
    labels = problem.table.answer_probabilities(step + 1, shown)
    columns: dict[tuple[float, ...], int] = {}
    for i in range(step + 1):
        column = tuple(labels[:, i].tolist())
        if len(set(column)) > 1:
            columns[column] = columns.get(column, 0) + 1
    found = []
    for ones in product(*(range(size + 1) for size in columns.values())):
        weights = [1.0] * problem.n_types
        for (column, size), count in zip(columns.items(), ones, strict=True):
            for t, p in enumerate(column):
                weights[t] *= comb(size, count) * p**count * (1 - p) ** (size - count)
        found.append(weights)
    return found
