"""What a policy is worth under the model: exactly on the count lattice, else by simulation.

The walk goes forward, a step at a time, through every belief that the policy can reach (merged,
:mod:`xplain.solvers.count_lattice`), asks the policy once at each, and adds up costs. Discounts
need no care: a belief at (k, H) was reached by k times *explain* and one action for each message
of H.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.belief import update
from xplain.explanation.problem import Problem
from xplain.numba_kernels import kernel
from xplain.randomness import stream
from xplain.solvers.base import Policy
from xplain.solvers.cached_policy import Remembered
from xplain.solvers.count_lattice import branch, hash_key, make_room
from xplain.solvers.model import Model, explain_cost_at, model_of

NEGLIGIBLE = 1e-16
"""Joint probability below which an answer is not followed."""
EXACT = 1e-9
"""A walk is called exact when what it left out cannot change the value by more than this."""


@dataclass(frozen=True)
class PolicyValue:
    """The worth of a policy from the start of the trace.

    Attributes:
        value: expected discounted return under the model (≤ 0).
        cost: expected undiscounted cost, λ · communication + inexplicability (≥ 0).
        value_is: "exact" or "simulated".
        value_se, cost_se: standard errors; 0 where exact.
        beliefs: how many beliefs the policy was asked about.
    """

    value: float
    cost: float
    value_is: Literal["exact", "simulated"]
    value_se: float
    cost_se: float
    beliefs: int


def evaluate(
    problem: Problem, policy: Policy, beliefs: int = 5_000, episodes: int = 1_000, seed: int = 0
) -> PolicyValue:
    """The policy's worth, exactly where it reaches no more than ``beliefs`` beliefs.

    Args:
        problem: the model, which draws every label afresh.
        policy: a function of (step, given, belief).
        beliefs: the exact walk is given up where it would reach more.
        episodes: then simulated.
        seed: of the simulated labels' stream.
    """
    asked = Remembered(policy)
    exact = _walk(problem, asked, beliefs)
    return exact if exact is not None else simulate(problem, asked, episodes, seed)


def _walk(problem: Problem, policy: Policy, limit: int) -> PolicyValue | None:
    """None where more than ``limit`` beliefs are reachable, or will be: a layer is seldom smaller
    than the one before, so there must be room for two of its size."""
    given = np.zeros(1, dtype=np.int64)
    weight = problem.prior[None].copy()
    evidence = np.zeros((1, problem.n_types), dtype=np.int64)
    asked, value, cost, left_out = 0, 0.0, 0.0, 0.0
    model = model_of(problem)
    worst = _worst_remaining(model)
    for k in range(problem.n_steps):
        if asked + min(2, problem.n_steps - k) * len(given) > limit:
            return None
        asked += len(given)
        mass = weight.sum(axis=1)
        for b in range(len(given)):
            new = policy.messages(k, int(given[b]), weight[b] / mass[b])
            factor, price, undiscounted = _give(model, int(given[b]), new)
            given[b] |= new
            value -= mass[b] * model.discount**k * factor * price
            cost += mass[b] * undiscounted
        zeros = (weight * explain_cost_at(model, k, given)).sum(axis=1)
        cost += float(zeros.sum())
        value -= float(zeros @ _discounts(model, k, given))
        if k + 1 < problem.n_steps:
            layer = _next_layer(model, k, given, weight, evidence, limit)
            if layer is None:
                return None
            given, weight, evidence, tail = layer
            kept, faint = _likely(weight, EXACT / (2 * problem.n_steps * max(worst, 1)))
            given, weight, evidence = given[kept], weight[kept], evidence[kept]
            left_out += (tail + faint) * worst
    if left_out > EXACT * (1 + abs(value)):
        return None
    return PolicyValue(float(value), float(cost), "exact", 0.0, 0.0, asked)


def _likely(weight: NDArray[np.float64], budget: float) -> tuple[NDArray[np.int64], float]:
    """All but the unlikeliest beliefs, whose probabilities together stay within the budget."""
    mass = weight.sum(axis=1)
    order = np.argsort(mass, kind="stable")
    total = np.cumsum(mass[order])
    dropped = int(np.searchsorted(total, budget, side="right"))
    return np.sort(order[dropped:]), float(total[dropped - 1]) if dropped else 0.0


def _worst_remaining(model: Model) -> float:
    """No policy can cost more than every label 0 and every message given."""
    m = model.n_steps
    return model.inexplicability * m * (m + 1) / 2 + float(model.price.sum())


def _discounts(model: Model, step: int, given: NDArray[np.int64]) -> NDArray[np.float64]:
    """What discounts the *explain* that ends a step, H including the step's messages."""
    actions: NDArray[np.float64] = model.message_discount ** np.bitwise_count(given)
    return actions * model.discount**step


