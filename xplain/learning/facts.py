"""A generative model of labels: people hold some facts wrong, and each message mends one.

An observer is of a type R, the set of facts (= messages) held wrong. Asked about transition τ
under message set H, it still holds M = R \\ H wrong, and the label depends on τ and M alone::

    label(τ, H) = f_τ(M ∩ S_τ), flipped with probability ε_τ

f_τ is a table of 0 and 1 over the few facts S_τ that matter at τ. Nothing of this is given: f, S
and ε are learned from everybody's labels together, so that independent questions, which hardly
ever coincide, still speak of the same things. Assumed is what the paper assumes: a message that
tells what one knows changes nothing, and people who hold the same facts wrong expect the same.

Inference is collapsed Gibbs sampling (f integrated out, cell by cell: a Beta-like two-point prior
makes the predictive probability a function of ones − zeros): R of each observer given the
others' answers, then (S_τ, ε_τ) of each transition. Types are shared by a Chinese restaurant
process (Neal 2000, "Markov chain sampling methods for Dirichlet process mixture models"), its
base measure uniform over fact sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numba import njit
from numpy.typing import NDArray

from xplain.learning.dataset import Dataset

NOISE = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""ε_τ is one of these; how often each occurs is learned."""
CELL = np.array([0.5, 0.98])
"""P(f_τ = 1) before any answer: where a fact that matters is held wrong, and where none is."""
SUBSET = 0.5
"""Each further fact that matters at a transition halves the prior of S_τ."""
REACH = 64
"""Ones − zeros beyond which a cell's value is beyond doubt."""
BLOCK = 8
"""Facts whose combinations are tried at once for an observer."""


@dataclass(frozen=True)
class Answers:
    """The labels of a dataset, sorted by observer and, of each observer, by transition.

    Attributes:
        start: [O + 1] int64 first row of each observer.
        tau, given, label, owner: [P] int64 transition, message set, label, observer.
        rows: [P] int64 the rows of everybody in the order of their transition.
        tau_start: [T + 1] int64 where each transition starts in ``rows``.
        n: messages.
    """

    start: NDArray[np.int64]
    tau: NDArray[np.int64]
    given: NDArray[np.int64]
    label: NDArray[np.int64]
    owner: NDArray[np.int64]
    rows: NDArray[np.int64]
    tau_start: NDArray[np.int64]
    n: int

    @classmethod
    def of(cls, dataset: Dataset) -> Answers:
        """Sorts."""
        order = np.lexsort((dataset.transition, dataset.observer))
        owner, tau = dataset.observer[order], dataset.transition[order]
        rows = np.argsort(tau, kind="stable")
        return cls(
            start=np.searchsorted(owner, np.arange(len(dataset.observers) + 1)).astype(np.int64),
            tau=tau,
            given=dataset.message_set[order],
            label=dataset.label[order].astype(np.int64),
            owner=owner,
            rows=rows,
            tau_start=np.searchsorted(tau[rows], np.arange(len(dataset.features) + 1)),
            n=dataset.n_messages,
        )


@dataclass(frozen=True)
class Tables:
    """What the sampler looks up.

    Attributes:
        subsets: [Z, depth] int64 positions of the facts of each possible S_τ, −1 where fewer.
        log_subset: [Z] log prior.
        predictive: [2, E, 2 · REACH + 1, 2] log P(next label | is M ∩ S empty, ε, ones − zeros).
        marginal: [2, E, 2 · REACH + 1] log evidence of a cell beyond that of f = 1.
    """

    subsets: NDArray[np.int64]
    log_subset: NDArray[np.float64]
    predictive: NDArray[np.float64]
    marginal: NDArray[np.float64]

    @classmethod
    def of(cls, n: int, depth: int) -> Tables:
        """For n messages, of which at most ``depth`` matter at a transition."""
        depth = min(depth, n)
        members = [one for size in range(depth + 1) for one in combinations(range(n), size)]
        subsets = np.full((len(members), max(depth, 1)), -1, dtype=np.int64)
        for z, one in enumerate(members):
            subsets[z, : len(one)] = one
        prior = np.array([SUBSET ** len(one) / comb(n, len(one)) for one in members])
        ahead = np.arange(-REACH, REACH + 1)[None, None, :]
        cell, noise = CELL[:, None, None], NOISE[None, :, None]
        odds = np.log(cell / (1 - cell)) + ahead * np.log((1 - noise) / noise)
        is_one = 1 / (1 + np.exp(-odds))
        next_one = is_one * (1 - noise) + (1 - is_one) * noise
        return cls(
            subsets,
            np.log(prior / prior.sum()),
            np.log(np.stack([1 - next_one, next_one], axis=-1)),
            np.log(cell) + np.logaddexp(0, -odds),
        )


