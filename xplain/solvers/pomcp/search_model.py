"""The reduced POMDP laid out for simulations, and how observations are coded.

What every type answers alike is no news and is not drawn. Labels with the same column P[:, i, H]
are exchangeable, so an observation is known by Σ_i [l_i = 0] · w_i, with one 64-bit hash w a
distinct column (two different observations of a node are taken for one with probability 2^-64).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.explanation.problem import Problem
from xplain.numba_kernels import lean_kernel
from xplain.solvers.model import explain_costs, explicable, optimal_values, table_bytes
from xplain.solvers.model import model_of as reduced_model
from xplain.solvers.pomcp.random_words import GOLDEN, splitmix64

LIKELIEST = np.dtype([("probability", np.float64), ("code", np.uint64)])
SETTLED = -1
"""In ``wanted``: no type should be given any message from here to the end."""


class SearchModel(NamedTuple):
    """The reduced POMDP as simulations want it: what one looks at stands side by side.

    Attributes:
        optimal: [m + 1, 2^n, N] V*_t(k, H).
        explain_cost: [2^n, m, N] C_inexp Σ_{i ≤ k + 1} (1 − P[t, i, H]).
        informative: [2^n, m] how many of the first k + 1 labels types answer differently.
        p: [2^n, m, N] P of the informative labels, in order.
        weight: [2^n, m] their w.
        likeliest: [2^n, m, N] LIKELIEST, where each of the first k + 1 informative labels is the
            likelier of the two: its probability (≥ ½ a label), and its code.
        wanted: [2^n, m] bitmask of the messages that some type should be given next rather than
            *explain*; SETTLED where no type should from here to the end.
        price: [n] λ C_e.
        discount, message_discount: γ of *explain* and of a message.
    """

    optimal: NDArray[np.float64]
    explain_cost: NDArray[np.float64]
    informative: NDArray[np.int32]
    p: NDArray[np.float64]
    weight: NDArray[np.uint64]
    likeliest: NDArray[np.void]
    wanted: NDArray[np.int32]
    price: NDArray[np.float64]
    discount: float
    message_discount: float


def model_bytes(problem: Problem) -> int:
    """Memory that :func:`model_of` takes, in bytes."""
    sets, steps = 1 << problem.n_messages, problem.n_steps
    return table_bytes(problem) + sets * steps * (32 * problem.n_types + 16)


def model_of(problem: Problem) -> SearchModel:
    """Lays a problem out for the search."""
    reduced = reduced_model(problem)
    steps, sets, types = reduced.n_steps, reduced.n_sets, reduced.n_types
    model = SearchModel(
        optimal_values(reduced),
        np.ascontiguousarray(explain_costs(reduced).transpose(1, 0, 2)),
        np.empty((sets, steps), np.int32),
        np.empty((sets, steps, types)),
        np.empty((sets, steps), np.uint64),
        np.empty((sets, steps, types), LIKELIEST),
        np.empty((sets, steps), np.int32),
        reduced.price,
        reduced.discount,
        reduced.message_discount,
    )
    _code_observations(reduced, model)
    _find_wanted(model)
    return model


@lean_kernel
def _code_observations(reduced, model):  # type: ignore[no-untyped-def]
    """Fills ``informative``, ``p``, ``weight`` and ``likeliest``."""
    sets, steps, types = model.likeliest.shape
    for given in range(sets):
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
                usual = model.likeliest[given, i, t]
                before = model.likeliest[given, max(i - 1, 0), t]
                usual.probability = before.probability if i > 0 else 1.0
                usual.code = before.code if i > 0 else np.uint64(0)
                if differs:
                    yes = explicable(reduced, i, given, t)
                    model.p[given, found, t] = yes
                    usual.probability *= max(yes, 1.0 - yes)
                    usual.code += code if yes < 0.5 else np.uint64(0)
            if differs:
                model.weight[given, found] = code
                found += 1
            model.informative[given, i] = found


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
            settled = mask == 0 and (k + 1 == steps or model.wanted[given, k + 1] == SETTLED)
            model.wanted[given, k] = SETTLED if settled else mask
