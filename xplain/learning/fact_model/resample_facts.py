"""The Gibbs step of the observers: the facts R that each holds wrong, given all others' answers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.learning.fact_model.counts import (
    ADDED,
    TAKEN,
    count_rows,
    draw,
    packed,
    table_row,
)
from xplain.numba_kernels import called, kernel

BLOCK = 8
"""Facts whose combinations are tried at once for an observer."""


class InUse(NamedTuple):
    """The customers at each table of the Chinese restaurant.

    Attributes:
        facts: [K + O] int64 fact sets in use; a sweep appends those that nobody held before.
        members: [K + O] int64 observers of each, maybe 0.
    """

    facts: NDArray[np.int64]
    members: NDArray[np.int64]

    @classmethod
    def of(cls, used: NDArray[np.int64], members: NDArray[np.int64], observers: int) -> InUse:
        """``used`` [K] and its ``members`` [K], with room for a type of each observer's own."""
        room = np.zeros((2, len(used) + observers), dtype=np.int64)
        room[0, : len(used)] = used
        room[1, : len(used)] = members
        return cls(room[0], room[1])


class FactScratch(NamedTuple):
    """Room for what is weighed for one observer; no value outlives it.

    Attributes:
        masks: [2^BLOCK] int64 fact sets to choose from.
        weights: [2^BLOCK] their log weights.
        by_cell: [2^depth] log-likelihood of the labels about one transition, by the facts of S_τ
            held wrong.
        pair: [2] int64 the fact set held, and one to jump to.
        values: [2] their log-likelihoods.
    """

    masks: NDArray[np.int64]
    weights: NDArray[np.float64]
    by_cell: NDArray[np.float64]
    pair: NDArray[np.int64]
    values: NDArray[np.float64]

    @classmethod
    def of(cls, n: int, depth: int) -> FactScratch:
        """For n messages, of which at most ``depth`` matter at a transition."""
        masks = 1 << min(n, BLOCK)
        return cls(
            masks=np.zeros(masks, dtype=np.int64),
            weights=np.zeros(masks),
            by_cell=np.zeros(1 << depth),
            pair=np.zeros(2, dtype=np.int64),
            values=np.zeros(2),
        )


@kernel
def resample_facts(answers, prior, state, in_use, number, log_new, temperature, rng, scratch):  # type: ignore[no-untyped-def]
    """Draws R of every observer among all fact sets; ``state.facts`` and ``state.counts`` follow.

    Where facts are more than BLOCK, an observer may first jump to a type in use, and draws BLOCK
    facts, chosen at random, anew (``state.order``).

    ``number`` fact sets are in use at first; ``log_new`` is the log weight of one that nobody
    holds, where each that somebody holds weighs log(observers).
    """
    order = state.order
    for o in range(len(state.facts)):
        count_rows(o, TAKEN, answers, prior, state)
        in_use.members[_find(in_use.facts, number, state.facts[o])] -= 1
        if len(order) > BLOCK:
            _jump(o, answers, prior, state, in_use, number, log_new, temperature, rng, scratch)
            for j in range(BLOCK):  # the first facts of a random order
                other = rng.integers(j, len(order))
                order[j], order[other] = order[other], order[j]
        number = _redraw(
            o, answers, prior, state, in_use, number, log_new, temperature, rng, scratch
        )


@called
def _redraw(o, answers, prior, state, in_use, number, log_new, temperature, rng, scratch):  # type: ignore[no-untyped-def]
    """Draws which of the first BLOCK facts of the order observer o, who has left, holds wrong;
    returns how many fact sets are then in use."""
    facts, masks, weights = state.facts, scratch.masks, scratch.weights
    width = min(len(state.order), BLOCK)
    _combine(facts[o], state.order, width, masks)
    _weigh_types(masks, state.order, width, in_use, number, log_new, weights)
    _add_log_likelihood(o, masks, answers, prior, state, scratch.by_cell, weights)
    chosen, _ = draw(weights, len(weights), temperature, rng)
    facts[o] = masks[chosen]
    at = _find(in_use.facts, number, facts[o])
    if at == number:
        in_use.facts[number] = facts[o]
        number += 1
    in_use.members[at] += 1
    count_rows(o, ADDED, answers, prior, state)
    return number


