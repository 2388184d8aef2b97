"""What a policy is worth where messages may be missed or forgotten, as
:mod:`xplain.solvers.policy_evaluation`: a walk through every belief over what users know."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.asking import NO_QUESTION
from xplain.explanation.belief import answered, rounded, told
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.solvers.answering import Answering
from xplain.solvers.base import PolicyValue
from xplain.solvers.cached_policy import CachedPolicy
from xplain.solvers.reminding import Reminding


class Past(NamedTuple):
    """What a belief [S] does not tell: what was said, which questions were asked, and what the
    actions so far discount."""

    said: int = 0
    asked: int = 0
    discount: float = 1.0


Layer = dict[tuple[Past, bytes], NDArray[np.float64]]
"""Beliefs of one k, times their probabilities, by their past and what they are."""


def walk(
    problem: Problem, policy: CachedPolicy, limit: int, precision: float
) -> PolicyValue | None:
    """The worth, of a policy that reaches no more than ``limit`` beliefs; else None. What it leaves
    out, all together, changes the value by no more than the relative ``precision``."""
    answers, steps, known = Answering(problem), problem.n_steps, Reminding(problem)
    worst = problem.inexplicability_cost * steps * (steps + 1) / 2
    worst += steps * float(problem.prices(0).sum()) * max(1.0, problem.again.price)
    if problem.questions is not None:
        worst += problem.questions.limits.cost * problem.questions.limits.most
    negligible = precision / (4 * limit * max(worst, 1) + 1)
    value, cost, left_out, beliefs = 0.0, 0.0, 0.0, 0
    layer: Layer = {}
    _add(layer, Past(), problem.start)
    for k in range(steps):
        if beliefs + (steps - k) * len(layer) > limit:
            return None
        questioned = _ask(problem, policy, answers, k, layer, limit - beliefs)
        if questioned is None:
            return None
        layer, plain, discounted, count = questioned
        cost, value, beliefs = cost + plain, value - discounted, beliefs + count
        later: Layer = {}
        for (past, _), weight in layer.items():
            mass = float(weight.sum())
            new = policy.messages(k, past.said, weight / mass, past.asked)
            price, factor = known.paid(past.said, new)
            heard = told(problem, weight, new)
            zeros = float(heard @ known.explain_cost(k))
            cost += mass * float(problem.prices(past.said)[indices(new)].sum()) + zeros
            value -= past.discount * (mass * price + factor * zeros)
            if k + 1 < steps:
                found = answers.after(k, heard, negligible, limit)
                if found is None:
                    return None
                said = problem.again.after(past.said, new, problem.n_messages)
                discount = past.discount * factor * problem.discount
                for joint in found[0]:
                    _add(later, Past(said, past.asked, discount), joint)
                left_out += float(found[1].sum()) * worst
        layer = later
    if left_out > precision * (1 + abs(value)):
        return None
    return PolicyValue(value, cost, "exact", 0.0, 0.0, beliefs)


def _add(layer: Layer, past: Past, weight: NDArray[np.float64]) -> None:
    key = past, rounded(weight / weight.sum()).tobytes()
    layer[key] = layer.get(key, 0.0) + weight


def _ask(
    problem: Problem,
    policy: CachedPolicy,
    answers: Answering,
    step: int,
    layer: Layer,
    limit: int,
) -> tuple[Layer, float, float, int] | None:
    """The beliefs from which nothing is asked any more before a step's messages, the expected price
    of the questions, plain and discounted, and how many beliefs were on the way, themselves
    counted; None where they are more than ``limit``."""
    if problem.questions is None:
        return layer, 0.0, 0.0, len(layer)
    settled: Layer = {}
    plain, discounted, count, price = 0.0, 0.0, 0, problem.questions.limits.cost
    open_ = [(past, weight) for (past, _), weight in layer.items()]
    while open_:
        past, weight = open_.pop()
        count += 1
        if count > limit:
            return None
        mass = float(weight.sum())
        belief = weight / mass
        q = policy.question(step, past.said, belief, past.asked)
        if q == NO_QUESTION:
            _add(settled, past, weight)
            continue
        plain, discounted = plain + mass * price, discounted + mass * price * past.discount
        after = past._replace(asked=past.asked | 1 << q)
        for answer, share in answers.to_question(q, belief):
            open_.append((after, mass * share * answered(problem, belief, 0, q, answer)))
    return settled, plain, discounted, count
