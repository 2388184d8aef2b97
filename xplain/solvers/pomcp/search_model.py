"""The reduced POMDP laid out for simulations, and how observations are coded.

What every type answers alike is no news and is not drawn. Labels with the same column P[:, i, H]
are exchangeable, so an observation is known by Σ_i [l_i = 0] · w_i, with one 64-bit hash w a
distinct column (two different observations of a node are taken for one with probability 2^-64).

Values stand at each type's row of H. Observations, which couple all types, are coded when a
simulation first comes to an H.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, shared_kernel
from xplain.solvers.model import Model, explain_costs, optimal_values, table_bytes
from xplain.solvers.model import model_of as reduced_model
from xplain.solvers.random_words import GOLDEN, splitmix64
from xplain.solvers.rows import row

LIKELIEST = np.dtype([("probability", np.float64), ("code", np.uint64)])
CACHE = 1 << 24
"""Bytes of coded observations, about."""
SETTLED = -1
"""In ``wanted``: no type should be given any message from here to the end."""


class SearchModel(NamedTuple):
    """The reduced POMDP as simulations want it: what one looks at stands side by side.

    Attributes:
        reduced: the reduced POMDP.
        optimal: [m + 1, rows, N] V*_t(k, H).
        explain_cost: [rows, m, N] C_inexp Σ_{i ≤ k + 1} (1 − P[t, i, H]).
        wanted: [rows, m, N] bitmask of the messages that a type should be given next rather than
            *explain*; SETTLED where it should not from here to the end. Where all types' rows are
            the same, [rows, m, 1] for all together.
        coded: [sets] the message set that is coded here, −1 for none:
        informative: [sets, m] how many of the first k + 1 labels types answer differently.
        p: [sets, m, N] P of the informative labels, in order.
        weight: [sets, m] their w.
        likeliest: [sets, m, N] LIKELIEST, where each of the first k + 1 informative labels is the
            likelier of the two: its probability (≥ ½ a label), and its code.
    """

    reduced: Model
    optimal: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    wanted: NDArray[np.int64]
    coded: NDArray[np.int64]
    informative: NDArray[np.int32]
    p: NDArray[np.float64]
    weight: NDArray[np.uint64]
    likeliest: NDArray[np.void]


def model_bytes(problem: Problem) -> int:
    """Memory that :func:`model_of` takes at most, in bytes: tables of values, costs and wanted
    messages, one more to work with, and coded observations."""
    steps, types = problem.n_steps, problem.n_types
    sets = _coded_sets(problem.n_messages, steps, types)
    return 4 * table_bytes(problem) + sets * (8 + steps * (24 * types + 12))


def model_of(problem: Problem) -> SearchModel:
    """Lays a problem out for the search."""
    reduced = reduced_model(problem)
    optimal, costs = optimal_values(reduced), explain_costs(reduced)
    wanted = _wanted(reduced, optimal, costs)
    if problem.is_dense:
        none = (wanted == SETTLED).all(axis=-1, keepdims=True)
        together = np.bitwise_or.reduce(np.maximum(wanted, 0), axis=-1, keepdims=True)
        wanted = np.where(none, SETTLED, together)
    explain_cost = np.ascontiguousarray(costs.transpose(1, 0, 2))
    wanted = np.ascontiguousarray(wanted.transpose(1, 0, 2))
    steps, types = reduced.n_steps, reduced.n_types
    sets = _coded_sets(problem.n_messages, steps, types)
    return SearchModel(reduced, optimal, explain_cost, wanted, *_room(sets, steps, types))


@dataclass(frozen=True)
class CodedRooms:
    """A model with a room of coded observations for each search that runs at the same time, as the
    threads of a server share a plan and simulations run without the interpreter's lock.

    Attributes:
        model: with a first room.
    """

    model: SearchModel
    _free: list[SearchModel] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_free", [self.model])

    @contextmanager
    def borrow(self) -> Iterator[SearchModel]:
        """The model with a room that nobody else uses meanwhile."""
        try:
            model = self._free.pop()
        except IndexError:
            model = SearchModel(*self.model[:4], *_room(*self.model.p.shape))
        try:
            yield model
        finally:
            self._free.append(model)


def _coded_sets(messages: int, steps: int, types: int) -> int:
    """How many message sets are kept coded: a power of two."""
    return 1 << min(max(CACHE // (steps * (24 * types + 12)), 16).bit_length() - 1, 12, messages)


def _room(sets: int, steps: int, types: int) -> tuple[NDArray[Any], ...]:
    """For coded observations; memory that is not written takes none."""
    return (
        np.full(sets, -1, np.int64),
        np.empty((sets, steps), np.int32),
        np.empty((sets, steps, types)),
        np.empty((sets, steps), np.uint64),
        np.empty((sets, steps, types), LIKELIEST),
    )


def _wanted(
    model: Model, optimal: NDArray[np.float64], costs: NDArray[np.float64]
) -> NDArray[np.int64]:
    """``wanted``, [m, rows, N], type by type."""
    steps, types, rows = model.n_steps, model.n_types, model.rows
    now, silent = optimal[:-1], model.discount * optimal[1:] - costs
    wanted = np.zeros(silent.shape, np.int64)
    bit = 1 << np.arange(len(model.price), dtype=np.int64)
    for stride, size, price in zip(rows.stride, rows.size, rows.price, strict=True):
        messages = bit @ (rows.place == stride)
        shape = steps, -1, size + 1, stride, types
        values, least, found = (table.reshape(shape) for table in (now, silent, wanted))
        for count in range(size):
            said = model.message_discount * values[:, :, count + 1] - price[count]
            found[:, :, count] |= np.where(said > least[:, :, count], messages, 0)
    wanted[now <= silent] = 0
    later = np.logical_or.accumulate(wanted[::-1] != 0, axis=0)[::-1]
    wanted[~later] = SETTLED
    return wanted


@shared_kernel
def _code_set(model, given, slot):  # type: ignore[no-untyped-def]
    """Codes the observations at H in this place."""
    _, steps, types = model.likeliest.shape
    found = 0
    for i in range(steps):
        differs = False
        code = GOLDEN
        column = model.p[slot, found]  # overwritten where this transition is no news
        for t in range(types):
            column[t] = model.reduced.answered[i, row(model.reduced.rows.part, given, t), t]
            differs |= column[t] != column[0]
            code = splitmix64((code + GOLDEN) ^ np.float64(column[t]).view(np.uint64))
        for t in range(types):
            usual = model.likeliest[slot, i, t]
            before = model.likeliest[slot, max(i - 1, 0), t]
            usual.probability = before.probability if i > 0 else 1.0
            usual.code = before.code if i > 0 else np.uint64(0)
            if differs:
                usual.probability *= max(column[t], 1.0 - column[t])
                usual.code += code if column[t] < 0.5 else np.uint64(0)
        if differs:
            model.weight[slot, found] = code
            found += 1
        model.informative[slot, i] = found


@inlined
def place_of(model, given):  # type: ignore[no-untyped-def]
    """Where the observations at H are coded. There is one place for each hash of H: what is coded
    there for another set is coded anew when that is met again, and is the same."""
    slot = given
    if slot >= len(model.coded):
        slot ^= slot >> 24 ^ slot >> 48
        slot = (slot ^ slot >> 12) & (len(model.coded) - 1)
    if model.coded[slot] != given:
        _code_set(model, given, slot)
        model.coded[slot] = given
    return slot


@inlined
def wanted_at(model, step, given, at):  # type: ignore[no-untyped-def]
    """The messages that some type should be given next at (k, H), or SETTLED. ``at``: [N] rows."""
    mask, settled = 0, True
    for t in range(model.wanted.shape[2]):
        own = model.wanted[at[t], step, t]
        if own != SETTLED:
            settled = False
            mask |= own
    return SETTLED if settled else mask & ~given
