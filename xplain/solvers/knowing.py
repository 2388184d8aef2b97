"""What a user knows, for kernels: where messages may be missed or forgotten.

A state is what is hidden, what the user knows and the type (:mod:`xplain.explanation.knowledge`):
s = K · N + t, K a row of the label table. A belief is [S], S = rows · N, as
:attr:`~xplain.explanation.problem.Problem.start` has it. Values of known states are those of
:class:`~xplain.solvers.reminding.Reminding`, QMDP's.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined
from xplain.solvers.inquiry import Inquiry, make_inquiry
from xplain.solvers.random_words import next_uniform
from xplain.solvers.reminding import PATIENCE, Reminding
from xplain.solvers.rows import row

ROUNDING = 1e-12
"""Actions worth the same but for this are equal, the first is taken."""


class Knowing(NamedTuple):
    """The problem of m steps, n messages, S states of N types.

    Attributes:
        answered: [m, S] P(answer 1).
        explain_cost: [m, S] of *explain* at k.
        optimal: [m + 1, G, W, S] V(k, c, S, s), and
        explain: [m, G, S] Q(k, c, s, explain), s being known from then on, of
            :class:`~xplain.solvers.reminding.Solved`;
        part, counts: where G and W are looked up.
        bit: [n, N] the bit of a row that a message sets right; −1 for none.
        accept, forget: [N] α and φ.
        price: [n] λ C_e.
        discount, message_discount: γ and γ'.
        inquiry: the questions, S states in the place of types.
    """

    answered: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    optimal: NDArray[np.float64]
    explain: NDArray[np.float64]
    part: NDArray[np.int64]
    counts: NDArray[np.int64]
    bit: NDArray[np.int64]
    accept: NDArray[np.float64]
    forget: NDArray[np.float64]
    price: NDArray[np.float64]
    discount: float
    message_discount: float
    inquiry: Inquiry


def make_knowing(policy: Reminding) -> Knowing:
    """Of the problem that QMDP's policy was planned for."""
    problem, solved = policy.problem, policy.solved
    steps, rows, types = problem.table.p.shape
    bit = np.full((problem.n_messages, types), -1)
    for t, own in enumerate(problem.table.rows):
        bit[own, t] = np.arange(len(own))
    costs = problem.inexplicability_cost * np.cumsum(1 - problem.table.p, axis=0)
    return Knowing(
        np.ascontiguousarray(problem.table.answered.reshape(steps, -1)),
        np.ascontiguousarray(costs.reshape(steps, -1)),
        solved.optimal.reshape(*solved.optimal.shape[:3], -1),
        solved.explain.reshape(*solved.explain.shape[:2], -1),
        solved.rows.part,
        solved.counts,
        bit,
        problem.accept,
        problem.forget,
        problem.trade_off * problem.message_cost,
        problem.discount,
        policy.delay,
        _inquiry(problem, rows * types),
    )


def _inquiry(problem: Problem, states: int) -> Inquiry:
    """The questions by states: each is a type of its own, whatever was said."""
    found = make_inquiry(problem)
    count = len(found.answered)
    sets = found.part.shape[1]
    return found._replace(
        answered=np.ascontiguousarray(found.answered.reshape(count, 1, states)),
        yes=np.ascontiguousarray(found.yes.reshape(count, 1, states)),
        part=np.zeros((1, sets, states), np.int64),
    )


@inlined
def say(model, belief, message):  # type: ignore[no-untyped-def]
    """The belief [S] after a message was said: a part α has it right now."""
    types = len(model.accept)
    for t in range(types):
        bit = model.bit[message, t]
        if bit < 0:
            continue
        step = types << bit
        for s in range(t, len(belief), types):
            if s // step % 2 == 0:  # without the fact
                landed = model.accept[t] * belief[s]
                belief[s] -= landed
                belief[s + step] += landed


@inlined
def lose(model, belief):  # type: ignore[no-untyped-def]
    """The belief [S] after each fact known was lost with φ."""
    types = len(model.forget)
    step = types
    while step < len(belief):
        for s in range(len(belief)):
            if s // step % 2 == 0:
                lost = model.forget[s % types] * belief[s + step]
                belief[s + step] -= lost
                belief[s] += lost
        step *= 2


@inlined
def hear(model, step, labels, belief):  # type: ignore[no-untyped-def]
    """The belief [S] after labels [step + 1] of the prefix, and what is forgotten then."""
    total = 0.0
    for s in range(len(belief)):
        if belief[s] > 0.0:
            for i in range(step + 1):
                p = model.answered[i, s]
                belief[s] *= p if labels[i] else 1.0 - p
            total += belief[s]
    for s in range(len(belief)):
        belief[s] /= total
    lose(model, belief)


