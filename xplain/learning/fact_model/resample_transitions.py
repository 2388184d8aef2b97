"""The Gibbs step of the transitions: S_τ and ε_τ of each, given everybody's facts held wrong.

The kernels index arrays in full: a row taken out of an array is counted by numba, and that costs
more than the work in the innermost loops.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.learning.fact_model.counts import REACH, draw, packed, table_row
from xplain.numba_kernels import called, kernel

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


@called
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


@called
def _random_block(prior, z, n, rng):  # type: ignore[no-untyped-def]
    """The facts of subset z and others at random, WIDE in all, as a bitmask."""
    block = prior.members[z]
    size = prior.size[z]
    while size < WIDE:
        one = np.int64(1) << rng.integers(0, n)
        size += int(block & one == 0)
        block |= one
    return block


@called
def _within(members, block, out):  # type: ignore[no-untyped-def]
    """Writes to ``out`` the subsets of the facts in ``block``; how many."""
    size = 0
    for z in range(len(members)):
        if members[z] & ~block == 0:
            out[size] = z
            size += 1
    return size


@called
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


@called
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


@called
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
