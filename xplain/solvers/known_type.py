"""Values where the hidden state is known: the floor that solvers stand on.

With s known labels tell nothing, and the process is an MDP on (k, v), solved backwards in k
(Bellman 1957):

    Q(k, v, s, explain) = γ E_F V(k + 1, v⁺, s') − explain_cost[k, x(v, s)],   V(m, ·) = 0
    Q(k, v, s, give j) = γ' [α V(k, v + j, s + jump[j, s]) + (1 − α) V(k, v + j, s)] − price[j]
    V(k, v, s) = max { Q(k, v, s, explain), max_{j ∉ v} Q(k, v, s, give j) }

Where messages land, the maximum over all sets of messages is one sweep a message, the most
expensive first: of a best set the cheapest is given first. Where they may be missed, what comes
next depends on what was taken in, and v is the messages of this step.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.label_table import NONE
from xplain.explanation.problem import Problem
from xplain.solvers.process import Cells, Process, expected_after_forgetting, row_messages


class KnownValues(NamedTuple):
    """V and Q in two layouts behind one lookup.

    Attributes:
        value: [m + 1, cells] V, read by ``value_cells``.
        explain: [m, cells] Q of *explain*, read by ``explain_cells``.
        value_cells, explain_cells: where they are read.
    """

    value: NDArray[np.float64]
    explain: NDArray[np.float64]
    value_cells: Cells
    explain_cells: Cells

    def now(self, step: int, said: int) -> NDArray[np.float64]:
        """[S] V(k, v, s)."""
        return self.value[step, self.value_cells.at(said)]

    def explained(self, step: int, said: int) -> NDArray[np.float64]:
        """[S] Q(k, v, s, explain)."""
        return self.explain[step, self.explain_cells.at(said)]


def known_values(process: Process, idle: bool = False) -> KnownValues:
    """Solves the MDP of known states.

    Args:
        process: the model.
        idle: whether a known type may be given messages of its row that change nothing for it.
            Given for the sake of others they put off its costs: where giving discounts, Σ b V
            bounds the optimum from above only so.
    """
    prices = _bit_prices(process, idle)
    solve = _where_messages_land if process.jump is None else _where_messages_are_missed
    return solve(process, prices)


def known_bytes(problem: Problem) -> int:
    """What :func:`~xplain.solvers.process.make_process` and :func:`known_values` take, in bytes."""
    steps, rows, types = problem.table.p.shape
    if problem.messages_land:
        return 8 * 4 * (steps + 1) * types << max(map(len, row_messages(problem)))
    return 8 * (steps + 1) * rows * types * (rows + 3)


def _bit_prices(process: Process, idle: bool) -> NDArray[np.float64]:
    """[r, N] price of the message of each bit; inf where there is none, or it changes nothing."""
    own, types = process.own.T, np.arange(process.n_types)
    exists = own != NONE
    if not idle:
        exists &= (process.relevant[types] >> np.maximum(own, 0) & 1).astype(bool)
    prices = process.price[own] if process.n_messages else np.zeros(own.shape)
    return np.where(exists, prices, np.inf)


def _where_messages_land(process: Process, prices: NDArray[np.float64]) -> KnownValues:
    value = np.zeros((process.n_steps + 1, process.p.shape[1]))
    explain = np.empty(process.p.shape)
    for k in reversed(range(process.n_steps)):
        np.multiply(value[k + 1], process.discount, out=explain[k])
        explain[k] -= process.explain_cost[k]
        value[k] = explain[k]
        for bit in reversed(range(len(prices))):
            pairs = value[k].reshape(-1, 2, 1 << bit, process.n_types)
            given = process.message_discount * pairs[:, 1] - prices[bit]
            np.maximum(pairs[:, 0], given, out=pairs[:, 0])
    return KnownValues(value, explain, process.cells, process.cells)


def _where_messages_are_missed(process: Process, prices: NDArray[np.float64]) -> KnownValues:
    """[m + 1, sets of the step, S] where messages may be missed."""
    states, types, bits = process.n_states, process.n_types, len(prices)
    assert process.accept is not None
    accept = process.accept[:types]
    sets = np.arange(1 << bits)
    value = np.zeros((process.n_steps + 1, len(sets), states))
    explain = np.empty((process.n_steps, states))
    for k in reversed(range(process.n_steps)):
        later = expected_after_forgetting(process, value[k + 1, 0])
        explain[k] = process.discount * later - process.explain_cost[k]
        value[k] = explain[k]
        for size in reversed(range(bits)):  # one message more is known already
            for bit in range(bits):
                without = sets[(np.bitwise_count(sets) == size) & (sets >> bit & 1 == 0)]
                more = value[k, without | 1 << bit]
                pairs = more.reshape(-1, 2, 1 << bit, types)
                pairs[:, 0] += accept * (pairs[:, 1] - pairs[:, 0])
                gained = more.reshape(-1, types) - prices[bit]
                value[k, without] = np.maximum(value[k, without], gained.reshape(more.shape))
    stride = np.zeros((process.n_messages, states // types, types), np.int64)
    whose, digit = np.nonzero(process.own != NONE)
    stride[process.own[whose, digit], :, whose] = (states << digit)[:, None]
    cells = Cells(np.arange(states), stride.reshape(process.n_messages, states))
    return KnownValues(value.reshape(len(value), -1), explain, cells, process.cells)
