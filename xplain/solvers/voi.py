"""What a question is worth to a policy that never asks for an answer's sake: value of information.

    VOI(q) = Σ_y P(y | b) V(b_y) − V(b) − κ

(Howard 1966; one question ahead, "myopic"). V is not QMDP's bound, in which the state becomes known
for nothing, but what QMDP's own decisions earn from a belief, by simulation. W(b) = Σ b_s V(k, v,
s) is linear, and its mean is not changed by what is heard; so QMDP's decisions earn W(b) less what
each of them is expected to lose against being told the state there. W is the same on both sides,
and the losses vary little: with the same random numbers for all beliefs few simulations are enough.
Where labels are certain one simulation a state is exact.

Looked into are the open questions whose answers tell the most (mutual information), by
:func:`telling_questions`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import njit, uint64
from numpy.typing import NDArray
from scipy.special import entr

from xplain.explanation.actions import Action, AskQuestion, VisibleState
from xplain.randomness import derived_seed
from xplain.solvers.base import TIE, Policy
from xplain.solvers.known_type import KnownValues
from xplain.solvers.process import Process, before_step, hear_answer

NO_NEWS = 1e-12
"""Nats below which an answer tells nothing."""
LOOKED_INTO = 12
"""Questions whose worth a decision looks into: the most telling."""
ROLLS = 40
"""Simulations from a belief."""
FAINT = 1e-6
"""A state less likely than this is not simulated."""
SPREAD = 0xD1342543DE82EF95
"""Between the streams of two simulations."""
WORDS = (1 << 64) - 1
PATIENCE = 0.1
"""A message that may be missed must gain this share of its price on top, times the probability that
the state is not the likeliest one: saying it tells nothing about the user, and hides the answer
that would. Chosen among 0.05, 0.1, 0.15 and 0.2 on seeds 9700 to 9745."""


def telling_questions(
    process: Process, visible: VisibleState, belief: NDArray[np.float64], most: int | None = None
) -> tuple[list[int], list[float]]:
    """The questions that may be asked and tell something, the most telling first, and the nats that
    their answers tell.

    Clips whose columns, thresholded, are alike are one kind, of which only the nearest to the trace
    may be asked. One that tells nothing at this belief is listed where another of its kind does,
    which may be asked after it alone; its nats are then of that one.
    """
    questions, asked = process.questions, visible.asked
    if asked.bit_count() >= questions.most or (questions.first and (visible.step or visible.given)):
        return [], []
    cells = questions.cells.at(before_step(process, visible.given))
    p = questions.answered[:, cells]
    open_ = np.array([not asked >> q & 1 for q in range(len(p))], bool) & (np.ptp(p, axis=1) > 0)
    numbers = np.flatnonzero(open_)
    p = p[numbers]
    told = entr(p @ belief) + entr(1 - p @ belief) - (entr(p) + entr(1 - p)) @ belief
    nearest: dict[bytes, int] = {}
    news: dict[int, float] = {}
    columns = questions.likelier[numbers][:, cells]
    for q, column, nats in zip(numbers.tolist(), columns, told.tolist(), strict=True):
        first = nearest.setdefault(column.tobytes(), q)
        if nats > NO_NEWS:
            news.setdefault(first, nats)
    ranked = sorted(news, key=lambda q: (-news[q], q))[:most]
    return ranked, [news[q] for q in ranked]


def with_questions(policy: Policy, process: Process, known: KnownValues, seed: int) -> Policy:
    """The policy, which asks where there are questions."""
    if not len(process.questions.answered):
        return policy
    return VoiPolicy(policy, process, known, derived_seed(seed, "value of information"))


@dataclass(frozen=True)
class VoiPolicy:
    """Asks the question that is worth the most, while one is worth anything.

    Attributes:
        policy: decides on messages.
        process, known: the model, and its values where the state is known.
        stream: of the simulations.
    """

    policy: Policy
    process: Process
    known: KnownValues
    stream: int

    def decide(self, visible: VisibleState, belief: NDArray[np.float64]) -> Action:
        """As :class:`xplain.solvers.base.Policy` says."""
        gains = self._gains(visible, belief)
        best = max(gains, key=lambda q: gains[q], default=0)
        if gains and gains[best] > TIE:
            return AskQuestion(best)
        return self.policy.decide(visible, belief)

    def values(self, visible: VisibleState, belief: NDArray[np.float64]) -> Mapping[Action, float]:
        """Values of messages are the policy's. A question's value is the best of these plus its
        value of information."""
        values = dict(self.policy.values(visible, belief))
        best = max(values.values(), default=0.0)
        gains = self._gains(visible, belief)
        return values | {AskQuestion(q): best + gain for q, gain in gains.items()}

    def _gains(self, visible: VisibleState, belief: NDArray[np.float64]) -> dict[int, float]:
        """What each question that was looked into is worth."""
        questions, _ = telling_questions(self.process, visible, belief, LOOKED_INTO)
        if not questions:
            return {}
        said, gains = before_step(self.process, visible.given), {}
        now = self._loss(visible.step, said, belief)
        for q in questions:
            gains[q] = now - self.process.questions.cost
            for answer in (1, 0):
                joint = hear_answer(self.process, belief, said, q, answer)
                share = float(joint.sum())
                if share > 0:
                    gains[q] -= share * self._loss(visible.step, said, joint / share)
        return gains

    def _loss(self, step: int, said: int, belief: NDArray[np.float64]) -> float:
        """What QMDP's decisions lose, from a belief [S], against being told the state at each."""
        states, weights, streams = _spread(belief, self._rolls)
        seeds = np.array([self.stream + i * SPREAD & WORDS for i in streams], np.uint64)
        places = (
            self.process.cells.at(said),
            self.known.value_cells.at(said),
        )
        tables = self._tables
        return float(_mean_loss(tables, step, said, belief, *places, states, weights, seeds))

    @property
    def _rolls(self) -> int:
        """One a state where answers are certain: what happens to it then is no chance."""
        certain = self.process.jump is None and not (self.process.answered % 1).any()
        return 1 if certain else ROLLS

    @property
    def _tables(self) -> Tables:
        process, known = self.process, self.known
        lands = process.jump is None
        none = np.zeros((process.n_messages, process.n_states), np.int64)
        return Tables(
            lands,
            np.ascontiguousarray(process.answered),
            process.cells.stride,
            known.value,
            known.value_cells.base,
            known.value_cells.stride,
            known.explain,
            process.relevant,
            none if process.jump is None else process.jump,
            np.ones(process.n_states) if process.accept is None else process.accept,
            np.zeros(process.n_types) if process.forget is None else process.forget,
            process.price,
            process.discount,
            process.message_discount,
            0.0 if lands else PATIENCE,
        )


