"""The compiled steps of the sampler (:mod:`xplain.learning.mixture.sampler`).

One step draws (S_τ, ε_τ) of each transition τ: the few facts that matter at τ, and the probability
that a label is flipped. It is given the facts R that each observer believes incorrectly. The other
step draws R of each observer, given the answers of all other observers.

M is the set of facts that an observer with messages H still believes incorrectly, R without H. All
labels of τ with the same M ∩ S_τ are a *cell*: without errors they are equal. The index of a cell
is M ∩ S_τ, packed into the lowest bits of an integer. Subset z is row z of
:attr:`~xplain.learning.mixture.sampler.Prior.subsets`, the possible S_τ.

The kernels index arrays with all indices: if a row is taken out of an array, numba counts the
references to the row, and this takes longer than the inner loops.
"""

import numpy as np

from xplain.numba_kernels import inner, kernel, part

REACH = 64
"""Largest |ones − zeros| in the tables; beyond it, the label of a cell is certain."""


@inner
def pack(subsets, z, mask):  # type: ignore[no-untyped-def]
    """Returns an integer whose bit i is the bit of ``mask`` for the i-th fact of subset z."""
    packed = 0
    for i in range(subsets.shape[1]):
        if subsets[z, i] < 0:
            break
        packed |= (mask >> subsets[z, i] & 1) << i
    return packed


@inner
def table_row(ahead):  # type: ignore[no-untyped-def]
    """Returns the row of the tables of :class:`~xplain.learning.mixture.sampler.Prior` for
    ``ahead``, the number of labels 1 minus the number of labels 0 in a cell."""
    return min(max(ahead, -REACH), REACH) + REACH


@part
def log_cell_of(zeros, ones, c, e, prior):  # type: ignore[no-untyped-def]
    """Computes :func:`~xplain.learning.mixture.likelihood.log_cell` for cell c with ``zeros``
    labels 0 and ``ones`` labels 1, at level e of ε."""
    right, false, ahead = prior.log_flip[e, 0], prior.log_flip[e, 1], ones - zeros
    value = ones * right + zeros * false + prior.marginal[int(c == 0), e, table_row(ahead)]
    if ahead < -REACH:  # linear beyond the table
        value += (ahead + REACH) * (false - right)
    return value


@inner
def count_rows(o, sign, answers, prior, state):  # type: ignore[no-untyped-def]
    """Adds the labels of observer ``o`` to the counts of their cells in ``state.counts``
    (``sign`` 1), or removes them (``sign`` −1). The cells follow from ``state.facts[o]``, the
    observer's R."""
    transition, label, given = answers.transition, answers.label, state.messages_given
    subset, subsets, count = state.subset, prior.subsets, state.counts
    facts = state.facts[o]
    for p in range(answers.start[o], answers.start[o + 1]):
        t = transition[p]
        count[t, pack(subsets, subset[t], facts) & ~given[p], label[p]] += sign


@inner
def draw(log_weight, size, temperature, rng):  # type: ignore[no-untyped-def]
    """Draws an index below ``size`` with probability ∝ exp(log weight / temperature). Returns the
    index, and the log of the sum of the weights at temperature 1."""
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
"""If there are at most this number of facts, every S_τ is tried. Otherwise S_τ is drawn among the
subsets of this number of facts: its current facts and random other facts."""