@inlined
def draw_state(counter, belief):  # type: ignore[no-untyped-def]
    """A state from a belief; the last possible one takes what rounding leaves."""
    u, chosen = next_uniform(counter), -1
    for s in range(len(belief)):
        if belief[s] > 0.0:
            chosen = s
            u -= belief[s]
            if u < 0.0:
                break
    return chosen


@inlined
def told(model, counter, state, message):  # type: ignore[no-untyped-def]
    """The state of a user who was told a message once."""
    types = len(model.accept)
    bit = model.bit[message, state % types]
    if bit < 0 or state // (types << bit) % 2 == 1:
        return state
    lands = next_uniform(counter) < model.accept[state % types]
    return state + (types << bit) if lands else state


@inlined
def shown(model, counter, step, state, labels):  # type: ignore[no-untyped-def]
    """Draws the labels [step + 1] of a user in this state. Returns the state after the step."""
    types = len(model.forget)
    for i in range(step + 1):
        labels[i] = next_uniform(counter) < model.answered[i, state]
    bit = types
    while bit < model.answered.shape[1]:
        if state // bit % 2 == 1 and next_uniform(counter) < model.forget[state % types]:
            state -= bit
        bit *= 2
    return state


@inlined
def given_after(model, given, new):  # type: ignore[no-untyped-def]
    """What was said."""
    return given | new


@inlined
def exhausted(model, given):  # type: ignore[no-untyped-def]
    """A message may always be said again."""
    return np.int64(0)


@inlined
def price_of(model, given, message):  # type: ignore[no-untyped-def]
    """λ C_e of a message."""
    return model.price[message]


@inlined
def best_now(model, step, given, said, belief):  # type: ignore[no-untyped-def]
    """QMDP's action at a belief [S] (n is *explain*), its value, and what it loses against being
    told the state now: value, action, loss. Messages ``said`` at this step are not said again;
    ``given`` is what was said before it."""
    types, n = len(model.accept), len(model.price)
    shown, full = given_after(model, given, said), said | exhausted(model, given)
    sure, best, action, likeliest = 0.0, 0.0, n, 0.0
    for t in range(types):
        now = model.optimal[step, row(model.counts, given, t), row(model.part, said, t)]
        explain = model.explain[step, row(model.counts, shown, t)]
        for s in range(t, len(belief), types):
            sure += belief[s] * now[s]
            best += belief[s] * explain[s]
            likeliest = max(likeliest, belief[s])
    least, margin = best, PATIENCE * (1.0 - likeliest)
    for j in range(n):
        if full >> j & 1:
            continue
        gain, matters = 0.0, False
        for t in range(types):
            before, at = row(model.counts, given, t), row(model.part, said, t)
            up, bit = row(model.part, said | 1 << j, t), model.bit[j, t]
            if up == at:
                continue
            matters = True
            now, more = model.optimal[step, before, at], model.optimal[step, before, up]
            jump = types << bit if bit >= 0 else 0
            for s in range(t, len(belief), types):
                gain += belief[s] * (more[s] - now[s])
                if bit >= 0 and s // jump % 2 == 0:
                    gain += belief[s] * model.accept[t] * (more[s + jump] - more[s])
        price = price_of(model, given, j)
        value = model.message_discount * (sure + gain) - price
        if matters and value - margin * price > least + ROUNDING:
            best, action, least = value, j, value - margin * price
    return best, action, sure - best


@inlined
def expected_loss(model, counter, step, given, start, belief, labels):  # type: ignore[no-untyped-def]
    """What QMDP's decisions cost from a belief [S], which is used up, more than those of who is
    told the state at each: summed up on the way of one user who begins in the state ``start``.

    QMDP's value W is linear in the belief and its mean does not change by what is heard, so a
    policy earns W at the start less these losses; they vary little, and mostly at first.
    """
    steps, n = model.explain.shape[0], len(model.price)
    total, scale, state = 0.0, 1.0, start
    for k in range(step, steps):
        said = np.int64(0)
        while True:
            _, action, loss = best_now(model, k, given, said, belief)
            total += scale * loss
            if action == n:
                break
            scale *= model.message_discount
            said |= 1 << action
            say(model, belief, action)
            state = told(model, counter, state, action)
        given = given_after(model, given, said)
        if k + 1 < steps:
            state = shown(model, counter, k, state, labels)
            hear(model, k, labels, belief)
            scale *= model.discount
    return total
