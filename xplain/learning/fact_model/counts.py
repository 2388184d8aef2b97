"""What the kernels of the sampler share: labels by cell, and a draw by weights.

A cell of transition τ is one value of M ∩ S_τ (see :mod:`xplain.learning.fact_model.model`), its
facts packed into the lowest bits of an integer.
"""

from __future__ import annotations

import numpy as np

from xplain.numba_kernels import called

REACH = 64
"""Ones − zeros beyond which a cell's value is beyond doubt."""
ADDED, TAKEN = np.int64(1), np.int64(-1)
"""Signs of labels that are counted, and counted no longer."""


@called
def packed(subsets, z, mask):  # type: ignore[no-untyped-def]
    """The bits of ``mask`` at the positions of subset z, packed."""
    packed = 0
    for i in range(subsets.shape[1]):
        if subsets[z, i] < 0:
            break
        packed |= (mask >> subsets[z, i] & 1) << i
    return packed


@called
def table_row(ahead):  # type: ignore[no-untyped-def]
    """Where ones − zeros is in the tables of :class:`~xplain.learning.fact_model.model.Prior`."""
    return min(max(ahead, -REACH), REACH) + REACH


@called
def count_rows(o, sign, answers, prior, state):  # type: ignore[no-untyped-def]
    """Counts the labels of observer ``o``, of R = ``state.facts[o]``, in ``state.counts``: ADDED
    or TAKEN."""
    transition, label, given = answers.transition, answers.label, state.messages_given
    subset, subsets, count = state.subset, prior.subsets, state.counts
    facts = state.facts[o]
    for p in range(answers.start[o], answers.start[o + 1]):
        t = transition[p]
        count[t, packed(subsets, subset[t], facts) & ~given[p], label[p]] += sign


@called
def draw(log_weight, size, temperature, rng):  # type: ignore[no-untyped-def]
    """An index below ``size`` with probability ∝ exp(log weight / temperature), and the log of the
    sum of the weights themselves."""
    top = log_weight[0]
    for i in range(size):
        top = max(top, log_weight[i])
    total = 0.0
    for i in range(size):
        total += np.exp(log_weight[i] - top)
    heated = total
    if temperature != 1.0:
        heated = 0.0
        for i in range(size):
            heated += np.exp((log_weight[i] - top) / temperature)
    left = rng.random() * heated
    chosen = size - 1
    for i in range(size):
        left -= np.exp((log_weight[i] - top) / temperature)
        if left < 0:
            chosen = i
            break
    return chosen, top + np.log(total)
