"""The sampler of :mod:`xplain.learning.fact_model.model`: its loops, compiled.

The arguments are the arrays that :class:`~xplain.learning.fact_model.model.Answers` and
:class:`~xplain.learning.fact_model.model.Tables` describe.
"""

from __future__ import annotations

import numpy as np

from xplain.learning.fact_model.counts import REACH, count_in, packed, table_row
from xplain.learning.fact_model.split_merge import CROWD, MOVES, join_types, move_type
from xplain.numba_kernels import kernel

BLOCK = 8
"""Facts whose combinations are tried at once for an observer."""
WIDE = 12
"""Up to so many facts every S_τ is tried at once; with more, those among so many facts: the ones
that matter now, and others at random."""

# The kernels below index arrays in full: a row taken out of an array is counted by numba, and that
# costs more than the work in the innermost loops.


@kernel
def _draw(log_weight, temperature, rng):  # type: ignore[no-untyped-def]
    """An index with probability ∝ exp(log weight / temperature), and the log of the sum of the
    weights themselves."""
    top = log_weight.max()
    total = 0.0
    heated = 0.0
    for w in log_weight:
        total += np.exp(w - top)
        heated += np.exp((w - top) / temperature)
    left = rng.random() * heated
    chosen = len(log_weight) - 1
    for i in range(len(log_weight)):
        left -= np.exp((log_weight[i] - top) / temperature)
        if left < 0:
            chosen = i
            break
    return chosen, top + np.log(total)


@kernel
def _block(subsets, z, n, rng):  # type: ignore[no-untyped-def]
    """The facts of subset z and others at random, WIDE in all, as a bitmask."""
    block = np.int64(0)
    size = 0
    while size < subsets.shape[1] and subsets[z, size] >= 0:
        block |= np.int64(1) << subsets[z, size]
        size += 1
    while size < WIDE:
        one = np.int64(1) << rng.integers(0, n)
        size += int(block & one == 0)
        block |= one
    return block


@kernel
def _among(subsets, block, out):  # type: ignore[no-untyped-def]
    """Writes to ``out`` the subsets of the facts in ``block``; how many."""
    size = 0
    for z in range(len(subsets)):
        inside = True
        for j in subsets[z]:
            if j >= 0 and block >> j & 1 == 0:
                inside = False
        if inside:
            out[size] = z
            size += 1
    return size


@kernel
def _weigh_subsets(  # type: ignore[no-untyped-def]
    masks, labels, subsets, among, log_subset, marginal, flip, log_noise, count, out
):
    """``out`` [len(among), E]: log joint of (S_τ, ε_τ) and the labels of one transition, given M,
    for the subsets ``among`` which S_τ is sought."""
    # Answers under the same M are counted once for all subsets.
    order = np.argsort(masks)
    distinct = np.empty(len(masks), dtype=np.int64)
    times = np.zeros((len(masks), 2), dtype=np.int64)
    size = 0
    for i in order:
        if size == 0 or distinct[size - 1] != masks[i]:
            distinct[size] = masks[i]
            size += 1
        times[size - 1, labels[i]] += 1
    for a in range(len(among)):
        z = among[a]
        count[:] = 0
        for i in range(size):
            c = packed(subsets, z, distinct[i])
            count[c, 0] += times[i, 0]
            count[c, 1] += times[i, 1]
        for e in range(len(log_noise)):
            value = log_subset[z] + log_noise[e]
            right, wrong = flip[e, 0], flip[e, 1]
            for c in range(len(count)):
                if count[c, 0] + count[c, 1] > 0:
                    ahead = count[c, 1] - count[c, 0]
                    value += count[c, 1] * right + count[c, 0] * wrong
                    value += marginal[int(c == 0), e, table_row(ahead)]
                    if ahead < -REACH:  # beyond the table it is a straight line
                        value += (ahead + REACH) * (wrong - right)
            out[a, e] = value


