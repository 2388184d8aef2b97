"""The value of a policy under the model: exact if possible, otherwise simulated.

The exact evaluation lists, step by step, every belief that the policy can reach; equal beliefs are
merged. It calls the policy once at each belief and sums the costs. A belief before step k with
messages H was always reached by k *explain* actions and one action for each message, so its
discount does not depend on the path. Messages discount only if they always correct the fact.
"""

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.actions import AskQuestion, VisibleState
from xplain.explanation.belief import round_belief
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.randomness import stream
from xplain.solvers.base import CachedPolicy, Policy, PolicyValue, messages_of
from xplain.solvers.process import (
    Process,
    before_step,
    forget,
    give_all,
    hear_answer,
    known_values,
    make_process,
    outcomes,
    set_prices,
)

NEGLIGIBLE = 1e-16
"""At the precision EXACT, answers with a smaller joint probability are left out."""
EXACT = 1e-9
"""A value is exact if the omitted part cannot change it by more than this."""

Layer = dict[tuple[VisibleState, bytes], NDArray[np.float64]]
"""Beliefs before one step, multiplied by their probabilities."""


def evaluate(
    problem: Problem,
    policy: Policy,
    beliefs: int = 5_000,
    episodes: int = 1_000,
    seed: int = 0,
    precision: float = EXACT,
) -> PolicyValue:
    """Computes the value of a policy. The value is exact if the policy reaches at most ``beliefs``
    beliefs, and a mean of simulations otherwise.

    Args:
        problem: the model; all labels of a prefix are drawn independently at every *explain*.
        policy: a function of the visible state and the belief.
        beliefs: maximum number of beliefs in the exact evaluation.
        episodes: number of simulated episodes otherwise.
        seed: seed of the stream of simulated labels.
        precision: relative precision of an exact value. Unlikely beliefs are left out if the error
            stays below this precision.
    """
    cached = CachedPolicy(policy)
    exact = _evaluate_exactly(make_process(problem), cached, beliefs, precision)
    return exact or simulate(problem, cached, episodes, seed)


def _evaluate_exactly(
    process: Process, policy: CachedPolicy, limit: int, precision: float
) -> PolicyValue | None:
    """Computes the value exactly over the reachable beliefs, layer by layer. Returns None if there
    are, or will be, more than ``limit`` beliefs.

    A layer is rarely smaller than the layer before. So the evaluation ends early if layers of this
    size at all remaining steps would exceed the limit. This saves useless calls of slow policies.
    """
    steps, worst = process.n_steps, _bound_cost(process)
    budget = precision / (2 * steps * max(worst, 1))
    value, cost, left_out, beliefs = 0.0, 0.0, 0.0, 0
    layer: Layer = {}
    _add_belief(layer, VisibleState(), process.start)
    for k in range(steps):
        later: Layer = {}
        open_ = [(visible, weight) for (visible, _), weight in layer.items()]
        if beliefs + (steps - k) * len(open_) > limit:
            return None
        asked: Layer = {}
        while open_ or asked:
            if not open_:
                open_ = [(visible, weight) for (visible, _), weight in asked.items()]
                asked = {}
            visible, weight = open_.pop()
            beliefs += 1
            if beliefs > limit:
                return None
            mass = float(weight.sum())
            action = policy.decide(visible, weight / mass)
            discount = _compute_discount(process, visible)
            if isinstance(action, AskQuestion):
                cost += mass * process.questions.cost
                value -= mass * process.questions.cost * discount
                said = before_step(process, visible.given)
                after = visible._replace(asked=visible.asked | 1 << action.question)
                for answer in (1, 0):
                    joint = hear_answer(process, weight, said, action.question, answer)
                    if joint.sum() > 0:
                        _add_belief(asked, after, joint)
                continue
            new = messages_of(action)
            said = before_step(process, visible.given) | new
            price, factor = _price_messages(process, new)
            heard = give_all(process, weight, new)
            zeros = float(heard @ process.explain_cost[k, process.cells.at(said)])
            cost += mass * float(process.price[indices(new)].sum()) + zeros
            value -= discount * (mass * price + factor * zeros)
            if k + 1 < steps:
                found = outcomes(process, k, said, heard, NEGLIGIBLE * precision / EXACT, limit)
                if found is None:
                    return None
                after = VisibleState(k + 1, visible.given | new, visible.asked)
                for joint in found[0]:
                    _add_belief(later, after, joint)
                left_out += float(found[1].sum()) * worst
        layer, faint = _drop_unlikely(later, budget)
        left_out += faint * worst
    if left_out > precision * (1 + abs(value)):
        return None
    return PolicyValue(value, cost, "exact", 0.0, 0.0, beliefs)


