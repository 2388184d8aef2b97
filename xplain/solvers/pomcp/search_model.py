"""The reduced POMDP laid out for simulations, and how observations are coded.

What every type answers alike is no news and is not drawn. Labels with the same column P[:, i, H]
are exchangeable, so an observation is known by Σ_i [l_i = 0] · w_i, with one 64-bit hash w a
distinct column (two different observations of a node are taken for one with probability 2^-64).

In a problem kept by type, values stand at each type's row of H, and observations, which couple all
types, are coded when a simulation first comes to an H.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import uint64
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import inlined, lean_kernel, shared_kernel
from xplain.solvers.model import Model, explain_costs, explicable, optimal_values, table_bytes
from xplain.solvers.model import model_of as reduced_model
from xplain.solvers.pomcp.random_words import GOLDEN, splitmix64
from xplain.solvers.rows import Rows, is_left, row

LIKELIEST = np.dtype([("probability", np.float64), ("code", np.uint64)])
CACHE = 1 << 24
"""Bytes of coded observations, about, in a problem kept by type."""
SETTLED = -1
"""In ``wanted``: no type should be given any message from here to the end."""


class SearchModel(NamedTuple):
    """The reduced POMDP as simulations want it: what one looks at stands side by side.

    Attributes:
        optimal: [m + 1, rows, N] V*_t(k, H).
        explain_cost: [rows, m, N] C_inexp Σ_{i ≤ k + 1} (1 − P[t, i, H]).
        informative: [sets, m] how many of the first k + 1 labels types answer differently.
        p: [sets, m, N] P of the informative labels, in order.
        weight: [sets, m] their w.
        likeliest: [sets, m, N] LIKELIEST, where each of the first k + 1 informative labels is the
            likelier of the two: its probability (≥ ½ a label), and its code.
        wanted: [2^n, m, 1] bitmask of the messages that some type should be given next rather than
            *explain*; SETTLED where no type should from here to the end. By type: [rows, m, N].
        price: [n] λ C_e.
        discount, message_discount: γ of *explain* and of a message.
        rows: see :class:`~xplain.solvers.model.Model`; None where dense, and ``sets`` is 2^n.
        coded: [sets] the message set that is coded there, −1 for none, and
        reduced: what it is coded from; both None where dense.
    """

    optimal: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    informative: NDArray[np.int32]
    p: NDArray[np.float64]
    weight: NDArray[np.uint64]
    likeliest: NDArray[np.void]
    wanted: NDArray[np.int32] | NDArray[np.int64]
    price: NDArray[np.float64]
    discount: float
    message_discount: float
    rows: Rows | None = None
    coded: NDArray[np.int64] | None = None
    reduced: Model | None = None


def model_bytes(problem: Problem) -> int:
    """Memory that :func:`model_of` takes, in bytes."""
    if not problem.is_dense:
        return 4 * table_bytes(problem) + CACHE
    sets, steps = 1 << problem.n_messages, problem.n_steps
    return table_bytes(problem) + sets * steps * (32 * problem.n_types + 16)


def model_of(problem: Problem) -> SearchModel:
    """Lays a problem out for the search."""
    reduced = reduced_model(problem)
    steps, rows, types = reduced.n_steps, reduced.n_rows, reduced.n_types
    by_type = reduced.rows is not None
    informative, p, weight, likeliest = _room(
        _cached_sets(steps, types) if by_type else rows, steps, types
    )
    model = SearchModel(
        optimal=optimal_values(reduced),
        explain_cost=np.ascontiguousarray(explain_costs(reduced).transpose(1, 0, 2)),
        informative=informative,
        p=p,
        weight=weight,
        likeliest=likeliest,
        wanted=np.empty((rows, steps, 1), np.int32),
        price=reduced.price,
        discount=reduced.discount,
        message_discount=reduced.message_discount,
    )
    if by_type:
        wanted = np.empty((rows, steps, types), np.int64)
        model = with_own_room(model._replace(wanted=wanted, rows=reduced.rows, reduced=reduced))
        _find_wanted_by_type(model)
    else:
        _code_observations(reduced, model)
        _find_wanted(model)
    return model


def with_own_room(model: SearchModel) -> SearchModel:
    """The same model for another thread: nothing is coded yet. A dense one is only read."""
    if model.rows is None:
        return model
    sets, steps, types = model.likeliest.shape
    informative, p, weight, likeliest = _room(sets, steps, types)
    return model._replace(
        informative=informative,
        p=p,
        weight=weight,
        likeliest=likeliest,
        coded=np.full(sets, -1, np.int64),
    )


def _cached_sets(steps: int, types: int) -> int:
    """How many message sets are kept coded: a power of two."""
    return 1 << min(max(CACHE // (steps * (24 * types + 12)), 16).bit_length() - 1, 12)


def _room(sets: int, steps: int, types: int) -> tuple[NDArray[Any], ...]:
    """For coded observations; memory that is not written takes none."""
    return (
        np.empty((sets, steps), np.int32),
        np.empty((sets, steps, types)),
        np.empty((sets, steps), np.uint64),
        np.empty((sets, steps, types), LIKELIEST),
    )


@lean_kernel
def _code_observations(reduced, model):  # type: ignore[no-untyped-def]
    """Fills ``informative``, ``p``, ``weight`` and ``likeliest``."""
    for given in range(len(model.likeliest)):
        _code_set(reduced, model, given, given)


@inlined
def _code_set(reduced, model, given, slot):  # type: ignore[no-untyped-def]
    """Codes the observations at H in this place."""
    _, steps, types = model.likeliest.shape
    found = 0
    for i in range(steps):
        differs = False
        code = GOLDEN
        first = explicable(reduced, i, given, 0)
        for t in range(types):
            yes = explicable(reduced, i, given, t)
            differs |= yes != first
            code = splitmix64((code + GOLDEN) ^ np.float64(yes).view(np.uint64))
        for t in range(types):
            usual = model.likeliest[slot, i, t]
            before = model.likeliest[slot, max(i - 1, 0), t]
            usual.probability = before.probability if i > 0 else 1.0
            usual.code = before.code if i > 0 else np.uint64(0)
            if differs:
                yes = explicable(reduced, i, given, t)
                model.p[slot, found, t] = yes
                usual.probability *= max(yes, 1.0 - yes)
                usual.code += code if yes < 0.5 else np.uint64(0)
        if differs:
            model.weight[slot, found] = code
            found += 1
        model.informative[slot, i] = found


@inlined
def place_of(rows, model, given):  # type: ignore[no-untyped-def]
    """Where the observations at H are coded."""
    if rows is None:
        return given
    return _cached_place(model, given)


@shared_kernel
def _cached_place(model, given):  # type: ignore[no-untyped-def]
    """One place for each hash of H: what is coded there for another set is coded anew when that
    is met again, and is the same."""
    slot = np.int64(splitmix64(uint64(given)) & uint64(len(model.coded) - 1))
    if model.coded[slot] != given:
        _code_set(model.reduced, model, given, slot)
        model.coded[slot] = given
    return slot


@inlined
def wanted_at(rows, wanted, step, given):  # type: ignore[no-untyped-def]
    """The messages that some type should be given next at (k, H), or SETTLED."""
    if rows is None:
        return np.int64(wanted[given, step, 0])
    mask, settled = 0, True
    for t in range(wanted.shape[2]):
        own = wanted[row(rows, given, t), step, t]
        if own != SETTLED:
            settled = False
            mask |= own
    return SETTLED if settled else mask & ~given


@lean_kernel
def _find_wanted(model):  # type: ignore[no-untyped-def]
    """Fills ``wanted``, backwards in k."""
    sets, steps, types = model.explain_cost.shape
    for given in range(sets):
        for k in range(steps - 1, -1, -1):
            mask = 0
            for t in range(types):
                silent = model.discount * model.optimal[k + 1, given, t]
                silent -= model.explain_cost[given, k, t]
                if model.optimal[k, given, t] > silent:
                    for j in range(len(model.price)):
                        if not given >> j & 1:
                            said = model.message_discount * model.optimal[k, given | 1 << j, t]
                            mask |= (said - model.price[j] > silent) << j
            settled = mask == 0 and (k + 1 == steps or model.wanted[given, k + 1, 0] == SETTLED)
            model.wanted[given, k, 0] = SETTLED if settled else mask


@lean_kernel
def _find_wanted_by_type(model):  # type: ignore[no-untyped-def]
    """Fills ``wanted``, type by type."""
    rows = model.rows
    _, steps, types = model.explain_cost.shape
    for t in range(types):
        others = (1 << len(model.price)) - 1
        for c in range(rows.mask.shape[1]):
            others &= ~rows.mask[t, c]
        for at in range(rows.number[t]):
            for k in range(steps - 1, -1, -1):
                mask = 0
                silent = model.discount * model.optimal[k + 1, at, t] - model.explain_cost[at, k, t]
                if model.optimal[k, at, t] > silent:
                    for j in range(len(model.price)):
                        if others >> j & 1:
                            said = model.message_discount * model.optimal[k, at, t]
                            mask |= (said - model.price[j] > silent) << j
                    for c in range(rows.stride.shape[1]):
                        stride = rows.stride[t, c]
                        if is_left(rows, at, t, c):
                            said = model.message_discount * model.optimal[k, at + stride, t]
                            if said - rows.price[t, c] > silent:
                                mask |= rows.mask[t, c]
                settled = mask == 0 and (k + 1 == steps or model.wanted[at, k + 1, t] == SETTLED)
                model.wanted[at, k, t] = SETTLED if settled else mask
