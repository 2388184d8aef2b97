"""Moves of whole types, for the sampler among many observers.

Two types that answer alike become one by moves of one observer only in as many sweeps as they have
observers.
"""

from __future__ import annotations

from math import lgamma

import numpy as np

from xplain.learning.fact_model.counts import REACH, count_in, table_row
from xplain.numba_kernels import kernel

CROWD = 100
"""Observers from which types are moved whole too."""
MOVES = 20
"""So many of these moves are tried in a sweep."""


@kernel
def _evidence(count, noise, marginal, flip):  # type: ignore[no-untyped-def]
    """log P(all labels | M of every answer, S, ε)."""
    total = 0.0
    for t in range(len(count)):
        for c in range(count.shape[1]):
            zeros, ones = count[t, c, 0], count[t, c, 1]
            if zeros + ones > 0:
                right, wrong = flip[noise[t], 0], flip[noise[t], 1]
                total += ones * right + zeros * wrong
                total += marginal[int(c == 0), noise[t], table_row(ones - zeros)]
                if ones - zeros < -REACH:
                    total += (ones - zeros + REACH) * (wrong - right)
    return total


@kernel
def _log_ways(whole, part):  # type: ignore[no-untyped-def]
    """log of the ways to choose a part of 1 … whole − 1, all sizes equally likely."""
    choose = lgamma(whole + 1.0) - lgamma(part + 1.0) - lgamma(whole - part + 1.0)
    return np.log(whole - 1.0) + choose


@kernel
def _go_over(members, new, start, tau, mended, label, subsets, subset, count, facts):  # type: ignore[no-untyped-def]
    for o in members:
        first, last = start[o], start[o + 1]
        count_in(first, last, tau, mended, label, facts[o], subsets, subset, count, -1)
        facts[o] = new
        count_in(first, last, tau, mended, label, new, subsets, subset, count, 1)


@kernel
def move_type(  # type: ignore[no-untyped-def]
    start, tau, mended, label, n, subsets, subset, noise, count, marginal, flip, log_new,
    temperature, rng, facts
):  # fmt: skip
    """Metropolis-Hastings: all of a type take the fact set of another, or a part of it, of random
    size, takes one that nobody holds."""
    used = np.unique(facts)
    number = len(used)
    a = rng.integers(0, number)
    old = used[a]
    members = np.flatnonzero(facts == old)
    size = len(members)
    urn = np.exp(log_new)  # Pólya's, with a colour a fact set
    if rng.random() < 0.5:
        if number == 1:
            return
        new = used[(a + rng.integers(1, number)) % number]
        others = (facts == new).sum()
        whole = size + others
        change = lgamma(whole + urn) + lgamma(urn) - lgamma(size + urn) - lgamma(others + urn)
        back = np.log(number) - n * np.log(2.0) - _log_ways(whole, size)
    else:
        new = rng.integers(0, np.int64(1) << n)
        if size == 1 or (facts == new).any():
            return
        part = rng.integers(1, size)
        change = lgamma(part + urn) + lgamma(size - part + urn) - lgamma(size + urn) - lgamma(urn)
        back = _log_ways(size, part) + n * np.log(2.0) - np.log(number + 1.0)
        rng.shuffle(members)
        members = members[:part]
    change -= _evidence(count, noise, marginal, flip)
    _go_over(members, new, start, tau, mended, label, subsets, subset, count, facts)
    change += _evidence(count, noise, marginal, flip)
    if np.log(rng.random()) >= change / temperature + back:
        _go_over(members, old, start, tau, mended, label, subsets, subset, count, facts)


@kernel
def join_types(  # type: ignore[no-untyped-def]
    start, tau, mended, label, subsets, subset, noise, count, marginal, flip, log_new, facts
):
    """Lets a type take the fact set of another wherever that makes the state likelier; by how much
    all of it does (log)."""
    gained = 0.0
    urn = np.exp(log_new)
    used = np.unique(facts)
    for old in used:
        members = np.flatnonzero(facts == old)
        for new in used:
            others = (facts == new).sum()
            if new == old or others == 0:
                continue
            size = len(members)
            change = lgamma(size + others + urn) - lgamma(others + urn)
            change += lgamma(urn) - lgamma(size + urn)
            change -= _evidence(count, noise, marginal, flip)
            _go_over(members, new, start, tau, mended, label, subsets, subset, count, facts)
            change += _evidence(count, noise, marginal, flip)
            if change > 0:
                gained += change
                break
            _go_over(members, old, start, tau, mended, label, subsets, subset, count, facts)
    return gained