def _add_belief(layer: Layer, visible: VisibleState, weight: NDArray[np.float64]) -> None:
    key = visible, round_belief(weight / weight.sum()).tobytes()
    layer[key] = layer.get(key, 0.0) + weight


def _drop_unlikely(layer: Layer, budget: float) -> tuple[Layer, float]:
    """Removes the least likely beliefs of a layer, up to the total probability ``budget``. Returns
    the rest, and the removed probability."""
    keys = list(layer)
    mass = np.array([float(layer[key].sum()) for key in keys])
    order = np.argsort(mass, kind="stable")
    total = np.cumsum(mass[order])
    dropped = int(np.searchsorted(total, budget, side="right"))
    kept = {keys[i]: layer[keys[i]] for i in np.sort(order[dropped:]).tolist()}
    return kept, float(total[dropped - 1]) if dropped else 0.0


def _compute_discount(process: Process, visible: VisibleState) -> float:
    """Computes the discount of all actions before this state."""
    messages = visible.given.bit_count()
    return float(process.message_discount**messages * process.discount**visible.step)


def _price_messages(process: Process, messages: int) -> tuple[float, float]:
    """Returns the discounted price of a set of messages, and the discount of the next action. The
    cheapest message is given first."""
    price, discount = set_prices(process, np.array([messages], np.int64))
    return float(price[0]), float(discount[0])


def _bound_cost(process: Process) -> float:
    """Computes an upper bound of any policy's cost: every label 0, every message at each step, and
    every question."""
    steps, questions = process.n_steps, process.questions
    often = 1 if process.jump is None else steps
    zeros = process.explain_cost.max(axis=1).sum()
    return float(zeros + often * process.price.sum() + questions.cost * questions.most)


def simulate(problem: Problem, policy: CachedPolicy, episodes: int, seed: int) -> PolicyValue:
    """Estimates the policy's value as a mean over simulated users, with its standard error.

    It averages the expected loss of each decision relative to known states, not the costs of the
    drawn labels. Let V(k, v, s) be the values of known states, and W(k, v, b) = Σ_s b_s V(k, v, s).
    The loss of a decision is W before the decision, plus its expected immediate cost, minus the
    expected discounted W after it. The belief is a martingale and W is linear in it, so the value
    of a policy is W at the start minus all discounted losses. This would hold for any V that is 0
    after the last step; the values of known states give little noise (a control variate). Answers
    are drawn from the belief, which is exact.
    """
    process, rng = make_process(problem), stream(seed, "policy_value")
    plain = process._replace(discount=1.0, message_discount=1.0)
    models = [(each, known_values(each)) for each in (process, plain)]
    losses = np.zeros((2, episodes))
    for episode in range(episodes):
        visible, belief = VisibleState(), process.start
        while visible.step < process.n_steps:
            k, said = visible.step, before_step(process, visible.given)
            action = policy.decide(visible, belief)
            scale = np.array([_compute_discount(process, visible), 1.0])
            if isinstance(action, AskQuestion):
                # A question does not change the expected W.
                losses[:, episode] += scale * process.questions.cost
                joint = hear_answer(process, belief, said, action.question, 1)
                if rng.random() >= joint.sum():
                    joint = hear_answer(process, belief, said, action.question, 0)
                belief = joint / joint.sum()
                visible = visible._replace(asked=visible.asked | 1 << action.question)
                continue
            new = messages_of(action)
            heard = give_all(process, belief, new)
            for i, (each, known) in enumerate(models):
                price, factor = _price_messages(each, new)
                after = factor * (heard @ known.explained(k, said | new)) - price
                losses[i, episode] += scale[i] * (belief @ known.now(k, said) - after)
            state = rng.choice(len(heard), p=heard / heard.sum())
            p = process.answered[: k + 1, process.cells.at(said | new)]
            labels = rng.random(k + 1) < p[:, state]
            joint = heard * np.where(labels[:, None], p, 1 - p).prod(axis=0)
            belief = forget(process, joint / joint.sum())
            visible = VisibleState(k + 1, visible.given | new, visible.asked)
    start = np.array([process.start @ known.now(0, 0) for _, known in models])
    value, undiscounted = start - losses.mean(axis=1)
    value_se, cost_se = losses.std(axis=1, ddof=1) / np.sqrt(episodes)
    means, errors = (float(value), float(-undiscounted)), (float(value_se), float(cost_se))
    return PolicyValue(*means, "simulated", *errors, len(policy.decisions))
