"""What a policy is worth under the model, by simulation: where it reaches too many beliefs to walk
through them all (:mod:`xplain.solvers.policy_evaluation`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.asking import NO_QUESTION
from xplain.explanation.belief import answered, told, update
from xplain.explanation.problem import Problem
from xplain.randomness import stream
from xplain.solvers.answering import Answering
from xplain.solvers.base import Policy, PolicyValue
from xplain.solvers.cached_policy import CachedPolicy
from xplain.solvers.inquiry import answers_at
from xplain.solvers.knowing_evaluation import Past
from xplain.solvers.model import (
    Model,
    discounts,
    explain_cost_at,
    model_of,
    optimal_values,
    paid,
    table_bytes,
    take,
)
from xplain.solvers.reminding import Reminding

KNOWN_BYTES = 1 << 30
"""Simulations are compared with known types where a table of their values takes no more."""


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
                losses[0, episode] += price * float(discounts(model, k, np.array([given]))[0])
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
    sure = np.array([problem.prior @ take(model, optimal[0], 0) for optimal in known])
    return _mean(sure, losses, asked)


def simulate_knowing(
    problem: Problem, policy: CachedPolicy, episodes: int, seed: int
) -> PolicyValue:
    """As :func:`simulate`, where messages may be missed or forgotten: what a decision loses against
    being told the state counts. Answers are drawn from what the belief expects, which is exact."""
    plain = Reminding(replace(problem, discount=1.0))
    known, rng = (Reminding(problem), plain), stream(seed, "policy_value")
    answers = Answering(problem)
    losses = np.zeros((2, episodes))
    for episode in range(episodes):
        past, belief = Past(), problem.start
        for k in range(problem.n_steps):
            while problem.questions is not None:
                q = policy.question(k, past.said, belief, past.asked)
                if q == NO_QUESTION:
                    break
                losses[:, episode] += np.array([past.discount, 1]) * problem.questions.limits.cost
                (answer, yes), *_ = answers.to_question(q, belief)
                answer ^= int(rng.random() >= yes)
                belief = answered(problem, belief, 0, q, answer)
                past = past._replace(asked=past.asked | 1 << q)
            new = policy.messages(k, past.said, belief, past.asked)
            heard = told(problem, belief, new)
            said = problem.again.after(past.said, new, problem.n_messages)
            for own, each, scale in zip(losses, known, (past.discount, 1.0), strict=True):
                price, delay = each.paid(past.said, new)
                after = delay * (heard @ each.explained(k, said)) - price
                own[episode] += scale * (belief @ each.known(k, past.said) - after)
            discount = past.discount * known[0].paid(0, new)[1] * problem.discount
            past = Past(said, past.asked, discount)
            state = rng.choice(len(heard), p=heard / heard.sum())
            p = problem.table.answered[: k + 1].reshape(k + 1, -1)[:, state]
            belief = update(problem, heard, said, (rng.random(k + 1) < p).astype(np.uint8))
    sure = np.array([problem.start @ each.known(0, 0) for each in known])
    return _mean(sure, losses, policy)


def _mean(
    told: NDArray[np.float64], losses: NDArray[np.float64], policy: CachedPolicy
) -> PolicyValue:
    """Of losses [2, episodes], with discounts and without, against being told."""
    value, undiscounted = told - losses.mean(axis=1)
    value_se, cost_se = losses.std(axis=1, ddof=1) / np.sqrt(losses.shape[1])
    means, errors = (float(value), float(-undiscounted)), (float(value_se), float(cost_se))
    return PolicyValue(*means, "simulated", *errors, len(policy.decisions))


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
    factor, price, _ = paid(model, given, new)
    shown = given | new
    later = model.discount * take(model, optimal[step + 1], shown)
    explained = belief @ (later - explain_cost_at(model, step, shown))
    after = model.message_discount ** new.bit_count() * explained - price
    now = belief @ take(model, optimal[step], given)
    return float(model.discount**step * factor * (now - after))