@kernel
def _weigh_facts(  # type: ignore[no-untyped-def]
    first, last, tau, mended, label, masks, subsets, subset, noise, count, table, local, values
):
    """Adds to ``values`` [masks]: log P(an observer's labels | R = mask, the answers counted).

    Rows of one transition are neighbours; all that R says about them is which of the few facts in
    S_τ it holds, so each such combination is tried once. Every row is counted before the next is
    predicted, and taken back. ``mended`` [P]: the facts of S_τ that were told, packed.
    """
    begin = first
    while begin < last:
        t = tau[begin]
        end = begin + 1
        while end < last and tau[end] == t:
            end += 1
        z = subset[t]
        size = 0
        while size < subsets.shape[1] and subsets[z, size] >= 0:
            size += 1
        # Where no fact matters the labels say the same of every R.
        if size > 0:
            for held in range(1 << size):
                value = 0.0
                for p in range(begin, end):
                    c = held & ~mended[p]
                    lead = table_row(count[t, c, 1] - count[t, c, 0])
                    value += table[int(c == 0), noise[t], lead, label[p]]
                    count[t, c, label[p]] += 1
                for p in range(begin, end):
                    count[t, held & ~mended[p], label[p]] -= 1
                local[held] = value
            for i in range(len(masks)):
                values[i] += local[packed(subsets, z, masks[i])]
        begin = end