def _give(model: Model, given: int, new: int) -> tuple[float, float, float]:
    """Discount at the start of the messages (but for steps), the discounted price of them from
    there, the cheapest first, and the plain price."""
    per_message = model.message_discount
    prices = sorted(p for j, p in enumerate(model.price) if new >> j & 1)
    discounted = sum(p * per_message**i for i, p in enumerate(prices))
    return per_message ** given.bit_count(), float(discounted), float(sum(prices))


def _next_layer(
    model: Model,
    step: int,
    given: NDArray[np.int64],
    weight: NDArray[np.float64],
    evidence: NDArray[np.int64],
    limit: int,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], float] | None:
    """The beliefs after the answers, and the probability of what was left out."""
    out_given = np.empty(limit + 1, dtype=np.int64)
    out_weight = np.empty((limit + 1, model.n_types))
    out_evidence = np.empty((limit + 1, model.n_types), dtype=np.int64)
    found, tail = _expand_layer(
        model,
        step,
        given,
        weight,
        evidence,
        NEGLIGIBLE,
        out_given,
        out_weight,
        out_evidence,
        make_room(model.n_steps, model.n_types),
    )
    if found < 0:
        return None
    return out_given[:found], out_weight[:found], out_evidence[:found], tail


@kernel
def _expand_layer(  # type: ignore[no-untyped-def]
    model, step, given, weight, evidence, negligible, out_given, out_weight, out_evidence, room
):
    capacity, types = out_weight.shape
    slots = 16
    while slots < 4 * capacity:
        slots *= 2
    table = np.full(slots, -1, dtype=np.int64)
    answer_weight = np.empty((capacity, types))
    answer_evidence = np.empty((capacity, types), dtype=np.int64)
    tail = np.empty(types)
    left_out = 0.0
    found = 0
    for b in range(len(given)):
        answers = branch(
            model,
            step,
            given[b],
            weight[b],
            evidence[b],
            negligible,
            answer_weight,
            answer_evidence,
            tail,
            room,
        )
        left_out += tail.sum()
        if answers < 0:
            return -1, left_out
        for a in range(answers):
            slot = np.int64(hash_key(step, given[b], answer_evidence[a]) & np.uint64(slots - 1))
            while True:
                node = table[slot]
                if node < 0:
                    if found == capacity:
                        return -1, left_out
                    table[slot] = found
                    out_given[found] = given[b]
                    out_weight[found] = answer_weight[a]
                    out_evidence[found] = answer_evidence[a]
                    found += 1
                    break
                if out_given[node] == given[b] and (out_evidence[node] == answer_evidence[a]).all():
                    out_weight[node] += answer_weight[a]
                    break
                slot = (slot + 1) & (slots - 1)
    return found, left_out


def simulate(problem: Problem, policy: Policy, episodes: int, seed: int) -> PolicyValue:
    """The policy's worth as a mean over simulated users, with its standard error."""
    rng, model = stream(seed, "policy_value"), model_of(problem)
    values, costs = np.zeros(episodes), np.zeros(episodes)
    asked = policy if isinstance(policy, Remembered) else Remembered(policy)
    for episode in range(episodes):
        user_type = rng.choice(problem.n_types, p=problem.prior)
        given, belief = 0, problem.prior
        for k in range(problem.n_steps):
            new = asked.messages(k, given, belief)
            factor, price, undiscounted = _give(model, given, new)
            given |= new
            p = problem.label_probabilities(k + 1, given)[user_type]
            labels = (rng.random(k + 1) < p).astype(np.uint8)
            zeros = problem.inexplicability_cost * float((labels == 0).sum())
            explain = float(_discounts(model, k, np.array([given]))[0])
            values[episode] -= problem.discount**k * factor * price + explain * zeros
            costs[episode] += undiscounted + zeros
            belief = update(problem, belief, given, labels)
    error = float(np.sqrt(episodes))
    return PolicyValue(
        float(values.mean()),
        float(costs.mean()),
        "simulated",
        float(values.std(ddof=1)) / error,
        float(costs.std(ddof=1)) / error,
        len(asked.decisions),
    )
