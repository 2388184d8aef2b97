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
from xplain.explanation.belief import answered, update
from xplain.explanation.problem import Problem
from xplain.numba_kernels import lean_kernel
from xplain.randomness import stream
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
from xplain.solvers.model import (
    Model,
    explain_cost_at,
    model_of,
    optimal_values,
    table_bytes,
    take,
)

NEGLIGIBLE = 1e-16
"""Joint probability below which an answer is not followed, at the precision EXACT."""
EXACT = 1e-9
"""A walk is called exact when what it left out cannot change the value by more than this."""
KNOWN_BYTES = 1 << 30
"""Simulations are compared with known types where a table of their values takes no more."""


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
        return found or knowing_evaluation.simulate(problem, asked, episodes, seed)
    exact = _walk(problem, asked, beliefs, precision)
    return exact if exact is not None else simulate(problem, asked, episodes, seed)


def _walk(
    problem: Problem, policy: CachedPolicy, limit: int, precision: float = EXACT
) -> PolicyValue | None:
    """None where more than ``limit`` beliefs are reachable, or will be: a layer is seldom smaller
    than the one before, so there must be room for as many of its size as there are steps to come.
    Decisions of a policy that searches are dear: none is asked for in vain."""
    given = np.zeros(1, dtype=np.int64)
    weight = problem.prior[None].copy()
    asked, value, cost, left_out = 0, 0.0, 0.0, 0.0
    model = model_of(problem)
    words = words_for(len(model.inquiry.answered))
    evidence = np.zeros((1, problem.n_types + words), dtype=np.int64)
    worst = _worst_remaining(model)
    budget = precision / (2 * problem.n_steps * max(worst, 1))
    negligible = NEGLIGIBLE * precision / EXACT
    for k in range(problem.n_steps):
        if asked + (problem.n_steps - k) * len(given) > limit:
            return None
        if words:
            (given, weight, evidence), plain, price = _ask(
                model, policy, k, Layer(given, weight, evidence)
            )
            cost += plain
            value -= price
        asked += len(given)
        mass = weight.sum(axis=1)
        for b in range(len(given)):
            no_news = [mask_of(evidence[b, problem.n_types :])] if words else []
            new = policy.messages(k, int(given[b]), weight[b] / mass[b], *no_news)
            factor, price, undiscounted = _give(model, int(given[b]), new)
            given[b] |= new
            value -= mass[b] * model.discount**k * factor * price
            cost += mass[b] * undiscounted
        sets, which = np.unique(given, return_inverse=True)
        zeros = (weight * explain_cost_at(model, k, sets)[which]).sum(axis=1)
        cost += float(zeros.sum())
        value -= float(zeros @ _discounts(model, k, given))
        if k + 1 < problem.n_steps:
            layer = _next_layer(model, k, given, weight, evidence, limit, negligible)
            if layer is None:
                return None
            given, weight, evidence, tail = layer
            kept, faint = _likely(weight, budget)
            given, weight, evidence = given[kept], weight[kept], evidence[kept]
            left_out += (tail + faint) * worst
    if left_out > precision * (1 + abs(value)):
        return None
    return PolicyValue(float(value), float(cost), "exact", 0.0, 0.0, asked)


def _ask(model: Model, policy: CachedPolicy, step: int, layer: Layer) -> tuple[Layer, float, float]:
    """The beliefs from which nothing is asked any more before a step's messages, and the expected
    price of the questions, plain and discounted."""
    types, inquiry = model.n_types, model.inquiry
    open_ = list(zip(*layer, strict=True))
    settled: dict[tuple[int, bytes], list[Any]] = {}
    plain, discounted = 0.0, 0.0
    while open_:
        given, weight, evidence = open_.pop()
        mass, asked = weight.sum(), mask_of(evidence[types:])
        q = policy.question(step, int(given), weight / mass, asked)
        if q == NO_QUESTION:
            here = settled.setdefault((int(given), evidence.tobytes()), [given, 0.0, evidence])
            here[1] = here[1] + weight
            continue
        plain += mass * inquiry.cost
        discounted += mass * inquiry.cost * float(_discounts(model, step, np.array([given]))[0])
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
    return Layer(np.array(rows[0]), np.array(rows[1]), np.array(rows[2])), plain, discounted


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
    negligible: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64], float] | None:
    """The beliefs after the answers, and the probability of what was left out."""
    after = Layer(
        np.empty(limit + 1, np.int64),
        np.empty((limit + 1, model.n_types)),
        np.empty((limit + 1, evidence.shape[1]), np.int64),
    )
    words = evidence.shape[1] - model.n_types
    answers = make_answers(limit + 1, model.n_steps, model.n_types, words)
    slots = np.full(1 << (4 * limit + 3).bit_length(), -1, np.int64)
    found, tail = _expand_layer(
        model, step, Layer(given, weight, evidence), after, slots, answers, negligible
    )
    if found < 0:
        return None
    return after.given[:found], after.weight[:found], after.evidence[:found], tail


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