@called
def _find(facts, number, one):  # type: ignore[no-untyped-def]
    """Where ``one`` is among the first ``number``; ``number`` where it is not."""
    for k in range(number):
        if facts[k] == one:
            return k
    return number


@called
def _jump(o, answers, prior, state, in_use, number, log_new, temperature, rng, scratch):  # type: ignore[no-untyped-def]
    """Metropolis-Hastings: observer o takes R of a type in use. It is drawn from the prior (maybe
    a new type: then nothing is tried), so the likelihoods alone decide."""
    pair, values = scratch.pair, scratch.values
    n = len(state.order)
    left = rng.random() * (len(state.facts) - 1 + np.exp(log_new + n * np.log(2.0)))
    for k in range(number):
        left -= in_use.members[k]
        if left < 0:
            pair[0], pair[1] = state.facts[o], in_use.facts[k]
            values[0], values[1] = 0.0, 0.0
            _add_log_likelihood(o, pair, answers, prior, state, scratch.by_cell, values)
            if np.log(rng.random()) * temperature < values[1] - values[0]:
                state.facts[o] = pair[1]
            break


@called
def _combine(facts, order, width, masks):  # type: ignore[no-untyped-def]
    """Writes to ``masks`` [2^width] ``facts`` with the first ``width`` of ``order`` held wrong or
    not, in all ways."""
    rest = facts
    for j in range(width):
        rest &= ~(np.int64(1) << order[j])
    for i in range(len(masks)):
        mask = rest
        for j in range(width):
            mask |= np.int64(i >> j & 1) << order[j]
        masks[i] = mask


@called
def _weigh_types(masks, order, width, in_use, number, log_new, weights):  # type: ignore[no-untyped-def]
    """Writes to ``weights`` the log prior weight of each of ``masks``, by the Chinese restaurant
    process."""
    for i in range(len(masks)):
        weights[i] = np.exp(log_new)
    for k in range(number):
        if in_use.members[k] > 0:
            at = 0
            for j in range(width):
                at |= (in_use.facts[k] >> order[j] & 1) << j
            if masks[at] == in_use.facts[k]:
                weights[at] += in_use.members[k]
    for i in range(len(masks)):
        weights[i] = np.log(weights[i])


@called
def _add_log_likelihood(o, masks, answers, prior, state, by_cell, values):  # type: ignore[no-untyped-def]
    """Adds to ``values`` [masks]: log P(labels of observer o | R = mask, the labels counted).

    Rows of one transition are neighbours; all that R says about them is which of the few facts in
    S_τ it holds, so each such combination is tried once. Every row is counted before the next is
    predicted, and taken back. ``by_cell`` [2^depth] is overwritten.
    """
    transition, label, messages_given = answers.transition, answers.label, state.messages_given
    subsets, predictive, count = prior.subsets, prior.predictive, state.counts
    begin, last = answers.start[o], answers.start[o + 1]
    while begin < last:
        t = transition[begin]
        end = begin + 1
        while end < last and transition[end] == t:
            end += 1
        z, e = state.subset[t], state.noise[t]
        # Where no fact matters the labels say the same of every R.
        if prior.size[z] > 0:
            for held in range(1 << prior.size[z]):
                value = 0.0
                for p in range(begin, end):
                    c = held & ~messages_given[p]
                    lead = table_row(count[t, c, 1] - count[t, c, 0])
                    value += predictive[int(c == 0), e, lead, label[p]]
                    count[t, c, label[p]] += 1
                for p in range(begin, end):
                    count[t, held & ~messages_given[p], label[p]] -= 1
                by_cell[held] = value
            for i in range(len(masks)):
                values[i] += by_cell[packed(subsets, z, masks[i])]
        begin = end
