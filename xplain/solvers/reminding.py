"""QMDP where messages may be missed or forgotten: say it again when that is worth its price.

Act as if the type and what the user knows became known after the next action. With both known, the
optimum is that of an MDP on (k, S, K): what was said at this step, and the facts that the user
has right:

    Q_t(k, c, S, K, explain) = −C_t(k, K) + γ E[V_t(k + 1, c + S, ∅, K')],    K' what is left of K
    Q_t(k, c, S, K, say j)   = −λ C_e(j) + γ' (α V_t(k, c, S ∪ {j}, K ∪ {j}) + (1 − α) V_t(…, K)).

Values alone say too early: a message's value, too, assumes that all becomes known after it. But
saying it tells nothing about the user, and hides the answer that would. So where the state is in
doubt, a message must gain :data:`PATIENCE` of its price on top.

A message is said at most once a step. One that changes nothing for a type may still put off what is
to be paid, where messages discount: such messages with one price are a digit of S, as in
:mod:`xplain.solvers.rows`. Between the messages of a decision the belief changes, as each is likely
to have been taken in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation import knowledge
from xplain.explanation.belief import told
from xplain.explanation.message_sets import indices
from xplain.explanation.problem import Problem
from xplain.numba_kernels import lean_kernel
from xplain.solvers.memory import check_memory
from xplain.solvers.model import best_of, table_bytes
from xplain.solvers.rows import Rows, looked_up, make_rows, parts_of, rows_at

PATIENCE = 0.1
"""A message must gain this share of its price, times the probability that the state is not the
likeliest one. Chosen among 0.05, 0.1, 0.15 and 0.2 on seeds 9700 to 9745."""


def reminding_policy(problem: Problem, what: str, memory_gib: float) -> Reminding:
    """QMDP's policy of a problem that tracks what users know.

    Raises:
        TooLargeError: its tables would take more than ``memory_gib``.
    """
    check_memory(what, known_bytes(problem), memory_gib, "fewer messages or habits fit")
    return Reminding(problem)


def known_bytes(problem: Problem) -> int:
    """What the tables of :class:`Reminding` take, where nothing is said as a mere delay."""
    relevant = problem.table.relevant.shape[1]
    cells: int = (1 << relevant) + 1
    return table_bytes(problem) * cells


class Solved(NamedTuple):
    """Values with type and knowledge known, for G counts c, W rows of S, R of K.

    Attributes:
        rows: of S.
        counts: parts, as of :class:`~xplain.solvers.rows.Rows`, of c.
        after: [G, W] c + S.
        factor: [G, digits] on the price of one more message; inf of those that may not be said.
        optimal: [m + 1, G, W, R, N] V_t(k, c, S, K).
        explain: [m, G, R, N] Q_t(k, ·, explain), by c + S.
    """

    rows: Rows
    counts: NDArray[np.int64]
    after: NDArray[np.int64]
    factor: NDArray[np.float64]
    optimal: NDArray[np.float64]
    explain: NDArray[np.float64]


@dataclass(frozen=True)
class Reminding:
    """Gives the message with the largest Σ b(t, K) Q_t(k, c, S, K, a), each at most once a step and
    dearer by :data:`PATIENCE`, until *explain* is the best action."""

    problem: Problem
    _found: dict[tuple[Any, ...], NDArray[np.float64]] = field(default_factory=dict)

    def messages(self, step: int, given: int, belief: NDArray[np.float64]) -> int:
        """The messages to give before the next *explain*, some of them perhaps again."""
        said = 0
        while True:
            margin = PATIENCE * (1 - belief.max())
            sets, values = self._values(step, given, said, belief, margin)
            new = best_of(sets, values)
            if not new:
                return said
            said |= new
            belief = told(self.problem, belief, new)

    def values(self, step: int, given: int, belief: NDArray[np.float64]) -> Mapping[int, float]:
        """Of *explain* (0) and of each message (its bit)."""
        sets, values = self._values(step, given, 0, belief)
        return dict(zip(sets.tolist(), values.tolist(), strict=True))

    def _values(
        self, step: int, given: int, said: int, belief: NDArray[np.float64], margin: float = 0.0
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        problem = self.problem
        free = [j for j in self.kept if not said >> j & 1]
        prices, known = problem.prices, belief.reshape(-1, problem.n_types)
        values = [belief @ self.explained(step, given)]
        for j in free:
            heard = knowledge.say(known, problem.table.relevant, j, problem.accept)
            later = self.known(step, given, said | 1 << j)
            values.append(self.delay * (heard.ravel() @ later) - (1 + margin) * prices[j])
        return np.array([0, *(1 << j for j in free)]), np.array(values)

    def known(self, step: int, given: int, said: int = 0) -> NDArray[np.float64]:
        """[R · N] V_t(k, c, S, K)."""
        solved = self.solved
        at = looked_up(solved.counts, given), rows_at(solved.rows, said)
        return self._cells(solved.optimal, step, *at)

    def explained(self, step: int, given: int) -> NDArray[np.float64]:
        """[R · N] Q_t(k, ·, explain), with all this said."""
        return self._cells(self.solved.explain, step, looked_up(self.solved.counts, given))

    def _cells(
        self, table: NDArray[np.float64], step: int, *at: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Every type's own cells, for what was said."""
        key = table.ndim, step, *(one.tobytes() for one in at)
        if key not in self._found:
            types = np.arange(self.problem.n_types)
            self._found[key] = table[step][*at, :, types].T.ravel()
        return self._found[key]

    def explain_cost(self, step: int) -> NDArray[np.float64]:
        """[R · N] expected, of *explain* at k."""
        zeros: NDArray[np.float64] = (1 - self.problem.table.p[: step + 1]).sum(axis=0).ravel()
        return self.problem.inexplicability_cost * zeros

    def paid(self, given: int, new: int) -> tuple[float, float]:
        """The price of messages, the cheapest first, each discounting what follows; and what all
        of them discount."""
        prices = np.sort(self.problem.prices[indices(new)])
        return float(self.delay ** np.arange(len(prices)) @ prices), self.delay ** len(prices)

    @cached_property
    def kept(self) -> tuple[int, ...]:
        """The messages worth a thought: those with effect, and those that may pay as a delay."""
        own = int(np.bitwise_or.reduce(self.solved.rows.relevant))
        return tuple(sorted({*self.problem.table.effective_of_any(), *indices(own)}))

    @property
    def delay(self) -> float:
        """γ'."""
        return self.problem.message_discount

    @cached_property
    def solved(self) -> Solved:
        """The MDP's values."""
        problem, table = self.problem, self.problem.table
        price = problem.trade_off * problem.message_cost
        return self._solve(make_rows(table, price))

    def _solve(self, rows: Rows) -> Solved:
        problem, table = self.problem, self.problem.table
        steps, known, types = table.p.shape
        after, factor = _counting(problem, rows)
        costs = problem.inexplicability_cost * np.cumsum(1 - table.p, axis=0)
        optimal = np.zeros((steps + 1, *after.shape, known, types))
        explain = np.empty((steps, len(after), known, types))
        lose = np.tile(problem.forget, len(after))
        for k in reversed(range(steps)):
            flat = optimal[k + 1, :, 0].transpose(1, 0, 2).reshape(known, -1)
            left = knowledge.expected_after_forgetting(flat, table.relevant, lose)
            later = left.reshape(known, -1, types).transpose(1, 0, 2)
            explain[k] = problem.discount * later - costs[k]
            _say(rows, after, factor, problem.accept, self.delay, explain[k], optimal[k])
        return Solved(rows, _count_parts(problem), after, factor, optimal, explain)