@kernel
def resample_subsets(answers, prior, state, held, temperature, rng):  # type: ignore[no-untyped-def]
    """Draws (S_τ, ε_τ) of every transition, and counts the labels by the new cells. ``held`` [P] is
    M of the observer of each label.

    Returns log P(all labels | everybody's R), with f integrated out and S and ε summed out. For
    more than WIDE messages each S_τ is drawn among the subsets of WIDE facts only; the result is
    then log P(all labels, the drawn S and ε | everybody's R).
    """
    levels, size, n = len(state.log_noise), len(prior.size), answers.n_messages
    block, candidates, weights = (1 << n) - 1, np.arange(size), np.empty(size * levels)
    number = np.full(1 << min(n, WIDE), -1)  # number of each M, by its facts in the block
    wrong, times = np.empty(len(number), np.int64), np.empty((len(number), 2), np.int64)
    cell, cells = np.empty(len(number), np.int64), np.empty((state.counts.shape[1], 4), np.int64)
    score = 0.0
    for t in range(len(state.subset)):
        if n > WIDE:
            block = _draw_block(prior, state.subset[t], n, rng)
            size = _list_subsets(prior.members, block, candidates)
        distinct = _count_answers(t, answers, held, block, number, wrong, times)
        _weigh_subsets(
            candidates[:size], wrong[:distinct], times, prior, state, cell, cells, weights
        )
        if n > WIDE:  # the probability to draw this block depends on S
            for i in range(size * levels):
                weights[i] += prior.log_block[prior.size[candidates[i // levels]]]
        chosen, total = draw(weights, size * levels, temperature, rng)
        z = candidates[chosen // levels]
        score += weights[chosen] - prior.log_block[prior.size[z]] if n > WIDE else total
        _set_subset(t, z, chosen % levels, held, answers, prior.subsets, state)
    return score


@inner
def _count_answers(t, answers, held, block, number, wrong, times):  # type: ignore[no-untyped-def]
    """Counts the labels of transition t by M. The counts can be used for every S_τ within
    ``block``, a bitmask of facts.

    Two sets M with the same facts of ``block`` are not distinguished. ``wrong`` receives one M of
    each kind; ``times`` receives its numbers of labels 0 and 1. Returns the number of kinds. Each
    entry of ``number`` is −1 before the call and after it.
    """
    rows, distinct = answers.rows, 0
    for i in range(answers.transition_start[t], answers.transition_start[t + 1]):
        mask = held[rows[i]]
        at = _pack_block(block, mask, answers.n_messages)
        if number[at] < 0:
            number[at] = distinct
            wrong[distinct] = mask
            times[distinct, 0] = 0
            times[distinct, 1] = 0
            distinct += 1
        times[number[at], answers.label[rows[i]]] += 1
    for i in range(distinct):
        number[_pack_block(block, wrong[i], answers.n_messages)] = -1
    return distinct


@inner
def _pack_block(block, mask, n):  # type: ignore[no-untyped-def]
    """Returns an integer whose bit i is the bit of ``mask`` for the i-th fact of ``block``, a
    bitmask."""
    packed, size = 0, 0
    for j in range(n):
        if block >> j & 1:
            packed |= (mask >> j & 1) << size
            size += 1
    return packed


@inner
def _draw_block(prior, z, n, rng):  # type: ignore[no-untyped-def]
    """Draws a bitmask of WIDE facts: the facts of subset z, and random other facts."""
    block = prior.members[z]
    size = prior.size[z]
    while size < WIDE:
        one = np.int64(1) << np.int64(rng.random() * n)
        size += int(block & one == 0)
        block |= one
    return block


@inner
def _list_subsets(members, block, out):  # type: ignore[no-untyped-def]
    """Writes the index of each subset that has only facts of ``block`` to ``out``. Returns the
    number of these subsets."""
    size = 0
    for z in range(len(members)):
        if members[z] & ~block == 0:
            out[size] = z
            size += 1
    return size


@inner
def _weigh_subsets(candidates, wrong, times, prior, state, cell, cells, weights):  # type: ignore[no-untyped-def]
    """Writes the log joint probability of (S_τ, ε_τ) and the labels of τ to ``weights``, for each
    candidate S_τ and each level of ε.

    ``wrong`` and ``times`` are the results of :func:`_count_answers`. ``cell`` and ``cells`` are
    working memory and are overwritten.
    """
    subsets, sizes, levels = prior.subsets, prior.size, len(state.log_noise)
    for a in range(len(candidates)):
        z = candidates[a]
        for c in range(1 << sizes[z]):
            cells[c, 0] = 0
            cells[c, 1] = 0
        for i in range(len(wrong)):
            cell[i] = 0
        for j in range(sizes[z]):  # as pack(), for all M at once
            fact = subsets[z, j]
            for i in range(len(wrong)):
                cell[i] |= (wrong[i] >> fact & 1) << j
        for i in range(len(wrong)):
            cells[cell[i], 0] += times[i, 0]
            cells[cell[i], 1] += times[i, 1]
        used = 0
        for c in range(1 << sizes[z]):
            if cells[c, 0] + cells[c, 1] > 0:  # moved to the front: c ≥ used
                cells[used, 0], cells[used, 1], cells[used, 2] = cells[c, 0], cells[c, 1], c
                used += 1
        for e in range(levels):
            value = prior.log_subset[z] + state.log_noise[e]
            for i in range(used):
                value += log_cell_of(cells[i, 0], cells[i, 1], cells[i, 2], e, prior)
            weights[a * levels + e] = value


@inner
def _set_subset(t, z, e, held, answers, subsets, state):  # type: ignore[no-untyped-def]
    """Sets S_τ to subset z and ε_τ to level e, and counts the labels by cell."""
    rows, label, given = answers.rows, answers.label, answers.message_set
    counts, messages_given = state.counts, state.messages_given
    state.subset[t] = z
    state.noise[t] = e
    counts[t] = 0
    for i in range(answers.transition_start[t], answers.transition_start[t + 1]):
        p = rows[i]
        counts[t, pack(subsets, z, held[p]), label[p]] += 1
        messages_given[p] = pack(subsets, z, given[p])


BLOCK = 8
"""Number of facts whose combinations are tried together for an observer."""


@kernel
def resample_facts(answers, prior, state, used, members, number, log_new, temperature, rng):  # type: ignore[no-untyped-def]
    """Draws R of every observer among all fact sets, and updates ``state.facts`` and
    ``state.counts``.

    For more than BLOCK facts, an observer may first change to the fact set of a type in use. Then
    the bits of BLOCK random facts in R are drawn again (``state.order`` has the facts in random
    order).

    The first ``number`` entries of ``used`` [K + O] are the fact sets in use, the tables of the
    Chinese restaurant process; ``members`` counts the observers of each. New fact sets are
    appended. ``log_new`` is the log weight of a fact set without observers; the log weight of a
    fact set with observers is the log of their number.
    """
    facts, order = state.facts, state.order
    width = min(len(order), BLOCK)
    masks, weights = np.empty(1 << width, np.int64), np.empty(1 << width)
    by_cell = np.empty(state.counts.shape[1])
    pair, values = np.empty(2, np.int64), np.empty(2)
    for o in range(len(facts)):
        count_rows(o, -1, answers, prior, state)
        members[_find_facts(used, number, facts[o])] -= 1
        if len(order) > BLOCK:
            k = _draw_type(members, number, np.exp(log_new + len(order) * np.log(2.0)), rng)
            if k < number:  # Metropolis-Hastings: drawn from the prior, so the likelihoods decide
                pair[0], pair[1] = facts[o], used[k]
                values[0], values[1] = 0.0, 0.0
                _add_log_likelihood(o, pair, answers, prior, state, by_cell, values)
                if np.log(rng.random()) * temperature < values[1] - values[0]:
                    facts[o] = pair[1]
            for j in range(BLOCK):  # the first facts of a random order
                other = j + np.int64(rng.random() * (len(order) - j))
                order[j], order[other] = order[other], order[j]
        _list_combinations(facts[o], order, width, masks)
        _weigh_types(masks, order, width, used, members, number, log_new, weights)
        _add_log_likelihood(o, masks, answers, prior, state, by_cell, weights)
        facts[o] = masks[draw(weights, len(weights), temperature, rng)[0]]
        at = _find_facts(used, number, facts[o])
        if at == number:
            used[number] = facts[o]
            number += 1
        members[at] += 1
        count_rows(o, 1, answers, prior, state)


@inner
def _find_facts(facts, number, one):  # type: ignore[no-untyped-def]
    """Returns the index of the fact set ``one`` among the first ``number`` entries of ``facts``;
    ``number`` if it is missing."""
    for k in range(number):
        if facts[k] == one:
            return k
    return number


@inner
def _draw_type(members, number, new, rng):  # type: ignore[no-untyped-def]
    """Draws a type in use, with a probability in proportion to its ``members``. Returns ``number``
    for a new type, whose weight is ``new``."""
    total = new
    for k in range(number):
        total += members[k]
    left = rng.random() * total
    for k in range(number):
        left -= members[k]
        if left < 0:
            return k
    return number


@inner
def _list_combinations(facts, order, width, masks):  # type: ignore[no-untyped-def]
    """Writes 2^width fact sets to ``masks``. They are all sets that differ from the set ``facts``
    at most in the first ``width`` facts of ``order``."""
    rest = facts
    for j in range(width):
        rest &= ~(np.int64(1) << order[j])
    for i in range(len(masks)):
        mask = rest
        for j in range(width):
            mask |= np.int64(i >> j & 1) << order[j]
        masks[i] = mask


@inner
def _weigh_types(masks, order, width, used, members, number, log_new, weights):  # type: ignore[no-untyped-def]
    """Writes to ``weights`` the log prior weight of each fact set of ``masks`` under the Chinese
    restaurant process."""
    for i in range(len(masks)):
        weights[i] = np.exp(log_new)
    for k in range(number):
        if members[k] > 0:
            at = 0
            for j in range(width):
                at |= (used[k] >> order[j] & 1) << j
            if masks[at] == used[k]:
                weights[at] += members[k]
    for i in range(len(masks)):
        weights[i] = np.log(weights[i])


@inner
def _add_log_likelihood(o, masks, answers, prior, state, by_cell, values):  # type: ignore[no-untyped-def]
    """Adds to ``values`` [masks] the log probability of the labels of observer ``o`` if R is the
    fact set in ``masks``, given the labels counted in ``state.counts``.

    The labels of the observer are sorted by transition. The labels of τ depend on R only through R
    ∩ S_τ, so each possible R ∩ S_τ is tried once. Each label is counted before the next label of τ
    is predicted; the counts are restored at the end. ``by_cell`` is working memory and is
    overwritten.
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
        # If no fact matters, the labels do not depend on R.
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
                values[i] += by_cell[pack(subsets, z, masks[i])]
        begin = end


@kernel
def log_likelihood(state, prior):  # type: ignore[no-untyped-def]
    """Computes log P(all labels | R of every observer, S, ε), with f integrated out."""
    total, counts = 0.0, state.counts
    for t in range(len(counts)):
        for c in range(counts.shape[1]):
            zeros, ones = counts[t, c, 0], counts[t, c, 1]
            if zeros + ones > 0:
                total += log_cell_of(zeros, ones, c, state.noise[t], prior)
    return total


@kernel
def relabel(members, new, answers, prior, state):  # type: ignore[no-untyped-def]
    """Changes the fact set of the observers ``members`` to ``new``, and updates
    ``state.counts``."""
    for o in members:
        count_rows(o, -1, answers, prior, state)
        state.facts[o] = new
        count_rows(o, 1, answers, prior, state)