@kernel
def run_chain(  # type: ignore[no-untyped-def]
    start,
    tau,
    given,
    label,
    owner,
    rows,
    tau_start,
    n,
    subsets,
    log_subset,
    log_block,
    predictive,
    marginal,
    flip,
    log_new,
    heated,
    heat,
    rng,
    facts,
    best,
    best_subset,
    best_noise,
    types,
):
    """Writes the best state to the arrays ``best``…, the number of types after each sweep to
    ``types``; returns the score of the best state."""
    observers = len(start) - 1
    transitions = len(tau_start) - 1
    levels = len(flip)
    width = min(n, BLOCK)
    block = np.arange(n)
    mended = np.empty(len(tau), dtype=np.int64)
    count = np.zeros((transitions, 1 << subsets.shape[1], 2), dtype=np.int64)
    scratch = np.zeros((1 << subsets.shape[1], 2), dtype=np.int64)
    among = np.arange(len(subsets))
    size = len(subsets)
    weights = np.empty((size, levels))
    subset = np.zeros(transitions, dtype=np.int64)
    noise = np.zeros(transitions, dtype=np.int64)
    log_noise = np.full(levels, -np.log(levels))
    choices = np.empty(1 << width)
    masks = np.empty(1 << width, dtype=np.int64)
    local = np.empty(1 << subsets.shape[1])
    pair = np.empty(2, dtype=np.int64)
    both = np.empty(2)
    best_score = -np.inf
    for sweep in range(len(types)):
        temperature = 1.0 + (heat - 1.0) * (1.0 - sweep / heated) if sweep < heated else 1.0
        # S and ε of each transition, given M of every answer.
        score = 0.0
        seen = np.full(levels, 0.02)
        for t in range(transitions):
            own = rows[tau_start[t] : tau_start[t + 1]]
            held = facts[owner[own]] & ~given[own]
            if n > WIDE:
                size = _among(subsets, _block(subsets, subset[t], n, rng), among)
            _weigh_subsets(
                held,
                label[own],
                subsets,
                among[:size],
                log_subset,
                marginal,
                flip,
                log_noise,
                scratch,
                weights,
            )
            if n > WIDE:
                # This block is likelier to be drawn from some S than from others: that counts.
                for a in range(size):
                    weights[a] += log_block[(subsets[among[a]] >= 0).sum()]
            chosen, total = _draw(weights[:size].ravel(), temperature, rng)
            subset[t] = among[chosen // levels]
            noise[t] = chosen % levels
            if n > WIDE:
                total = weights[chosen // levels, noise[t]]
                total -= log_block[(subsets[subset[t]] >= 0).sum()]
            score += total
            seen[noise[t]] += 1
            count[t] = 0
            for i in range(len(own)):
                count[t, packed(subsets, subset[t], held[i]), label[own[i]]] += 1
                mended[own[i]] = packed(subsets, subset[t], given[own[i]])
        log_noise = np.log(seen / seen.sum())
        # The types in use, and the score of the state.
        used = np.unique(facts)
        members = np.zeros(len(used) + observers, dtype=np.int64)
        kinds = np.zeros(len(members), dtype=np.int64)
        kinds[: len(used)] = used
        for o in range(observers):
            members[np.searchsorted(used, facts[o])] += 1
        number = len(used)
        for k in range(number):
            score += log_new
            for m in range(1, members[k]):
                score += np.log(m)
        # Types that differ only in facts that matter nowhere are one.
        alive = np.int64(0)
        for t in range(transitions):
            for j in subsets[subset[t]]:
                if j >= 0:
                    alive |= np.int64(1) << j
        types[sweep] = len(np.unique(facts & alive))
        if score > best_score:
            best_score = score
            best[:] = facts
            best_subset[:] = subset
            best_noise[:] = noise
        # R of each observer, given the answers of all others.
        for o in range(observers):
            first, last = start[o], start[o + 1]
            count_in(first, last, tau, mended, label, facts[o], subsets, subset, count, -1)
            for k in range(number):
                if kinds[k] == facts[o]:
                    members[k] -= 1
                    break
            if n > width:
                # Jump to a type in use; drawn from the prior, so the likelihoods alone decide.
                left = rng.random() * (observers - 1 + np.exp(log_new + n * np.log(2.0)))
                for k in range(number):
                    left -= members[k]
                    if left < 0:
                        pair[0], pair[1] = facts[o], kinds[k]
                        both[:] = 0.0
                        _weigh_facts(
                            first,
                            last,
                            tau,
                            mended,
                            label,
                            pair,
                            subsets,
                            subset,
                            noise,
                            count,
                            predictive,
                            local,
                            both,
                        )
                        if np.log(rng.random()) * temperature < both[1] - both[0]:
                            facts[o] = kinds[k]
                        break
                for j in range(width):  # the first facts of a random order
                    other = rng.integers(j, n)
                    block[j], block[other] = block[other], block[j]
            rest = facts[o]
            for j in range(width):
                rest &= ~(np.int64(1) << block[j])
            for i in range(1 << width):
                mask = rest
                for j in range(width):
                    mask |= np.int64(i >> j & 1) << block[j]
                masks[i] = mask
                choices[i] = np.exp(log_new)
            for k in range(number):
                if members[k] > 0:
                    at = 0
                    for j in range(width):
                        at |= (kinds[k] >> block[j] & 1) << j
                    if masks[at] == kinds[k]:
                        choices[at] += members[k]
            choices[:] = np.log(choices)
            _weigh_facts(
                first,
                last,
                tau,
                mended,
                label,
                masks,
                subsets,
                subset,
                noise,
                count,
                predictive,
                local,
                choices,
            )
            chosen, _ = _draw(choices, temperature, rng)
            facts[o] = masks[chosen]
            known = False
            for k in range(number):
                if kinds[k] == facts[o]:
                    members[k] += 1
                    known = True
                    break
            if not known:
                kinds[number] = facts[o]
                members[number] = 1
                number += 1
            count_in(first, last, tau, mended, label, facts[o], subsets, subset, count, 1)
        if observers >= CROWD:
            for _ in range(MOVES):
                move_type(
                    start,
                    tau,
                    mended,
                    label,
                    n,
                    subsets,
                    subset,
                    noise,
                    count,
                    marginal,
                    flip,
                    log_new,
                    temperature,
                    rng,
                    facts,
                )
    if observers >= CROWD:
        count[:] = 0
        for p in range(len(tau)):
            mended[p] = packed(subsets, best_subset[tau[p]], given[p])
        for o in range(observers):
            first, last = start[o], start[o + 1]
            count_in(first, last, tau, mended, label, best[o], subsets, best_subset, count, 1)
        best_score += join_types(
            start,
            tau,
            mended,
            label,
            subsets,
            best_subset,
            best_noise,
            count,
            marginal,
            flip,
            log_new,
            best,
        )
    return best_score
