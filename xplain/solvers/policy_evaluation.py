"""What a policy is worth under the model: exactly on the count lattice, else by simulation.

The walk goes forward, a step at a time, through every belief that the policy can reach (merged,
:mod:`xplain.solvers.count_lattice`), asks the policy once at each, and adds up costs. Discounts
need no care: a belief at (k, H) was reached by k times *explain* and one action for each message
of H.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.asking import NO_QUESTION
from xplain.explanation.problem import Problem
from xplain.numba_kernels import lean_kernel
from xplain.solvers import knowing_evaluation
from xplain.solvers.base import Policy, PolicyValue
from xplain.solvers.cached_policy import CachedPolicy
from xplain.solvers.count_lattice import (
    SCALE,
    branch,
    copy,
    hash_key,
    make_answers,
    normalise,
    same,
)
from xplain.solvers.inquiry import answers_at, mask_of, words_for, words_of
from xplain.solvers.model import Model, discounts, explain_cost_at, model_of, paid
from xplain.solvers.policy_simulation import simulate, simulate_knowing

NEGLIGIBLE = 1e-16
"""Joint probability below which an answer is not followed, at the precision EXACT."""
EXACT = 1e-9
"""A walk is called exact when what it left out cannot change the value by more than this."""


def evaluate(
    problem: Problem,
    policy: Policy,
    beliefs: int = 5_000,
    episodes: int = 1_000,
    seed: int = 0,
    precision: float = EXACT,
) -> PolicyValue:
    """The policy's worth, exactly where it reaches no more than ``beliefs`` beliefs.

    Args:
        problem: the model, which draws every label afresh.
        policy: a function of (step, given, belief).
        beliefs: the exact walk is given up where it would reach more.
        episodes: then simulated.
        seed: of the simulated labels' stream.
        precision: relative, of what is called exact; beliefs too unlikely to matter are not
            walked to.
    """
    asked = CachedPolicy(policy)
    if problem.tracks_knowledge:
        found = knowing_evaluation.walk(problem, asked, beliefs, precision)
        return found or simulate_knowing(problem, asked, episodes, seed)
    exact = _walk(problem, asked, beliefs, precision)
    return exact if exact is not None else simulate(problem, asked, episodes, seed)


def _walk(
    problem: Problem, policy: CachedPolicy, limit: int, precision: float = EXACT
) -> PolicyValue | None:
    """None where more than ``limit`` beliefs are reachable, or will be: a layer is seldom smaller
    than the one before, so there must be room for as many of its size as there are steps to come.
    Decisions of a policy that searches are dear: none is asked for in vain."""
    asked, value, cost, left_out = 0, 0.0, 0.0, 0.0
    model = model_of(problem)
    words = words_for(len(model.inquiry.answered))
    evidence = np.zeros((1, problem.n_types + words), dtype=np.int64)
    layer = Layer(np.zeros(1, dtype=np.int64), problem.prior[None].copy(), evidence)
    worst = _worst_remaining(model)
    budget = precision / (2 * problem.n_steps * max(worst, 1))
    negligible = NEGLIGIBLE * precision / EXACT
    for k in range(problem.n_steps):
        if asked + (problem.n_steps - k) * len(layer.given) > limit:
            return None
        beliefs = len(layer.given)
        if words:
            questioned = _ask(model, policy, k, layer, limit - asked)
            if questioned is None:
                return None
            layer, plain, price, beliefs = questioned
            cost += plain
            value -= price
        given, weight, evidence = layer
        asked += beliefs
        mass = weight.sum(axis=1)
        for b in range(len(given)):
            no_news = mask_of(evidence[b, problem.n_types :])
            new = policy.messages(k, int(given[b]), weight[b] / mass[b], no_news)
            factor, price, undiscounted = paid(model, int(given[b]), new)
            given[b] |= new
            value -= mass[b] * model.discount**k * factor * price
            cost += mass[b] * undiscounted
        sets, which = np.unique(given, return_inverse=True)
        zeros = (weight * explain_cost_at(model, k, sets)[which]).sum(axis=1)
        cost += float(zeros.sum())
        value -= float(zeros @ discounts(model, k, given))
        if k + 1 < problem.n_steps:
            found = _next_layer(model, k, layer, limit, negligible)
            if found is None:
                return None
            layer, tail = found
            layer, faint = _likely(layer, budget)
            left_out += (tail + faint) * worst
    if left_out > precision * (1 + abs(value)):
        return None
    return PolicyValue(float(value), float(cost), "exact", 0.0, 0.0, asked)


def _ask(
    model: Model, policy: CachedPolicy, step: int, layer: Layer, limit: int
) -> tuple[Layer, float, float, int] | None:
    """The beliefs from which nothing is asked any more before a step's messages, the expected price
    of the questions, plain and discounted, and how many beliefs were on the way, themselves
    counted; None where they are more than ``limit``."""
    types, inquiry = model.n_types, model.inquiry
    open_ = list(zip(*layer, strict=True))
    settled: dict[tuple[int, bytes], list[Any]] = {}
    plain, discounted, beliefs = 0.0, 0.0, 0
    while open_:
        given, weight, evidence = open_.pop()
        beliefs += 1
        if beliefs > limit:
            return None
        mass, asked = weight.sum(), mask_of(evidence[types:])
        q = policy.question(step, int(given), weight / mass, asked)
        if q == NO_QUESTION:
            here = settled.setdefault((int(given), evidence.tobytes()), [given, 0.0, evidence])
            here[1] = here[1] + weight
            continue
        plain += mass * inquiry.cost
        discounted += mass * inquiry.cost * float(discounts(model, step, np.array([given]))[0])
        yes = answers_at(inquiry, q, int(given))
        for p in (yes, 1 - yes):
            after, joint = evidence.copy(), weight * p
            if joint.sum() > 0:
                with np.errstate(divide="ignore"):
                    logs = after[:types] + np.round(np.log(np.where(p > 0, p, 1)) * SCALE)
                normalise(joint, logs.astype(np.int64), after)
                after[types:] = words_of(asked | 1 << q, len(after) - types)
                open_.append((given, joint, after))
    rows = [*zip(*settled.values(), strict=True)]
    after = Layer(np.array(rows[0]), np.array(rows[1]), np.array(rows[2]))
    return after, plain, discounted, beliefs


def _likely(layer: Layer, budget: float) -> tuple[Layer, float]:
    """All but the unlikeliest beliefs, whose probabilities together stay within the budget."""
    mass = layer.weight.sum(axis=1)
    order = np.argsort(mass, kind="stable")
    total = np.cumsum(mass[order])
    dropped = int(np.searchsorted(total, budget, side="right"))
    kept = np.sort(order[dropped:])
    likely = Layer(layer.given[kept], layer.weight[kept], layer.evidence[kept])
    return likely, float(total[dropped - 1]) if dropped else 0.0


def _worst_remaining(model: Model) -> float:
    """No policy can cost more than every label 0, every message given and every question asked."""
    m, inquiry = model.n_steps, model.inquiry
    questions = inquiry.cost * min(inquiry.most, len(inquiry.answered))
    return model.inexplicability * m * (m + 1) / 2 + float(model.price.sum()) + questions


def _next_layer(
    model: Model, step: int, layer: Layer, limit: int, negligible: float
) -> tuple[Layer, float] | None:
    """The beliefs after the answers, and the probability of what was left out."""
    width = layer.evidence.shape[1]
    after = Layer(
        np.empty(limit + 1, np.int64),
        np.empty((limit + 1, model.n_types)),
        np.empty((limit + 1, width), np.int64),
    )
    answers = make_answers(limit + 1, model.n_steps, model.n_types, width - model.n_types)
    slots = np.full(1 << (4 * limit + 3).bit_length(), -1, np.int64)
    found, tail = _expand_layer(model, step, layer, after, slots, answers, negligible)
    if found < 0:
        return None
    return Layer(after.given[:found], after.weight[:found], after.evidence[:found]), tail


class Layer(NamedTuple):
    """B beliefs at one k.

    Attributes:
        given: [B] H.
        weight: [B, N] joint probability of the past and each type.
        evidence: [B, N + words] an exact key of the belief, and which questions were asked.
    """

    given: NDArray[np.int64]
    weight: NDArray[np.float64]
    evidence: NDArray[np.int64]


@lean_kernel
def _expand_layer(model, step, layer, after, slots, answers, negligible):  # type: ignore[no-untyped-def]
    """Fills ``after`` with the beliefs that the layer's answers lead to, equal ones merged.
    ``slots`` is a hash table, all −1, a power of two long.

    Returns:
        How many, −1 where they are more than there is room for; and the probability of the
        answers not followed.
    """
    left_out = 0.0
    found = 0
    for b in range(len(layer.given)):
        given = layer.given[b]
        count = branch(model, step, given, layer.weight[b], layer.evidence[b], negligible, answers)
        for t in range(len(answers.tail)):
            left_out += answers.tail[t]
        if count < 0:
            return -1, left_out
        for a in range(count):
            evidence = answers.evidence[a]
            slot = np.int64(hash_key(step, given, evidence) & np.uint64(len(slots) - 1))
            while True:
                node = slots[slot]
                if node < 0:
                    if found == len(after.given):
                        return -1, left_out
                    slots[slot] = found
                    after.given[found] = given
                    copy(answers.weight[a], after.weight[found])
                    copy(evidence, after.evidence[found])
                    found += 1
                    break
                if after.given[node] == given and same(after.evidence[node], evidence):
                    for t in range(after.weight.shape[1]):
                        after.weight[node, t] += answers.weight[a, t]
                    break
                slot = (slot + 1) & (len(slots) - 1)
    return found, left_out
