"""What the kernels of :mod:`xplain.learning.fact_model.gibbs` share: counting labels by cell."""

from __future__ import annotations

from xplain.numba_kernels import kernel

REACH = 64
"""Ones − zeros beyond which a cell's value is beyond doubt."""


@kernel
def packed(subsets, z, mask):  # type: ignore[no-untyped-def]
    """The bits of ``mask`` at the positions of subset z, packed."""
    packed = 0
    for i in range(subsets.shape[1]):
        if subsets[z, i] < 0:
            break
        packed |= (mask >> subsets[z, i] & 1) << i
    return packed


@kernel
def table_row(ahead):  # type: ignore[no-untyped-def]
    """Where ones − zeros is in the tables."""
    return min(max(ahead, -REACH), REACH) + REACH


@kernel
def count_in(first, last, tau, mended, label, facts, subsets, subset, count, sign):  # type: ignore[no-untyped-def]
    """Counts the rows of an observer who holds ``facts`` wrong; sign −1 takes them back."""
    for p in range(first, last):
        t = tau[p]
        count[t, packed(subsets, subset[t], facts) & ~mended[p], label[p]] += sign