@dataclass(frozen=True)
class State:
    """One state of the model.

    Attributes:
        facts: [O] int64, R of each observer.
        subset: [T] int64, S_τ as an index into :attr:`Tables.subsets`.
        noise: [T] int64, ε_τ as an index into :data:`NOISE`.
        score: log of its joint probability with the labels (f and S, ε integrated out).
    """

    facts: NDArray[np.int64]
    subset: NDArray[np.int64]
    noise: NDArray[np.int64]
    score: float


@dataclass(frozen=True)
class Chain:
    """One run of the sampler.

    Attributes:
        best: its state of the highest score.
        types: [sweeps / 2] int64, types that differ, after each sweep that counts (heated ones do
            not).
    """

    best: State
    types: NDArray[np.int64]


def sample(
    answers: Answers,
    tables: Tables,
    concentration: float,
    first: NDArray[np.int64],
    sweeps: int,
    heat: float,
    rng: np.random.Generator,
) -> Chain:
    """Runs the sampler from R = ``first`` [O]; over the first half of the sweeps it is heated
    (probabilities to the power 1 / temperature, the temperature falling from ``heat`` to 1)."""
    transitions = len(answers.tau_start) - 1
    facts = first.copy()
    best = np.zeros(len(facts), dtype=np.int64)
    subset, noise = (np.zeros(transitions, dtype=np.int64) for _ in range(2))
    types = np.zeros(sweeps, dtype=np.int64)
    score = _chain(
        answers.start,
        answers.tau,
        answers.given,
        answers.label,
        answers.owner,
        answers.rows,
        answers.tau_start,
        answers.n,
        tables.subsets,
        tables.log_subset,
        tables.predictive,
        tables.marginal,
        np.log(np.stack([1 - NOISE, NOISE], axis=1)),
        np.log(concentration) - answers.n * np.log(2),
        sweeps // 2,
        heat,
        rng,
        facts,
        best,
        subset,
        noise,
        types,
    )
    return Chain(State(best, subset, noise, float(score)), types[sweeps // 2 :])


def matters(state: State, tables: Tables) -> int:
    """The facts that matter at some transition, as a bitmask: types that differ in others only
    are behaviourally one."""
    used = np.unique(tables.subsets[state.subset])
    return sum(1 << int(j) for j in used if j >= 0)


def cells(answers: Answers, tables: Tables, state: State) -> NDArray[np.int64]:
    """Ones − zeros of every cell (τ, M ∩ S_τ): [T, 2^depth]."""
    held = state.facts[answers.owner] & ~answers.given
    ahead = np.zeros((len(state.subset), 1 << tables.subsets.shape[1]), dtype=np.int64)
    where = _locals(tables.subsets[state.subset[answers.tau]], held)
    np.add.at(ahead, (answers.tau, where), 2 * answers.label - 1)
    return ahead


def log_likelihood(
    tables: Tables,
    state: State,
    ahead: NDArray[np.int64],
    facts: NDArray[np.int64],
    tau: NDArray[np.int64],
    given: NDArray[np.int64],
    label: NDArray[np.int64],
) -> NDArray[np.float64]:
    """log P(labels [P] | type R, everybody's answers in ``ahead``) for each R of ``facts`` [N],
    each label on its own: [N, P]."""
    result = np.empty((len(facts), len(tau)))
    for i, one in enumerate(facts):
        where = _locals(tables.subsets[state.subset[tau]], one & ~given)
        lead = np.clip(ahead[tau, where], -REACH, REACH) + REACH
        result[i] = tables.predictive[(where == 0).astype(int), state.noise[tau], lead, label]
    return result


def _locals(positions: NDArray[np.int64], masks: NDArray[np.int64]) -> NDArray[np.int64]:
    """The bits of masks [P] at positions [P, depth], packed: [P]."""
    bits = (masks[:, None] >> np.maximum(positions, 0) & 1) * (positions >= 0)
    return np.asarray((bits << np.arange(positions.shape[1])).sum(axis=1))


# The kernels below index arrays in full: a row taken out of an array is counted by numba, and that
# costs more than the work in the innermost loops.


@njit(cache=True, nogil=True)
def _local(subsets, z, mask):  # type: ignore[no-untyped-def]
    """The bits of ``mask`` at the positions of subset z, packed."""
    packed = 0
    for i in range(subsets.shape[1]):
        if subsets[z, i] < 0:
            break
        packed |= (mask >> subsets[z, i] & 1) << i
    return packed


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _lead(ahead):  # type: ignore[no-untyped-def]
    """Where ones − zeros is in the tables."""
    return min(max(ahead, -REACH), REACH) + REACH


@njit(cache=True, nogil=True)
def _weigh_subsets(masks, labels, subsets, log_subset, marginal, flip, log_noise, count, out):  # type: ignore[no-untyped-def]
    """``out`` [Z, E]: log joint of (S_τ, ε_τ) and the labels of one transition, given M."""
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
    for z in range(len(subsets)):
        count[:] = 0
        for i in range(size):
            c = _local(subsets, z, distinct[i])
            count[c, 0] += times[i, 0]
            count[c, 1] += times[i, 1]
        for e in range(len(log_noise)):
            value = log_subset[z] + log_noise[e]
            right, wrong = flip[e, 0], flip[e, 1]
            for c in range(len(count)):
                if count[c, 0] + count[c, 1] > 0:
                    ahead = count[c, 1] - count[c, 0]
                    value += count[c, 1] * right + count[c, 0] * wrong
                    value += marginal[int(c == 0), e, _lead(ahead)]
                    if ahead < -REACH:  # beyond the table it is a straight line
                        value += (ahead + REACH) * (wrong - right)
            out[z, e] = value


@njit(cache=True, nogil=True)
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
                    lead = _lead(count[t, c, 1] - count[t, c, 0])
                    value += table[int(c == 0), noise[t], lead, label[p]]
                    count[t, c, label[p]] += 1
                for p in range(begin, end):
                    count[t, held & ~mended[p], label[p]] -= 1
                local[held] = value
            for i in range(len(masks)):
                values[i] += local[_local(subsets, z, masks[i])]
        begin = end


@njit(cache=True, nogil=True)
def _count_in(first, last, tau, mended, label, facts, subsets, subset, count, sign):  # type: ignore[no-untyped-def]
    for p in range(first, last):
        t = tau[p]
        count[t, _local(subsets, subset[t], facts) & ~mended[p], label[p]] += sign


@njit(cache=True, nogil=True)
def _chain(  # type: ignore[no-untyped-def]
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
    observers = len(start) - 1
    transitions = len(tau_start) - 1
    levels = len(flip)
    width = min(n, BLOCK)
    block = np.arange(n)
    mended = np.empty(len(tau), dtype=np.int64)
    count = np.zeros((transitions, 1 << subsets.shape[1], 2), dtype=np.int64)
    scratch = np.zeros((1 << subsets.shape[1], 2), dtype=np.int64)
    weights = np.empty((len(subsets), levels))
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
            _weigh_subsets(
                held,
                label[own],
                subsets,
                log_subset,
                marginal,
                flip,
                log_noise,
                scratch,
                weights,
            )
            chosen, total = _draw(weights.ravel(), temperature, rng)
            score += total
            subset[t] = chosen // levels
            noise[t] = chosen % levels
            seen[noise[t]] += 1
            count[t] = 0
            for i in range(len(own)):
                count[t, _local(subsets, subset[t], held[i]), label[own[i]]] += 1
                mended[own[i]] = _local(subsets, subset[t], given[own[i]])
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
            _count_in(first, last, tau, mended, label, facts[o], subsets, subset, count, -1)
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
            _count_in(first, last, tau, mended, label, facts[o], subsets, subset, count, 1)
    return best_score