def _spread(
    belief: NDArray[np.float64], rolls: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], list[int]]:
    """States to simulate, their weights, and the numbers of their streams: every likely state as
    often, or where they are more than the simulations, states spread evenly over the belief."""
    likely = np.flatnonzero(belief > FAINT)
    if rolls > 1 and len(likely) > rolls:
        at = (np.arange(rolls) + 0.5) / rolls
        states = np.minimum(np.searchsorted(np.cumsum(belief), at), len(belief) - 1)
        return states, np.full(rolls, 1 / rolls), list(range(rolls))
    each = max(1, rolls // len(likely))
    streams = [s * ROLLS + i for s in likely.tolist() for i in range(each)]
    states = likely.repeat(each)
    return states, belief[states] / each, streams


class Tables(NamedTuple):
    """What the simulations read: the process and its known values, as arrays."""

    lands: bool
    answered: NDArray[np.float64]
    label_stride: NDArray[np.int64]
    value: NDArray[np.float64]
    value_base: NDArray[np.int64]
    value_stride: NDArray[np.int64]
    explain: NDArray[np.float64]
    relevant: NDArray[np.int64]
    jump: NDArray[np.int64]
    accept: NDArray[np.float64]
    forget: NDArray[np.float64]
    price: NDArray[np.float64]
    discount: float
    message_discount: float
    patience: float


kernel: Callable[..., Any] = njit(cache=True, nogil=True)


@kernel
def _uniform(counter):  # type: ignore[no-untyped-def]
    """A random number in [0, 1): splitmix64 (Steele, Lea & Flood 2014)."""
    counter[0] += uint64(0x9E3779B97F4A7C15)
    x = counter[0]
    x = (x ^ (x >> uint64(30))) * uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> uint64(27))) * uint64(0x94D049BB133111EB)
    return np.float64((x ^ (x >> uint64(31))) >> uint64(11)) * 2.0**-53


