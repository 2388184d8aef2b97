"""Split–merge moves, for the sampler among many observers.

After Jain & Neal (2004), "A split-merge Markov chain Monte Carlo procedure for the Dirichlet
process mixture model", in its plain form: who is split off is drawn at random, without Gibbs scans
in between. Without such moves two types that answer alike become one, observer by observer, only in
as many sweeps as they have observers.
"""

from __future__ import annotations

from math import exp, lgamma, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.learning.fact_model.counts import ADDED, REACH, TAKEN, count_rows, table_row
from xplain.learning.fact_model.model import ChainState, Prior, SortedLabels
from xplain.numba_kernels import kernel

MANY_OBSERVERS = 100
"""Observers from which types are moved whole too."""
MOVES = 20
"""So many of these moves are tried in a sweep."""


class Move(NamedTuple):
    """Observers who may take another fact set.

    Attributes:
        members: their indices.
        old, new: the fact set they all hold, and the one they may take.
        log_prior: log of the ratio of the prior probabilities after and before.
        log_proposal: log of the ratio of the probabilities to propose the way back, and this.
    """

    members: NDArray[np.int64]
    old: int
    new: int
    log_prior: float
    log_proposal: float


def split_merge(
    answers: SortedLabels,
    prior: Prior,
    state: ChainState,
    log_new: float,
    temperature: float,
    rng: np.random.Generator,
) -> None:
    """Tries MOVES moves by Metropolis-Hastings; ``state`` is overwritten.

    Args:
        answers, prior, state: of the sampler.
        log_new: log weight of a fact set that nobody holds, in the Chinese restaurant process.
        temperature: of the target.
        rng: the chain's stream.
    """
    before = _log_likelihood(prior, state)
    for _ in range(MOVES):
        move = _propose(state.facts, answers.n_messages, exp(log_new), rng)
        if move is None:
            continue
        count = state.counts.copy()
        relabel(move.members, move.new, answers, prior, state)
        after = _log_likelihood(prior, state)
        gain = move.log_prior - before + after
        if log(rng.random()) < gain / temperature + move.log_proposal:
            before = after
        else:
            state.facts[move.members] = move.old
            state.counts[:] = count


def merge_types(answers: SortedLabels, prior: Prior, state: ChainState, log_new: float) -> float:
    """Lets a type take the fact set of another wherever that makes ``state`` likelier.

    Returns:
        By how much all of it does (log).
    """
    gained, urn, facts = 0.0, exp(log_new), state.facts
    before = _log_likelihood(prior, state)
    used = np.unique(facts)
    for old in used:
        members = np.flatnonzero(facts == old)
        size = len(members)
        for new in used:
            others = int((facts == new).sum())
            if new == old or others == 0:
                continue
            count = state.counts.copy()
            relabel(members, new, answers, prior, state)
            after = _log_likelihood(prior, state)
            change = _log_merged(size, others, urn) - before + after
            if change > 0:
                gained += change
                before = after
                break
            facts[members] = old
            state.counts[:] = count
    return gained


def _propose(facts: NDArray[np.int64], n: int, urn: float, rng: np.random.Generator) -> Move | None:
    """A merge, by which all of a type take the fact set of another, or a split, by which a part of
    it, of random size, takes one that nobody holds. None: there is no such type or part."""
    used = np.unique(facts)
    a = rng.integers(0, len(used))
    old = int(used[a])
    members = np.flatnonzero(facts == old)
    size = len(members)
    if rng.random() < 0.5:
        if len(used) == 1:
            return None
        new = int(used[(a + rng.integers(1, len(used))) % len(used)])
        others = int((facts == new).sum())
        back = log(len(used)) - n * log(2) - _log_ways(size + others, size)
        return Move(members, old, new, _log_merged(size, others, urn), back)
    new = int(rng.integers(0, 1 << n))
    if size == 1 or (facts == new).any():
        return None
    part = int(rng.integers(1, size))
    rng.shuffle(members)
    back = _log_ways(size, part) + n * log(2) - log(len(used) + 1)
    return Move(members[:part], old, new, -_log_merged(part, size - part, urn), back)


def _log_merged(size: int, others: int, urn: float) -> float:
    """log P(one type) − log P(two) of Pólya's urn, with ``urn`` balls of the colour of each fact
    set at first."""
    return lgamma(size + others + urn) + lgamma(urn) - lgamma(size + urn) - lgamma(others + urn)


def _log_ways(whole: int, part: int) -> float:
    """log of the ways to choose a part of 1 … whole − 1, all sizes equally likely."""
    choose = lgamma(whole + 1) - lgamma(part + 1) - lgamma(whole - part + 1)
    return log(whole - 1) + choose


def _log_likelihood(prior: Prior, state: ChainState) -> float:
    return float(log_likelihood(state.counts, state.noise, prior.marginal, prior.log_flip))


@kernel
def log_likelihood(count, noise, marginal, log_flip):  # type: ignore[no-untyped-def]
    """log P(all labels | M of every answer, S, ε), f integrated out."""
    total = 0.0
    for t in range(len(count)):
        right, wrong = log_flip[noise[t], 0], log_flip[noise[t], 1]
        for c in range(count.shape[1]):
            zeros, ones = count[t, c, 0], count[t, c, 1]
            if zeros + ones > 0:
                total += ones * right + zeros * wrong
                total += marginal[int(c == 0), noise[t], table_row(ones - zeros)]
                if ones - zeros < -REACH:
                    total += (ones - zeros + REACH) * (wrong - right)
    return total


@kernel
def relabel(members, new, answers, prior, state):  # type: ignore[no-untyped-def]
    """Gives the observers ``members`` the fact set ``new``; ``state.counts`` follows."""
    for o in members:
        count_rows(o, TAKEN, answers, prior, state)
        state.facts[o] = new
        count_rows(o, ADDED, answers, prior, state)