def simulate(problem: Problem, policy: Policy, episodes: int, seed: int) -> PolicyValue:
    """The policy's worth as a mean over simulated users, with its standard error.

    Counted is what each decision is expected to lose against being told the type, not what the
    labels drawn happen to cost: :func:`_loss`. The mean is the same, its error several times
    smaller (a control variate).
    """
    rng, model = stream(seed, "policy_value"), model_of(problem)
    models = model, model._replace(discount=1.0, message_discount=1.0)
    known = [_known_values(problem, each) for each in models]
    losses = np.zeros((2, episodes))
    asked = policy if isinstance(policy, CachedPolicy) else CachedPolicy(policy)
    for episode in range(episodes):
        user_type = rng.choice(problem.n_types, p=problem.prior)
        given, belief, no_news = 0, problem.prior, 0
        for k in range(problem.n_steps):
            while problem.questions is not None:
                q = asked.question(k, given, belief, no_news)
                if q == NO_QUESTION:
                    break
                # Of W, below, it changes nothing: what it tells is expected there.
                price = problem.questions.limits.cost
                losses[0, episode] += price * float(_discounts(model, k, np.array([given]))[0])
                losses[1, episode] += price
                answer = int(rng.random() < answers_at(model.inquiry, q, given)[user_type])
                belief, no_news = answered(problem, belief, given, q, answer), no_news | 1 << q
            new = asked.messages(k, given, belief, no_news)
            for own, each, optimal in zip(losses, models, known, strict=True):
                own[episode] += _loss(each, optimal, k, given, new, belief)
            given |= new
            p = problem.table.answer_probabilities(k + 1, given)[user_type]
            labels = (rng.random(k + 1) < p).astype(np.uint8)
            belief = update(problem, belief, given, labels)
    told = [problem.prior @ take(model, optimal[0], 0) for optimal in known]
    value, undiscounted = told - losses.mean(axis=1)
    value_se, cost_se = losses.std(axis=1, ddof=1) / np.sqrt(episodes)
    return PolicyValue(
        float(value),
        float(-undiscounted),
        "simulated",
        float(value_se),
        float(cost_se),
        len(asked.decisions),
    )


def _known_values(problem: Problem, model: Model) -> NDArray[np.float64]:
    """V*_t(k, H): [m + 1, rows, N]; zeros where they would take too much memory."""
    if table_bytes(problem) <= KNOWN_BYTES:
        return optimal_values(model)
    shape = model.n_steps + 1, model.n_rows, model.n_types
    return np.broadcast_to(np.zeros(()), shape)


def _loss(
    model: Model,
    optimal: NDArray[np.float64],
    step: int,
    given: int,
    new: int,
    belief: NDArray[np.float64],
) -> float:
    """What a decision costs more than being told the type there, expected before the answers and
    discounted to the start: W(k, H, b) − E[what is paid now + W(k + 1, H', b')], where W(k, H, b) =
    Σ_t b(t) V_t(k, H). The belief is a martingale and W is linear in it, so E[W(k + 1, H', b')] =
    W(k + 1, H', b), and a policy is worth W at the root less the losses to come on the way: for any
    V that is 0 after the last step, and with little noise for V*, ``optimal``."""
    factor, price, _ = _give(model, given, new)
    shown = given | new
    later = model.discount * take(model, optimal[step + 1], shown)
    explained = belief @ (later - explain_cost_at(model, step, shown))
    after = model.message_discount ** new.bit_count() * explained - price
    now = belief @ take(model, optimal[step], given)
    return float(model.discount**step * factor * (now - after))