@kernel
def _best(tables, step, said, belief, labels_at, values_at):  # type: ignore[no-untyped-def]
    """QMDP's action (n is *explain*), and what it loses against being told the state."""
    n, matters = len(tables.price), 0
    sure, explained, likeliest = 0.0, 0.0, 0.0
    for s in range(len(belief)):
        if belief[s] > 0.0:
            sure += belief[s] * tables.value[step, values_at[s]]
            explained += belief[s] * tables.explain[step, labels_at[s]]
            likeliest = max(likeliest, belief[s])
            matters |= tables.relevant[s]
    best, action, least = explained, n, explained
    margin = tables.patience * (1.0 - likeliest)
    for j in range(n):
        if not (matters & ~said) >> j & 1:
            continue
        total = 0.0
        for s in range(len(belief)):
            if belief[s] > 0.0:
                at, jump = values_at[s] + tables.value_stride[j, s], tables.jump[j, s]
                value = tables.value[step, at]
                if jump > 0:
                    value += tables.accept[s] * (tables.value[step, at + jump] - value)
                total += belief[s] * value
        value = tables.message_discount * total - tables.price[j]
        if value - margin * tables.price[j] > least + 1e-9 * (1.0 + abs(least)):
            best, action, least = value, j, value - margin * tables.price[j]
    return action, sure - best


@kernel
def _loss_of(tables, counter, step, said, state, belief, labels_at, values_at):  # type: ignore[no-untyped-def]
    """The losses on the way of one user who begins in this state. Arrays are used up."""
    n, steps, types = len(tables.price), len(tables.explain), len(tables.forget)
    total, scale = 0.0, 1.0
    for k in range(step, steps):
        while True:
            action, loss = _best(tables, k, said, belief, labels_at, values_at)
            total += scale * loss
            if action == n:
                break
            scale *= tables.message_discount
            said |= 1 << action
            for s in range(len(belief) - 1, -1, -1):
                labels_at[s] += tables.label_stride[action, s]
                values_at[s] += tables.value_stride[action, s]
                jump = tables.jump[action, s]
                if jump > 0:
                    landed = tables.accept[s] * belief[s]
                    belief[s] -= landed
                    belief[s + jump] += landed
            if tables.jump[action, state] > 0 and _uniform(counter) < tables.accept[state]:
                state += tables.jump[action, state]
        if k + 1 == steps:
            break
        scale *= tables.discount
        for i in range(k + 1):
            label = _uniform(counter) < tables.answered[i, labels_at[state]]
            for s in range(len(belief)):
                p = tables.answered[i, labels_at[s]]
                belief[s] *= p if label else 1.0 - p
        whole = belief.sum()
        for s in range(len(belief)):
            belief[s] /= whole
        if not tables.lands:
            said = 0
            values_at[:] = tables.value_base
            bit = types
            while bit < len(belief):
                for s in range(len(belief)):
                    if s // bit % 2 == 0:
                        lost = tables.forget[s % types] * belief[s + bit]
                        belief[s + bit] -= lost
                        belief[s] += lost
                if state // bit % 2 == 1 and _uniform(counter) < tables.forget[state % types]:
                    state -= bit
                bit *= 2
    return total


@kernel
def _mean_loss(tables, step, said, belief, labels_at, values_at, states, weights, seeds):  # type: ignore[no-untyped-def]
    """Over users who begin in these states, by weight."""
    counter, total = np.zeros(1, np.uint64), 0.0
    for i in range(len(states)):
        counter[0] = seeds[i]
        where = belief.copy(), labels_at.copy(), values_at.copy()
        total += weights[i] * _loss_of(tables, counter, step, said, states[i], *where)
    return total
