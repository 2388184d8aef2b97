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
from numpy.typing import NDArray

from xplain.data.dataset import Dataset
from xplain.learning.fact_model.counts import REACH
from xplain.learning.fact_model.gibbs import WIDE, run_chain

NOISE = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""ε_τ is one of these; how often each occurs is learned."""
CELL = np.array([0.25, 0.98])
"""P(f_τ = 1) before any answer: where a fact that matters is held wrong, which mostly makes people
wonder, and where none is."""
SUBSET = 0.5
"""Each further fact that matters at a transition halves the prior of S_τ."""


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
        log_block: [depth + 1] log P(the facts among which S_τ is sought | S_τ), by its size.
        predictive: [2, E, 2 · REACH + 1, 2] log P(next label | is M ∩ S empty, ε, ones − zeros).
        marginal: [2, E, 2 · REACH + 1] log evidence of a cell beyond that of f = 1.
    """

    subsets: NDArray[np.int64]
    log_subset: NDArray[np.float64]
    log_block: NDArray[np.float64]
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
            np.array(
                [-np.log(comb(max(n - k, 0), max(WIDE - k, 0)) or 1) for k in range(depth + 1)]
            ),
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
        score: log of its joint probability with the labels, f integrated out, and up to ``WIDE``
            facts S and ε too.
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
    score = run_chain(
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
        tables.log_block,
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
