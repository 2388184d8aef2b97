"""Labels of a simulated user, and the exact belief after them.

``model`` is a :class:`~xplain.solvers.pomcp.search_model.SearchModel`, ``tree`` a
:class:`~xplain.solvers.pomcp.tree.Tree`.
"""

from __future__ import annotations

import numpy as np
from numba import uint64

from xplain.numba_kernels import inlined
from xplain.solvers.pomcp.search_model import place_of
from xplain.solvers.random_words import GOLDEN, next_uniform, splitmix64


@inlined
def draw_labels(model, tree, step, given, t):  # type: ignore[no-untyped-def]
    """Draws the informative labels of a user of type t after *explain* at (k, H): their code.

    A number u decides how many labels in a row are the likelier of the two. Mostly all are, which
    is one look into a table; else ``tree.zero`` is filled, with a new u after each unlikely label.
    """
    at = place_of(model, given)
    count = model.informative[at, step]
    if count == 0:
        return uint64(0)
    u = next_uniform(tree.counter)
    code = model.likeliest[at, step, t].code
    if u >= model.likeliest[at, step, t].probability:
        as_likely = 1.0
        for i in range(count):
            yes = model.p[at, i, t]
            zero = yes < 0.5
            as_likely *= 1.0 - yes if zero else yes
            if u >= as_likely:
                zero = not zero
                code = code + model.weight[at, i] if zero else code - model.weight[at, i]
                u = next_uniform(tree.counter)
                as_likely = 1.0
            tree.zero[i] = zero
    return code


@inlined
def update_belief(model, tree, step, given, t, code, belief):  # type: ignore[no-untyped-def]
    """belief [N] ∝ itself × likelihood of the labels just drawn, for type t. The likelihoods of
    labels met before are remembered."""
    at = place_of(model, given)
    count = model.informative[at, step]
    if count == 0:
        return
    key = splitmix64(code + uint64(given * model.informative.shape[1] + step + 1) * GOLDEN)
    slot = np.int64(key & uint64(len(tree.seen) - 1))
    if tree.seen[slot] != key:
        tree.seen[slot] = key
        usual = code == model.likeliest[at, step, t].code  # nothing was written to ``zero``
        for other in range(len(belief)):
            likelihood = 1.0
            for i in range(count):
                zero = model.p[at, i, t] < 0.5 if usual else tree.zero[i]
                yes = model.p[at, i, other]
                likelihood *= 1.0 - yes if zero else yes
            tree.likelihoods[slot, other] = likelihood
    total = 0.0
    for other in range(len(belief)):
        belief[other] *= tree.likelihoods[slot, other]
        total += belief[other]
    scale = 1.0 / total
    for other in range(len(belief)):
        belief[other] *= scale
