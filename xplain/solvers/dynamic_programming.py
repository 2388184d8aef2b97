"""Optimal values when the type is known: the tables that every solver here stands on.

With the type known, labels tell nothing, and the explanation POMDP is an MDP on (k, H): k
transitions shown, message set H given (SPEC §5). Its Bellman equation, over single actions, is

    V(k, H) = max( −C_inexp Σ_{i ≤ k+1} (1 − P[t, i, H]) + γ V(k + 1, H),        *explain*
                   max_{j ∉ H} −λ C_e(j) + γ' V(k, H ∪ {j}) ),                  message j

with V(m, ·) = 0, and γ' = γ where every action discounts (the paper), 1 where only steps do.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from xplain.errors import InputError, TooLargeError
from xplain.explanation.problem import Problem
from xplain.numba_kernels import kernel, tell_when_compiling
from xplain.solvers.base import Policy

log = logging.getLogger(__name__)

GIB = 1 << 30

TIE = 1e-9
"""Values closer than this, relative to 1 + their size, are equal: *explain* then comes first, and
after it messages in their order."""


def message_discount(problem: Problem) -> float:
    """γ', the discount of giving a message."""
    return problem.discount if problem.discount_per == "action" else 1.0


def message_price(problem: Problem) -> NDArray[np.float64]:
    """[n] λ C_e(j), what giving each message costs."""
    return problem.trade_off * problem.message_cost


def best_set(values: Mapping[int, float]) -> int:
    """The set with the largest value; ties: fewest messages, then message order."""
    best = max(values.values())
    tied = (chosen for chosen, value in values.items() if value >= best - TIE * (1 + abs(best)))
    return min(tied, key=lambda chosen: (chosen.bit_count(), chosen))


def check_memory_gib(value: float) -> None:
    """Raises InputError unless the limit of a solver is a positive number."""
    if not value > 0:
        raise InputError("solver.memory_gib", value, "a number > 0")


def check_memory(what: str, size: int, limit_gib: float, instead: str) -> None:
    """Refuses tables before they are taken, and tells of large ones.

    Args:
        what: the solver.
        size: bytes.
        limit_gib: the solver's ``memory_gib``.
        instead: what could be done.

    Raises:
        TooLargeError: more than the limit.
    """
    if size > limit_gib * GIB:
        raise TooLargeError(
            f"{what} needs {size / GIB:.2f} GiB for its tables, more than "
            f"solver.memory_gib={limit_gib:g}: {instead}"
        )
    if size > GIB / 4:
        log.info("%s takes %.2f GiB for its tables", what, size / GIB)


def optimal_values(problem: Problem) -> NDArray[np.float64]:
    """V*_t(k, H): [m + 1, 2^n, N] float64, the types side by side as beliefs want them.

    Takes (m + 2) · 2^n · N · 8 bytes; see :func:`check_memory`.
    """
    tell_when_compiling()
    p = problem.p_explicable
    values = np.zeros((problem.n_steps + 1, p.shape[2], problem.n_types))
    zeros = np.zeros((p.shape[2], problem.n_types))
    _expected_zeros(p, zeros)
    price, per_message = message_price(problem), message_discount(problem)
    # One call a step, so that Ctrl-C is heard between them.
    for k in reversed(range(problem.n_steps)):
        _backup(
            p[:, k],
            zeros,
            price,
            per_message,
            problem.inexplicability_cost,
            problem.discount,
            values[k],
            values[k + 1],
        )
    return values


def table_bytes(problem: Problem) -> int:
    """What :func:`optimal_values` takes."""
    return (problem.n_steps + 2) * int(problem.p_explicable.shape[2]) * problem.n_types * 8


@kernel
def _expected_zeros(p, zeros):  # type: ignore[no-untyped-def]
    """zeros[H, t] = Σ_i (1 − p[t, i, H]) over the whole trace."""
    types, steps, sets = p.shape
    for t in range(types):
        for i in range(steps):
            for given in range(sets):
                zeros[given, t] += 1.0 - p[t, i, given]


@kernel
def _backup(  # type: ignore[no-untyped-def]
    p, zeros, price, message_discount, inexplicability, discount, values, after
):
    """One step backwards in k. ``zeros`` [2^n, N] holds the expected 0-labels of the prefix that
    *explain* shows at this step, and leaves with the newest transition's taken off. A superset of
    H is a larger integer than H, so descending H meets it first."""
    sets, types = values.shape
    for given in range(sets - 1, -1, -1):
        for t in range(types):
            values[given, t] = -inexplicability * zeros[given, t] + discount * after[given, t]
            zeros[given, t] -= 1.0 - p[t, given]
        for j in range(len(price)):
            more = given | (1 << j)
            if more != given:
                for t in range(types):
                    value = message_discount * values[more, t] - price[j]
                    if value > values[given, t]:
                        values[given, t] = value


