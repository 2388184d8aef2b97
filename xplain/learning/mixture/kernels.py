"""The compiled steps of the sampler: (S_τ, ε_τ) of each transition given everybody's facts held
wrong, and the facts R that each observer holds wrong given all others' answers.

A cell of transition τ is one value of M ∩ S_τ (see :mod:`xplain.learning.mixture.sampler`), its
facts packed into the lowest bits of an integer. The kernels index arrays in full: a row taken out
of an array is counted by numba, and that costs more than the work in the innermost loops.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from xplain.numba_kernels import kernel

REACH = 64
"""Ones − zeros beyond which a cell's value is beyond doubt."""
ADDED, TAKEN = np.int64(1), np.int64(-1)
"""Signs of labels that are counted, and counted no longer."""


@njit(nogil=True)
def packed(subsets, z, mask):  # type: ignore[no-untyped-def]
    """The bits of ``mask`` at the positions of subset z, packed."""
    packed = 0
    for i in range(subsets.shape[1]):
        if subsets[z, i] < 0:
            break
        packed |= (mask >> subsets[z, i] & 1) << i
    return packed


@njit(nogil=True)
def table_row(ahead):  # type: ignore[no-untyped-def]
    """Where ones − zeros is in the tables of :class:`~xplain.learning.mixture.sampler.Prior`."""
    return min(max(ahead, -REACH), REACH) + REACH


@njit(nogil=True)
def count_rows(o, sign, answers, prior, state):  # type: ignore[no-untyped-def]
    """Counts the labels of observer ``o``, of R = ``state.facts[o]``, in ``state.counts``: ADDED
    or TAKEN."""
    transition, label, given = answers.transition, answers.label, state.messages_given
    subset, subsets, count = state.subset, prior.subsets, state.counts
    facts = state.facts[o]
    for p in range(answers.start[o], answers.start[o + 1]):
        t = transition[p]
        count[t, packed(subsets, subset[t], facts) & ~given[p], label[p]] += sign


@njit(nogil=True)
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


