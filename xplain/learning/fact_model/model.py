"""A generative model of labels: people hold some facts wrong, and each message sets one right.

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

from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.learning.data.dataset import Dataset
from xplain.learning.fact_model.counts import REACH
from xplain.learning.fact_model.resample_transitions import WIDE

NOISE = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""ε_τ is one of these; how often each occurs is learned."""
CELL = np.array([0.25, 0.98])
"""P(f_τ = 1) before any answer: where a fact that matters is held wrong, which mostly makes people
wonder, and where none is."""
SUBSET = 0.5
"""Each further fact that matters at a transition halves the prior of S_τ."""


class SortedLabels(NamedTuple):
    """The labels of a dataset, sorted by observer and, of each observer, by transition.

    P labels by O observers on T transitions.

    Attributes:
        start: [O + 1] int64 first row of each observer.
        transition, message_set, label, owner: [P] int64; ``owner`` is the observer.
        rows: [P] int64 the rows of everybody in the order of their transition.
        transition_start: [T + 1] int64 where each transition starts in ``rows``.
        n_messages: n.
    """

    start: NDArray[np.int64]
    transition: NDArray[np.int64]
    message_set: NDArray[np.int64]
    label: NDArray[np.int64]
    owner: NDArray[np.int64]
    rows: NDArray[np.int64]
    transition_start: NDArray[np.int64]
    n_messages: int

    @classmethod
    def of(cls, dataset: Dataset) -> SortedLabels:
        """Sorts the labels of a dataset."""
        order = np.lexsort((dataset.transition, dataset.observer))
        owner, transition = dataset.observer[order], dataset.transition[order]
        rows = np.argsort(transition, kind="stable")
        return cls(
            start=np.searchsorted(owner, np.arange(len(dataset.observers) + 1)).astype(np.int64),
            transition=transition,
            message_set=dataset.message_set[order],
            label=dataset.label[order].astype(np.int64),
            owner=owner,
            rows=rows,
            transition_start=np.searchsorted(
                transition[rows], np.arange(len(dataset.features) + 1)
            ),
            n_messages=dataset.n_messages,
        )


class Prior(NamedTuple):
    """What is known of f, S and ε before any answer, as tables to look up.

    Z subsets of at most ``depth`` facts, E levels of noise.

    Attributes:
        subsets: [Z, depth] int64 positions of the facts of each possible S_τ, −1 where fewer.
        size: [Z] int64 how many facts each has.
        members: [Z] int64 the same facts as a bitmask.
        log_subset: [Z] log prior.
        log_block: [depth + 1] log P(the facts among which S_τ is sought | S_τ), by its size.
        predictive: [2, E, 2 · REACH + 1, 2] log P(next label | is M ∩ S empty, ε, ones − zeros).
        marginal: [2, E, 2 · REACH + 1] log marginal likelihood of a cell beyond that of f = 1.
        log_flip: [E, 2] log(1 − ε) and log ε.
    """

    subsets: NDArray[np.int64]
    size: NDArray[np.int64]
    members: NDArray[np.int64]
    log_subset: NDArray[np.float64]
    log_block: NDArray[np.float64]
    predictive: NDArray[np.float64]
    marginal: NDArray[np.float64]
    log_flip: NDArray[np.float64]

    @classmethod
    def of(cls, n: int, depth: int) -> Prior:
        """For n messages, of which at most ``depth`` matter at a transition."""
        depth = min(depth, n)
        chosen = [one for size in range(depth + 1) for one in combinations(range(n), size)]
        subsets = np.full((len(chosen), max(depth, 1)), -1, dtype=np.int64)
        for z, one in enumerate(chosen):
            subsets[z, : len(one)] = one
        prior = np.array([SUBSET ** len(one) / comb(n, len(one)) for one in chosen])
        ahead = np.arange(-REACH, REACH + 1)[None, None, :]
        cell, noise = CELL[:, None, None], NOISE[None, :, None]
        odds = np.log(cell / (1 - cell)) + ahead * np.log((1 - noise) / noise)
        is_one = 1 / (1 + np.exp(-odds))
        next_one = is_one * (1 - noise) + (1 - is_one) * noise
        return cls(
            subsets=subsets,
            size=np.array([len(one) for one in chosen]),
            members=np.array([sum(1 << j for j in one) for one in chosen]),
            log_subset=np.log(prior / prior.sum()),
            log_block=np.array(
                [-np.log(comb(max(n - k, 0), max(WIDE - k, 0)) or 1) for k in range(depth + 1)]
            ),
            predictive=np.log(np.stack([1 - next_one, next_one], axis=-1)),
            marginal=np.log(cell) + np.logaddexp(0, -odds),
            log_flip=np.log(np.stack([1 - NOISE, NOISE], axis=1)),
        )


class ChainState(NamedTuple):
    """One state of a chain, and what is counted of it. A step overwrites the arrays.

    Attributes:
        facts: [O] int64, R of each observer.
        subset: [T] int64, S_τ as an index into :attr:`Prior.subsets`.
        noise: [T] int64, ε_τ as an index into :data:`NOISE`.
        log_noise: [E] log share of each level of noise.
        messages_given: [P] int64 the messages about S_τ that each answer was given, packed into
            the lowest bits.
        counts: [T, 2^depth, 2] int64 labels 0 and 1 by cell (τ, M ∩ S_τ).
        order: [n] int64 the messages, those that were tried last for an observer first.
    """

    facts: NDArray[np.int64]
    subset: NDArray[np.int64]
    noise: NDArray[np.int64]
    log_noise: NDArray[np.float64]
    messages_given: NDArray[np.int64]
    counts: NDArray[np.int64]
    order: NDArray[np.int64]

    def copy(self) -> ChainState:
        """The same state in arrays of its own."""
        return ChainState._make(array.copy() for array in self)


def facts_that_matter(prior: Prior, state: ChainState) -> int:
    """The facts that matter at some transition, as a bitmask: types that differ in others only
    are behaviourally one."""
    return int(np.bitwise_or.reduce(prior.members[state.subset]))