@dataclass(frozen=True)
class Greedy:
    """Gives the message with the largest Σ_t b(t) Q*_t(k, H, a), again and again, until
    *explain* is the best action. No label comes in between, so the belief stays.

    Attributes:
        problem: of N types.
        table: [m + 1, 2^n, N] from :func:`optimal_values`.
    """

    problem: Problem
    table: NDArray[np.float64]

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """See :class:`xplain.solvers.base.Policy`."""
        chosen = 0
        while True:
            values = self._action_values(step, given | chosen, belief)
            best = max(values.values())
            tolerance = TIE * (1 + abs(best))
            # The mapping is in order of preference.
            action = next(a for a, value in values.items() if value >= best - tolerance)
            if action == 0:
                return chosen
            chosen |= action

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Σ_t b(t) Q*_t(k, H, a) of *explain* (0) and of each message (its bit)."""
        return self._action_values(step, given, belief)

    def _action_values(
        self, step: int, given: int, belief: NDArray[np.float64]
    ) -> dict[int, float]:
        problem = self.problem
        zeros = (1 - problem.p_explicable[:, : step + 1, given]).sum(axis=1)
        explain = problem.discount * self.table[step + 1, given]
        explain = explain - problem.inexplicability_cost * zeros
        values = {0: float(belief @ explain)}
        price, per_message = message_price(problem), message_discount(problem)
        for j in range(problem.n_messages):
            if not given >> j & 1:
                later = float(belief @ self.table[step, given | 1 << j])
                values[1 << j] = per_message * later - price[j]
        return values


def messages_with_effect(problem: Problem) -> tuple[int, ...]:
    """The messages that change some P[t, i, H]."""
    return tuple(
        j
        for j in range(problem.n_messages)
        if _has_effect(problem.p_explicable.reshape(-1, 2, 1 << j))
    )


@kernel
def _has_effect(p):  # type: ignore[no-untyped-def]
    for a in range(p.shape[0]):
        for b in range(p.shape[2]):
            if p[a, 0, b] != p[a, 1, b]:
                return True
    return False


def messages_worth_giving(problem: Problem) -> tuple[int, ...]:
    """The messages to plan with: those with effect, and those that may pay as a mere delay.

    A message without effect costs λ C_e. Where giving it discounts, it also puts off what is
    still to be paid, which is worth (1 − γ) of that: with a low price an optimal plan does stall.
    It is left out only where it cannot: what is still to be paid under the optimum is at most
    the optimal cost of an imagined type that finds each transition as inexplicable as any type.
    """
    effective = messages_with_effect(problem)
    idle = set(range(problem.n_messages)) - set(effective)
    delay = 1 - message_discount(problem)
    if not idle:
        return effective
    ahead = 0.0
    if delay > 0:
        small = restrict(problem, effective)
        worst = small.with_types(small.p_explicable.min(axis=0, keepdims=True), ("worst",))
        ahead = -float(optimal_values(worst).min())
    price = message_price(problem)
    stalling = {j for j in idle if price[j] < delay * ahead}
    return tuple(sorted(stalling.union(effective)))


def subsets(messages: Iterable[int]) -> NDArray[np.int64]:
    """The masks of all subsets of some messages, ascending where these are."""
    masks = np.zeros(1, dtype=np.int64)
    for j in messages:
        masks = np.concatenate([masks, masks | 1 << j])
    return masks


def restrict(problem: Problem, kept: tuple[int, ...]) -> Problem:
    """The problem with only some messages; the others are never given."""
    if len(kept) == problem.n_messages:
        return problem
    return replace(
        problem,
        p_explicable=problem.p_explicable[:, :, subsets(kept)],
        message_cost=problem.message_cost[list(kept)],
        message_names=tuple(problem.message_names[j] for j in kept),
    )


def expand(mask: int, kept: tuple[int, ...]) -> int:
    """A mask over the kept messages as one over all."""
    return sum(1 << j for i, j in enumerate(kept) if mask >> i & 1)


def compress(mask: int, kept: tuple[int, ...]) -> int:
    """A mask over all messages as one over the kept."""
    return sum(1 << i for i, j in enumerate(kept) if mask >> j & 1)


@dataclass(frozen=True)
class Restricted:
    """A policy of the restricted problem, spoken in the whole problem's masks.

    Attributes:
        policy: over the kept messages.
        kept: their positions in the whole problem.
    """

    policy: Policy
    kept: tuple[int, ...]

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """See :class:`xplain.solvers.base.Policy`."""
        return expand(self.policy.messages(step, compress(given, self.kept), belief), self.kept)

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """See :class:`xplain.solvers.base.Policy`."""
        values = self.policy.values(step, compress(given, self.kept), belief)
        return {expand(mask, self.kept): value for mask, value in values.items()}


def greedy_policy(problem: Problem, what: str, memory_gib: float, instead: str) -> Policy:
    """The greedy policy, planned with the messages worth giving.

    Raises:
        TooLargeError: its tables would take more than ``memory_gib``.
    """
    kept = messages_worth_giving(problem)
    small = restrict(problem, kept)
    check_memory(what, table_bytes(small), memory_gib, instead)
    return Restricted(Greedy(small, optimal_values(small)), kept)