WIDE = 12
"""Up to so many facts every S_τ is tried at once; with more, those among so many facts: the ones
that matter now, and others at random."""
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: multiplied by it, keys spread over the table (Fibonacci hashing)."""


class TransitionScratch(NamedTuple):
    """Room for the answers about one transition and for what is weighed; no value outlives it.

    Up to A answers are about one transition; Z subsets, E levels of noise.

    Attributes:
        wrong: [A] int64 each M that occurs.
        times: [A, 2] int64 its labels 0 and 1.
        slots: [2^b ≥ 2 A] int64 a hash table of indices into ``wrong``; −1 free, as all are
            between transitions.
        where: [A] int64 the slot of each M.
        cell: [A] int64 the cell of each M, of the subset that is being weighed.
        cells: [2^depth, 4] int64 of each cell that occurs, labels 0 and 1, and where it is in
            ``marginal``: first and last index.
        candidates: [Z] int64 subsets that are weighed.
        weights: [Z · E] log joint of each candidate and ε with the labels.
    """

    wrong: NDArray[np.int64]
    times: NDArray[np.int64]
    slots: NDArray[np.int64]
    where: NDArray[np.int64]
    cell: NDArray[np.int64]
    cells: NDArray[np.int64]
    candidates: NDArray[np.int64]
    weights: NDArray[np.float64]

    @classmethod
    def of(
        cls, transition_start: NDArray[np.int64], subsets: int, depth: int, levels: int
    ) -> TransitionScratch:
        """For transitions whose answers begin at ``transition_start`` [T + 1]."""
        answers = int(np.diff(transition_start).max(initial=1))
        wrong, where, cell = np.zeros((3, answers), dtype=np.int64)
        return cls(
            wrong=wrong,
            times=np.zeros((answers, 2), dtype=np.int64),
            slots=np.full(1 << (2 * answers - 1).bit_length(), -1),
            where=where,
            cell=cell,
            cells=np.zeros((1 << depth, 4), dtype=np.int64),
            candidates=np.arange(subsets),
            weights=np.zeros(subsets * levels),
        )


@kernel
def resample_transitions(answers, prior, state, held, temperature, rng, scratch):  # type: ignore[no-untyped-def]
    """Draws (S_τ, ε_τ) of every transition, and counts the labels by the cells that this makes.

    ``held`` [P] is M of each answer. Returns log P(all labels | everybody's R), f integrated out, S
    and ε summed out; where messages are more than WIDE each S_τ is drawn among the subsets of WIDE
    facts only, and it is log P(all labels, S and ε as drawn | everybody's R).
    """
    candidates, weights = scratch.candidates, scratch.weights
    levels, size, n = len(state.log_noise), len(prior.size), answers.n_messages
    score = 0.0
    for t in range(len(state.subset)):
        distinct = _tally(t, answers, held, scratch)
        if n > WIDE:
            block = _random_block(prior, state.subset[t], n, rng)
            size = _within(prior.members, block, candidates)
        _weigh(size, distinct, prior, state.log_noise, scratch)
        if n > WIDE:  # this block is likelier to be drawn from some S than from others: that counts
            for i in range(size * levels):
                weights[i] += prior.log_block[prior.size[candidates[i // levels]]]
        chosen, total = draw(weights, size * levels, temperature, rng)
        z = candidates[chosen // levels]
        score += weights[chosen] - prior.log_block[prior.size[z]] if n > WIDE else total
        _choose(t, z, chosen % levels, held, answers, prior.subsets, state)
    _set_shares(state.noise, state.log_noise)
    return score


@njit(nogil=True)
def _tally(t, answers, held, scratch):  # type: ignore[no-untyped-def]
    """Counts the answers about transition t by M, once for all subsets; how many M occur."""
    rows, label = answers.rows, answers.label
    wrong, times, slots, where = scratch.wrong, scratch.times, scratch.slots, scratch.where
    shift = np.uint64(64)
    room = len(slots)
    while room > 1:
        room >>= 1
        shift -= np.uint64(1)
    number = 0
    for i in range(answers.transition_start[t], answers.transition_start[t + 1]):
        mask = held[rows[i]]
        at = np.int64((np.uint64(mask) * GOLDEN) >> shift)
        while slots[at] >= 0 and wrong[slots[at]] != mask:
            at = (at + 1) & (len(slots) - 1)
        if slots[at] < 0:
            slots[at] = number
            where[number] = at
            wrong[number] = mask
            times[number, 0] = 0
            times[number, 1] = 0
            number += 1
        times[slots[at], label[rows[i]]] += 1
    for i in range(number):
        slots[where[i]] = -1
    return number


@njit(nogil=True)
def _random_block(prior, z, n, rng):  # type: ignore[no-untyped-def]
    """The facts of subset z and others at random, WIDE in all, as a bitmask."""
    block = prior.members[z]
    size = prior.size[z]
    while size < WIDE:
        one = np.int64(1) << rng.integers(0, n)
        size += int(block & one == 0)
        block |= one
    return block


@njit(nogil=True)
def _within(members, block, out):  # type: ignore[no-untyped-def]
    """Writes to ``out`` the subsets of the facts in ``block``; how many."""
    size = 0
    for z in range(len(members)):
        if members[z] & ~block == 0:
            out[size] = z
            size += 1
    return size


@njit(nogil=True)
def _weigh(size, distinct, prior, log_noise, scratch):  # type: ignore[no-untyped-def]
    """Writes to ``scratch.weights`` [size · E] the log joint of (S_τ, ε_τ) and the labels, given
    the ``distinct`` M of all answers, for the first ``size`` candidates which S_τ is sought."""
    wrong, times, cell, cells = scratch.wrong, scratch.times, scratch.cell, scratch.cells
    candidates, weights = scratch.candidates, scratch.weights
    subsets, sizes, log_subset = prior.subsets, prior.size, prior.log_subset
    log_flip, marginal = prior.log_flip, prior.marginal
    at = 0
    for a in range(size):
        z = candidates[a]
        for c in range(1 << sizes[z]):
            cells[c, 0] = 0
            cells[c, 1] = 0
        for i in range(distinct):
            cell[i] = 0
        for j in range(sizes[z]):  # packed(), of all M at once
            fact = subsets[z, j]
            for i in range(distinct):
                cell[i] |= (wrong[i] >> fact & 1) << j
        for i in range(distinct):
            cells[cell[i], 0] += times[i, 0]
            cells[cell[i], 1] += times[i, 1]
        used = 0
        for c in range(1 << sizes[z]):
            zeros, ones = cells[c, 0], cells[c, 1]
            if zeros + ones > 0:  # moved to the front: c ≥ used
                cells[used, 0], cells[used, 1] = zeros, ones
                cells[used, 2], cells[used, 3] = int(c == 0), table_row(ones - zeros)
                used += 1
        for e in range(len(log_flip)):
            value = log_subset[z] + log_noise[e]
            right, false = log_flip[e, 0], log_flip[e, 1]
            for c in range(used):
                zeros, ones = cells[c, 0], cells[c, 1]
                value += ones * right + zeros * false
                value += marginal[cells[c, 2], e, cells[c, 3]]
                if ones - zeros < -REACH:  # beyond the table it is a straight line
                    value += (ones - zeros + REACH) * (false - right)
            weights[at] = value
            at += 1


@njit(nogil=True)
def _choose(t, z, e, held, answers, subsets, state):  # type: ignore[no-untyped-def]
    """Sets S_τ to subset z and ε_τ to level e, and counts the labels by cell."""
    rows, label, given = answers.rows, answers.label, answers.message_set
    counts, messages_given = state.counts, state.messages_given
    state.subset[t] = z
    state.noise[t] = e
    for c in range(counts.shape[1]):
        counts[t, c, 0] = 0
        counts[t, c, 1] = 0
    for i in range(answers.transition_start[t], answers.transition_start[t + 1]):
        p = rows[i]
        counts[t, packed(subsets, z, held[p]), label[p]] += 1
        messages_given[p] = packed(subsets, z, given[p])


@njit(nogil=True)
def _set_shares(noise, log_noise):  # type: ignore[no-untyped-def]
    """Sets ``log_noise`` [E] to the log shares of the levels among ``noise`` [T], smoothed."""
    for e in range(len(log_noise)):
        log_noise[e] = 0.02
    for t in range(len(noise)):
        log_noise[noise[t]] += 1.0
    total = 0.0
    for e in range(len(log_noise)):
        total += log_noise[e]
    for e in range(len(log_noise)):
        log_noise[e] = np.log(log_noise[e] / total)


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


@njit(nogil=True)
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


@njit(nogil=True)
def _find(facts, number, one):  # type: ignore[no-untyped-def]
    """Where ``one`` is among the first ``number``; ``number`` where it is not."""
    for k in range(number):
        if facts[k] == one:
            return k
    return number


@njit(nogil=True)
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


@njit(nogil=True)
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


@njit(nogil=True)
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


@njit(nogil=True)
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
