"""An upper bound tighter than QMDP's: told not the type, but a pair of types that holds it.

The optimum V* is convex in the belief b, so for any mixture b = Σ_q w_q b_q of beliefs in two types
each, V*(b) ≤ Σ_q w_q V*(b_q); QMDP is the mixture of certain beliefs. With two types the belief is
one number. V* is tabulated on a grid of it, backwards in k; between the grid's points the line
through them lies above V*, so the tables bound it from above. They are small: a message that
neither of the two needs does not matter to them.

The mixture: every type's weight is first split among the others in proportion to theirs, then
shifted between two of its pairs as long as that lowers the bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, kernel, shared_kernel
from xplain.solvers.count_lattice import branch, make_answers
from xplain.solvers.model import Model, explain_costs, model_of
from xplain.solvers.restriction import messages_worth_giving

GRID = np.concatenate([[0.0], 1 / (1 + np.exp(-np.linspace(-7, 7, 15))), [1.0]])
"""Beliefs in the first of two types, in equal steps of evidence."""
NEGLIGIBLE = 1e-7
"""Answers rarer than this are taken to tell the type, which can only raise the bound."""
LIGHT = 1e-4
"""Types less likely than this stay as they were split."""
NO_SWEEP, SWEEPS = np.int64(0), np.int64(3)
"""Over all shifts of weight, each smaller than the last. (Not literals: numba would compile for
each.)"""


class Pairs(NamedTuple):
    """Tables for all P pairs of types, side by side, and room to work in.

    Attributes:
        row: [2^n, P] where a pair's values for H are.
        optimal: [m + 1, rows, G] upper bounds of V* at the grid's beliefs.
        explain: [m, rows, G] of Q* of *explain*.
        share: [N, N] of type t's weight, what its pair with u has.
        cell: [P] the last grid point below a pair's belief.
        weight: [P, 2] how much there and at the next point.
    """

    row: NDArray[np.int64]
    optimal: NDArray[np.float64]
    explain: NDArray[np.float64]
    share: NDArray[np.float64]
    cell: NDArray[np.int64]
    weight: NDArray[np.float64]


def with_own_room(pairs: Pairs) -> Pairs:
    """The same tables for another thread."""
    room = {name: np.empty_like(getattr(pairs, name)) for name in ("share", "cell", "weight")}
    return pairs._replace(**room)


def no_pairs(model: Model) -> Pairs:
    """Tables of no pair, which bound nothing."""
    return _joined(model, [], [], [])


@dataclass(frozen=True)
class PairTables:
    """Tables yet to be made, by dynamic programming, pair by pair.

    Attributes:
        problem: of N types.
    """

    problem: Problem

    @cached_property
    def _two(self) -> list[tuple[Problem, tuple[int, ...]]]:
        """Every pair's problem, with the messages that are worth giving in it."""
        found = []
        for pair in combinations(range(self.problem.n_types), 2):
            two = self.problem.only_types(pair)
            kept = messages_worth_giving(two)
            found.append((two.with_messages(kept), kept))
        return found

    @property
    def _entries(self) -> int:
        rows = sum(1 << len(kept) for _, kept in self._two)
        return rows * self.problem.n_steps * len(GRID)

    @property
    def bytes(self) -> int:
        """Memory that the tables take."""
        row = len(self._two) << self.problem.n_messages
        return 8 * (2 * self._entries + row)

    @property
    def work(self) -> int:
        """What making them costs, about, in answers looked at."""
        return self._entries * self.problem.n_steps

    def make(self) -> Pairs:
        """Makes the tables, side by side."""
        rows, optimal, explain = [], [], []
        first = 0
        sets = np.arange(1 << self.problem.n_messages)
        for two, kept in self._two:
            row = np.full(len(sets), first)
            for i, j in enumerate(kept):
                row += (sets >> j & 1) << i
            first += 1 << len(kept)
            rows.append(row)
            tables = _pair_tables(model_of(two))
            optimal.append(tables[0])
            explain.append(tables[1])
        return _joined(model_of(self.problem), rows, optimal, explain)


def _joined(
    model: Model,
    rows: list[NDArray[np.int64]],
    optimal: list[NDArray[np.float64]],
    explain: list[NDArray[np.float64]],
) -> Pairs:
    steps, sets, types = model.n_steps, model.n_rows, model.n_types
    pairs = len(rows)
    return Pairs(
        np.stack(rows, 1) if rows else np.empty((sets, 0), dtype=np.int64),
        np.concatenate([np.empty((steps + 1, 0, len(GRID))), *optimal], axis=1),
        np.concatenate([np.empty((steps, 0, len(GRID))), *explain], axis=1),
        np.zeros((types, types)),
        np.zeros(pairs, dtype=np.int64),
        np.zeros((pairs, 2)),
    )