def _count_parts(problem: Problem) -> NDArray[np.int64]:
    """What each message said before adds to c, looked up as rows are."""
    place = np.zeros((problem.n_messages, problem.n_types), np.int64)
    return parts_of(place)


def _counting(problem: Problem, rows: Rows) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """``after`` and ``factor`` of :class:`Solved`."""
    return np.zeros((1, rows.number), np.int64), np.ones((1, len(rows.stride)))


@lean_kernel
def _say(rows, after, factor, accept, delay, explain, optimal):  # type: ignore[no-untyped-def]
    """Fills in V_t(k, c, S, K), of one k. One message more is a larger row of S, so descending rows
    meet it first."""
    counts, sets, known, types = optimal.shape
    for g in range(counts):
        for at in range(sets - 1, -1, -1):
            now = optimal[g, at]
            for r in range(known):
                for t in range(types):
                    now[r, t] = explain[after[g, at], r, t]
            for c in range(len(rows.stride)):
                count = at // rows.stride[c] % (rows.size[c] + 1)
                if count == rows.size[c] or factor[g, c] == np.inf:
                    continue
                more = optimal[g, at + rows.stride[c]]
                for r in range(known):
                    landed = r | 1 << c if c < rows.bits else r
                    for t in range(types):
                        value = more[r, t] + accept[t] * (more[landed, t] - more[r, t])
                        value = delay * value - factor[g, c] * rows.price[c, count, t]
                        if value > now[r, t]:
                            now[r, t] = value