def _pair_tables(two: Model) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``optimal`` and ``explain`` of one pair."""
    steps, sets = two.n_steps, two.n_rows
    optimal, explain = np.zeros((steps + 1, sets, len(GRID))), np.empty((steps, sets, len(GRID)))
    costs, answers = explain_costs(two), make_answers(64, steps, 2)
    # One call a step, so that Ctrl-C is heard between them.
    for k in reversed(range(steps)):
        while not _pair_step(two, k, costs[k], optimal, explain[k], answers):
            answers = make_answers(4 * len(answers.weight), steps, 2)
    return optimal, explain


@kernel
def _pair_step(model, k, costs, optimal, explain, answers):  # type: ignore[no-untyped-def]
    """One step backwards in k: fills ``optimal[k]`` [2^n, G] and ``explain`` [2^n, G]. False where
    there are more answers than room. ``costs`` [2^n, 2] are those of *explain*."""
    last = k == len(optimal) - 2
    even, nothing = np.full(2, 0.5), np.zeros(2, dtype=np.int64)
    for given in range(len(costs) - 1, -1, -1):
        count = 0
        if not last:
            count = branch(model, k, given, even, nothing, NEGLIGIBLE, answers)
            if count < 0:
                return False
        for g in range(len(GRID)):
            # The even prior of the answers, made this belief.
            one, two = 2.0 * GRID[g], 2.0 * (1.0 - GRID[g])
            value = 0.0
            if not last:
                value = _explained(optimal[k + 1, given], one, two, count, answers)
            explain[given, g] = model.discount * value
            explain[given, g] -= 0.5 * (one * costs[given, 0] + two * costs[given, 1])
            best = explain[given, g]
            for j in range(len(model.price)):
                more = given | 1 << j
                if more != given:
                    later = model.message_discount * optimal[k, more, g]
                    best = max(best, later - model.price[j])
            optimal[k, given, g] = best
    return True


@inlined
def _explained(after, one, two, count, answers):  # type: ignore[no-untyped-def]
    """Expected value after the answers, from ``after`` [G], where the types' weights are ``one``
    and ``two`` times those of the answers."""
    value = one * answers.tail[0] * after[len(GRID) - 1] + two * answers.tail[1] * after[0]
    for a in range(count):
        value += _value(after, one * answers.weight[a, 0], two * answers.weight[a, 1])
    return value


@inlined
def _cell(belief):  # type: ignore[no-untyped-def]
    """The last grid point at or below a belief, but never the very last."""
    low, high = 0, len(GRID) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if GRID[middle] <= belief:
            low = middle
        else:
            high = middle
    return low


@inlined
def _value(table, x, y):  # type: ignore[no-untyped-def]
    """A pair's value [G] where its types weigh x and y, times x + y."""
    total = x + y
    if total <= 0.0:
        return 0.0
    belief = x / total
    g = _cell(belief)
    further = (belief - GRID[g]) / (GRID[g + 1] - GRID[g])
    return total * (table[g] + further * (table[g + 1] - table[g]))


@inlined
def _pair(t, u, types):  # type: ignore[no-untyped-def]
    """The index of a pair t < u, in the order of ``combinations``."""
    return t * (2 * types - t - 1) // 2 + u - t - 1


@inlined
def _shared(pairs, table, given, t, u, x, y):  # type: ignore[no-untyped-def]
    """The value of the pair {t, u} where t weighs x and u weighs y."""
    if t > u:
        t, u, x, y = u, t, y, x
    q = _pair(t, u, pairs.share.shape[0])
    return _value(table[pairs.row[given, q]], x, y)


@shared_kernel
def mix(pairs, step, given, belief, sweeps):  # type: ignore[no-untyped-def]
    """Makes the mixture for a belief at (k, H), in the room of ``pairs``.

    Returns:
        Whether there is one: not where the type is known.
    """
    possible = _split(pairs, belief)
    if possible < 2:
        return False
    part = 1.0
    for _ in range(sweeps if possible > 2 else 0):
        _shift(pairs, pairs.optimal[step], given, belief, part)
        part *= 0.6
    types, share = len(belief), pairs.share
    for t in range(types):
        for u in range(t + 1, types):
            q = _pair(t, u, types)
            total = share[t, u] + share[u, t]
            at = share[t, u] / total if total > 0.0 else 0.0
            g = _cell(at)
            further = (at - GRID[g]) / (GRID[g + 1] - GRID[g])
            pairs.cell[q] = g
            pairs.weight[q, 0] = total * (1.0 - further)
            pairs.weight[q, 1] = total * further
    return True


@inlined
def _split(pairs, belief):  # type: ignore[no-untyped-def]
    """Splits every type's weight among the others in proportion to theirs; returns how many types
    are possible."""
    possible = 0
    for t in range(len(belief)):
        others = 0.0
        for u in range(len(belief)):
            others += belief[u] if u != t else 0.0
        possible += belief[t] > 0.0
        for u in range(len(belief)):
            split = u != t and others > 0.0
            pairs.share[t, u] = belief[t] * belief[u] / others if split else 0.0
    return possible


@inlined
def _shift(pairs, table, given, belief, part):  # type: ignore[no-untyped-def]
    """Shifts a part of each type's weight from one of its pairs to another wherever that lowers
    the bound."""
    types, share = len(belief), pairs.share
    for t in range(types):
        for u in range(types):
            for v in range(types):
                light = min(belief[t], belief[u], belief[v]) < LIGHT
                if light or u in (t, v) or v == t:
                    continue
                shift = part * share[t, u]
                now = _shared(pairs, table, given, t, u, share[t, u], share[u, t])
                now += _shared(pairs, table, given, t, v, share[t, v], share[v, t])
                then = _shared(pairs, table, given, t, u, share[t, u] - shift, share[u, t])
                then += _shared(pairs, table, given, t, v, share[t, v] + shift, share[v, t])
                if then < now:
                    share[t, u] -= shift
                    share[t, v] += shift


@inlined
def mixed(pairs, table, given):  # type: ignore[no-untyped-def]
    """A table [rows, G] at the last mixture."""
    value = 0.0
    for q in range(len(pairs.cell)):
        row, g = pairs.row[given, q], pairs.cell[q]
        value += pairs.weight[q, 0] * table[row, g] + pairs.weight[q, 1] * table[row, g + 1]
    return value
