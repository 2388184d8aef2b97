r"""A generative model of labels: people believe some facts incorrectly, and each message corrects
one fact.

An observer has a type R: the set of facts (= messages) that they believe incorrectly. Given message
set H, they still believe M = R \ H incorrectly. Their label of transition τ depends only on τ and
M::

    label(τ, H) = f_τ(M ∩ S_τ), flipped with probability ε_τ

f_τ is a table of 0 and 1 over the few facts S_τ that matter at τ. f, S and ε are learned from the
labels of all observers together, so answers to different questions inform the same parameters. The
paper's assumptions hold: a message about a fact that a person knows changes nothing, and people who
believe the same facts incorrectly have the same labels.

Inference is collapsed Gibbs sampling: f is integrated out for each cell. As f is 0 or 1, the
predictive probability depends only on ones − zeros. The sampler draws R of each observer given the
answers of all others, then (S_τ, ε_τ) of each transition. A Chinese restaurant process assigns
observers to types (Neal 2000, "Markov chain sampling methods for Dirichlet process mixture
models"), with a uniform base measure over fact sets.

A sweep draws (S, ε) of every transition, then R of every observer. With many observers it then
tries to split and merge whole types, after Jain & Neal (2004), "A split-merge Markov chain Monte
Carlo procedure for the Dirichlet process mixture model", in its plain form: the observers of a new
type are drawn at random, without Gibbs scans. Without these moves two types with equal answers
merge only one observer at a time, which takes as many sweeps as the types have observers.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from itertools import combinations
from math import comb, exp, lgamma
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.errors import Count, Positive, Range, TooLargeError, checks
from xplain.learning.answers import AnswerModel, learn_answers
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations
from xplain.learning.mixture.classes import answer_classes
from xplain.learning.mixture.kernels import (
    REACH,
    WIDE,
    log_likelihood,
    relabel,
    resample_facts,
    resample_subsets,
)
from xplain.learning.mixture.likelihood import log_cell
from xplain.learning.types import Clustering, shares_of
from xplain.learning.user_types import Clusterer
from xplain.randomness import derive_seed, stream

NOISE = np.array([0.003, 0.01, 0.03, 0.06, 0.1, 0.15])
"""The possible values of ε_τ; their shares are learned."""
CELL = np.array([0.25, 0.98])
"""P(f_τ = 1) before any answer: for people who believe a relevant fact incorrectly (most of them
find the transition inexplicable), and for all others."""
SUBSET = 0.5
"""Each further fact in S_τ multiplies its prior by this factor."""


class SortedLabels(NamedTuple):
    """P labels by O observers on T transitions, sorted by observer, then by transition.

    Attributes:
        start: [O + 1] int64 index of each observer's first label.
        transition, message_set, label: [P] int64.
        owner: [P] int64 the observer who gave each label.
        rows: [P] int64 indices of all labels, sorted by transition.
        transition_start: [T + 1] int64 index in ``rows`` at which each transition's labels begin.
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
    """Tables for the prior of f, S and ε.

    Z is the number of subsets of at most ``depth`` facts, E the number of error rates ε. A cell's
    ones − zeros is between −REACH and REACH.

    Attributes:
        subsets: [Z, depth] int64 facts of each possible S_τ, padded with −1.
        size: [Z] int64 number of facts in each subset.
        members: [Z] int64 facts of each subset as a bitmask.
        log_subset: [Z] log prior of each subset.
        log_block: [depth + 1] log P(a random block of facts is drawn | S_τ), by the size of S_τ.
            The next S_τ is a subset of the drawn block.
        predictive: [2, E, 2 · REACH + 1, 2] log P(next label), by: whether M ∩ S is empty; ε; ones
            − zeros; and the next label.
        marginal: [2, E, 2 · REACH + 1] log of P(labels of a cell) / P(these labels | f = 1), by:
            whether M ∩ S is empty; ε; and ones − zeros.
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
        """Computes the prior for n messages, of which at most ``depth`` matter at a transition."""
        depth = min(depth, n)
        chosen = [one for size in range(depth + 1) for one in combinations(range(n), size)]
        subsets = np.full((len(chosen), max(depth, 1)), -1, dtype=np.int64)
        for z, one in enumerate(chosen):
            subsets[z, : len(one)] = one
        prior = np.array([SUBSET ** len(one) / comb(n, len(one)) for one in chosen])
        ahead = np.arange(-REACH - 1, REACH + 2)
        flip = np.log(np.stack([1 - NOISE, NOISE], axis=1))
        odds = ahead * (flip[:, 0] - flip[:, 1])[:, None]
        marginal = log_cell(CELL[:, None, None], -odds, 0.0)  # [2, E, 2 · REACH + 3]
        likelier = flip[:, ::-1, None] + np.stack([marginal[..., :-2], marginal[..., 2:]], axis=2)
        return cls(
            subsets=subsets,
            size=np.array([len(one) for one in chosen]),
            members=np.array([sum(1 << j for j in one) for one in chosen]),
            log_subset=np.log(prior / prior.sum()),
            log_block=np.array(
                [-np.log(comb(max(n - k, 0), max(WIDE - k, 0)) or 1) for k in range(depth + 1)]
            ),
            predictive=np.moveaxis(likelier - marginal[:, :, None, 1:-1], 2, 3).copy(),
            marginal=marginal[..., 1:-1].copy(),
            log_flip=flip,
        )


class ChainState(NamedTuple):
    """One state of a chain, with its counts. A step overwrites the arrays.

    Attributes:
        facts: [O] int64, R of each observer.
        subset: [T] int64, S_τ as an index into :attr:`Prior.subsets`.
        noise: [T] int64, ε_τ as an index into :data:`NOISE`.
        log_noise: [E] log share of each level of noise.
        messages_given: [P] int64 the messages about S_τ that were given before each answer, packed
            into the lowest bits.
        counts: [T, 2^depth, 2] int64 labels 0 and 1 by cell (τ, M ∩ S_τ).
        order: [n] int64 the messages; those last tried for an observer come first.
    """

    facts: NDArray[np.int64]
    subset: NDArray[np.int64]
    noise: NDArray[np.int64]
    log_noise: NDArray[np.float64]
    messages_given: NDArray[np.int64]
    counts: NDArray[np.int64]
    order: NDArray[np.int64]

    def copy(self) -> ChainState:
        """Copies the state into new arrays."""
        return ChainState._make(array.copy() for array in self)


def facts_that_matter(prior: Prior, state: ChainState) -> int:
    """Returns the facts that matter at some transition, as a bitmask. Types that differ only in
    other facts behave alike."""
    return int(np.bitwise_or.reduce(prior.members[state.subset]))


class Chain(NamedTuple):
    """One run of the sampler.

    Attributes:
        best: state with the highest score.
        score: log joint probability of that state and the labels, with f integrated out; for up to
            12 messages S and ε are summed out too.
        types: [sweeps / 2] int64, number of distinct types after each sweep of the second half (the
            first half is heated).
    """

    best: ChainState
    score: float
    types: NDArray[np.int64]


def sample(
    answers: SortedLabels,
    prior: Prior,
    concentration: float,
    first: NDArray[np.int64],
    sweeps: int,
    initial_temperature: float,
    rng: np.random.Generator,
) -> Chain:
    """Runs a chain from R = ``first`` [O].

    In the first half of the sweeps probabilities are raised to the power 1 / temperature; the
    temperature falls from ``initial_temperature`` to 1.
    """
    n, observers = answers.n_messages, len(first)
    log_new = math.log(concentration) - n * math.log(2)
    state, room = init(answers, prior, first), np.zeros(observers, dtype=np.int64)
    best, best_score = state, -np.inf
    types = np.zeros(sweeps, dtype=np.int64)
    for sweep in range(sweeps):
        # Falls linearly to 1 over the first half, then stays at 1.
        heat = max(1.0 - sweep / max(sweeps // 2, 1), 0.0)
        temperature = 1.0 + (initial_temperature - 1.0) * heat
        score = resample_transitions(answers, prior, state, temperature, rng)
        used, members = np.unique(state.facts, return_counts=True)
        score += _log_restaurant(members, log_new)
        types[sweep] = len(set((used & facts_that_matter(prior, state)).tolist()))
        if score > best_score:
            best, best_score = state.copy(), score
        in_use = np.append(used, room), np.append(members, room), len(used)
        resample_facts(answers, prior, state, *in_use, log_new, temperature, rng)
        if observers >= MANY_OBSERVERS:
            split_merge(answers, prior, state, log_new, temperature, rng)
    if observers >= MANY_OBSERVERS:
        best_score += merge_types(answers, prior, best, log_new)
        if n <= WIDE:  # merges compare with S and ε fixed; chains are compared with both summed out
            members = np.unique(best.facts, return_counts=True)[1]
            best_score = resample_transitions(answers, prior, best.copy(), 1.0, rng)
            best_score += _log_restaurant(members, log_new)
    return Chain(best, best_score, types[sweeps // 2 :])


def init(answers: SortedLabels, prior: Prior, first: NDArray[np.int64]) -> ChainState:
    """Makes the state in which observers believe ``first`` [O] incorrectly, no fact matters, and
    all noise levels are equally likely. The state has no counts yet."""
    transitions, levels = len(answers.transition_start) - 1, len(prior.log_flip)
    return ChainState(
        facts=first.copy(),
        subset=np.zeros(transitions, dtype=np.int64),
        noise=np.zeros(transitions, dtype=np.int64),
        log_noise=np.full(levels, -np.log(levels)),
        messages_given=np.zeros(len(answers.label), dtype=np.int64),
        counts=np.zeros((transitions, 1 << prior.subsets.shape[1], 2), dtype=np.int64),
        order=np.arange(answers.n_messages),
    )


def resample_transitions(
    answers: SortedLabels,
    prior: Prior,
    state: ChainState,
    temperature: float,
    rng: np.random.Generator,
) -> float:
    """Draws (S_τ, ε_τ) of every transition, and then the shares of the levels of ε. Returns the
    score of :func:`~xplain.learning.mixture.kernels.resample_subsets`."""
    held = state.facts[answers.owner] & ~answers.message_set
    score = resample_subsets(answers, prior, state, held, temperature, rng)
    shares = 0.02 + np.bincount(state.noise, minlength=len(state.log_noise))
    state.log_noise[:] = np.log(shares / shares.sum())
    return float(score)


def _log_restaurant(members: NDArray[np.int64], log_new: float) -> float:
    """Computes, up to a constant, log P(partition of the observers, and each type's fact set).

    Args:
        members: [K] number of observers in each of the K types.
        log_new: log weight of an unused fact set in the Chinese restaurant process.
    """
    return sum(log_new + lgamma(size) for size in members.tolist())


MANY_OBSERVERS = 100
"""With at least this number of observers, whole types are split and merged, too."""
MOVES = 20
"""Split and merge moves in one sweep."""


def split_merge(
    answers: SortedLabels,
    prior: Prior,
    state: ChainState,
    log_new: float,
    temperature: float,
    rng: np.random.Generator,
) -> None:
    """Tries MOVES Metropolis-Hastings moves; overwrites ``state``.

    Args:
        answers, prior, state: see :func:`sample`.
        log_new: log weight of an unused fact set in the Chinese restaurant process.
        temperature: temperature of the target distribution.
        rng: random generator of the chain.
    """
    now = log_likelihood(state, prior)
    for _ in range(MOVES):
        move = _propose_move(state.facts, answers.n_messages, exp(log_new), rng)
        if move is not None:
            members, new, log_prior, log_proposal = move
            least = temperature * (math.log(rng.random()) - log_proposal) - log_prior
            now += _try_relabel(members, new, least, now, answers, prior, state)


def merge_types(answers: SortedLabels, prior: Prior, state: ChainState, log_new: float) -> float:
    """Gives all observers of a type the fact set of another type, wherever this makes ``state``
    more likely.

    Returns:
        The total increase of the log-likelihood.
    """
    gained, facts = 0.0, state.facts
    used = np.unique(facts)
    for old in used:
        members = np.flatnonzero(facts == old)
        for new in used:
            others = int((facts == new).sum())
            if new == old or others == 0:
                continue
            urn, now = _log_merged(len(members), others, exp(log_new)), log_likelihood(state, prior)
            gained += _try_relabel(members, new, -urn, now, answers, prior, state)
            if facts[members[0]] == new:
                gained += urn
                break
    return gained


def _try_relabel(
    members: NDArray[np.int64],
    new: int,
    least: float,
    now: float,
    answers: SortedLabels,
    prior: Prior,
    state: ChainState,
) -> float:
    """Gives some observers of one type another fact set, if this increases the log-likelihood
    enough; otherwise leaves ``state`` unchanged.

    Args:
        members: the observers.
        new: their new fact set.
        least: the gain in log-likelihood must be larger than this.
        now: log-likelihood of ``state`` before the change.
        answers, prior, state: see :func:`sample`.

    Returns:
        The gain in log-likelihood, or 0 without a change.
    """
    old, counts = state.facts[members[0]], state.counts.copy()
    relabel(members, new, answers, prior, state)
    gain = float(log_likelihood(state, prior)) - now
    if gain > least:
        return gain
    state.facts[members] = old
    state.counts[:] = counts
    return 0.0


def _propose_move(
    facts: NDArray[np.int64], n: int, urn: float, rng: np.random.Generator
) -> tuple[NDArray[np.int64], int, float, float] | None:
    """Proposes a merge (all observers of a type take the fact set of another type) or a split (some
    random observers of a type take an unused fact set).

    Returns:
        The observers, their new fact set, the log ratio of the priors (after the move / before it),
        and the log ratio of the proposal probabilities (of the reverse move / of this move). None
        if the drawn move is impossible: there is no second type, the type has only one observer to
        split, or the fact set is in use.
    """
    used = np.unique(facts)
    a = rng.integers(0, len(used))
    members = np.flatnonzero(facts == used[a])
    size = len(members)
    if rng.random() < 0.5:
        if len(used) == 1:
            return None
        new = int(used[(a + rng.integers(1, len(used))) % len(used)])
        others = int((facts == new).sum())
        back = math.log(len(used)) - n * math.log(2) - _compute_log_subsets(size + others, size)
        return members, new, _log_merged(size, others, urn), back
    new = int(rng.integers(0, 1 << n))
    if size == 1 or (facts == new).any():
        return None
    part = int(rng.integers(1, size))
    rng.shuffle(members)
    back = _compute_log_subsets(size, part) + n * math.log(2) - math.log(len(used) + 1)
    return members[:part], new, -_log_merged(part, size - part, urn), back


def _log_merged(size: int, others: int, urn: float) -> float:
    """Computes the log ratio of two probabilities under Pólya's urn: that ``size`` + ``others``
    observers all have one fact set, and that ``size`` of them have one fact set and ``others`` have
    another. The urn begins with ``urn`` balls of each fact set."""
    return lgamma(size + others + urn) + lgamma(urn) - lgamma(size + urn) - lgamma(others + urn)


def _compute_log_subsets(whole: int, part: int) -> float:
    """Computes −log P(a given subset of ``part`` observers is drawn from ``whole`` observers), if
    all sizes 1 … whole − 1 are equally likely, and all subsets of a size."""
    choose = lgamma(whole + 1) - lgamma(part + 1) - lgamma(whole - part + 1)
    return math.log(whole - 1) + choose


log = logging.getLogger(__name__)

FEWEST_SWEEPS = 20
MANY = 38
"""Number of messages above which there are too many sets of four facts."""
MAX_SUBSETS = 1 << 15
"""Maximum number of candidates for S; every sweep weighs all candidates."""


@checks("clusterer")
@dataclass(frozen=True)
class DirichletMixture(Clusterer):
    """Finds types by Gibbs sampling. The result is the sampled state with the highest joint
    probability.

    Attributes:
        concentration: α > 0 of the Chinese restaurant process; a larger α makes new types more
            likely.
        depth: maximum number of facts in S_τ. None means 5, or 4 for more than 12 messages or for
            so many observers that ``updates`` ends chains early, or 3 for more than 38 messages.
        chains: number of independent runs; half of the runs start with one type, half with random
            types.
        sweeps: sweeps of each chain; the first half is heated. Large data sets need few sweeps.
        updates: a chain stops after this many updates of an observer (but not before 20 sweeps).
        heat: initial temperature.
    """

    concentration: Positive = 1.0
    depth: Count | None = None
    chains: Count = 4
    sweeps: Annotated[int, Range(FEWEST_SWEEPS)] = 100
    updates: Count = 300_000
    heat: Annotated[float, Range(1)] = 4.0

    def cluster(self, observed: Observations, seed: int) -> Clustering:
        """Finds the types, the messages that each type needs, and the posterior over the number of
        types.

        Without messages in the data, types are classes of answers
        (:mod:`xplain.learning.mixture.classes`). If the trainer has hypotheses, they replace the
        prior over S.

        Raises:
            TooLargeError: ``depth`` is too large for the number of messages.
        """
        seed, dataset = derive_seed(seed, "clusterer"), observed.dataset
        found = self.labeler.adapt_to(observed).cluster(dataset, self.concentration)
        if found is not None:
            return found
        if dataset.message_set.any():
            found = self._sample_types(dataset, seed)
        else:
            found = answer_classes(dataset, self.concentration, self.chains, seed)
        assert found.posterior is not None
        share = 100 * found.posterior.get(found.n_types, 0.0)
        types = "%d user types by the rule posterior: %.0f%% of the samples have as many"
        log.info(types, found.n_types, share)
        return found

    def _sample_types(self, dataset: Dataset, seed: int) -> Clustering:
        """Finds types by sampling fact sets, for data with messages."""
        observers, n = len(dataset.observers), dataset.n_messages
        long = observers * self.sweeps <= self.updates
        usual = 5 if n <= WIDE and long else 4 if n <= MANY else 3
        depth = min(self.depth or usual, n)
        if n**depth > 64 * MAX_SUBSETS:
            raise TooLargeError(
                f"clusterer.depth={depth}: too many sets of {n} messages; at most "
                f"{int(math.log(64 * MAX_SUBSETS, n))}"
            )
        answers, prior = SortedLabels.of(dataset), Prior.of(n, depth)
        sweeps = min(self.sweeps, max(self.updates // observers, FEWEST_SWEEPS))
        chains = [
            sample(
                answers,
                prior,
                self.concentration,
                self._make_first(observers, n, chain, seed),
                sweeps,
                self.heat,
                stream(seed, "dirichlet", chain),
            )
            for chain in range(self.chains)
        ]
        best = max(chains, key=lambda chain: chain.score).best
        return Clustering.by_facts(
            best.facts & facts_that_matter(prior, best),
            "posterior",
            posterior=shares_of(np.concatenate([chain.types for chain in chains])),
            answers=_estimate_errors(dataset, prior, best),
        )

    def _make_first(self, observers: int, n: int, chain: int, seed: int) -> NDArray[np.int64]:
        everything = np.full(observers, (1 << n) - 1, dtype=np.int64)
        if chain % 2 == 0:
            return everything
        return stream(seed, "dirichlet", "first", chain).integers(0, 1 << n, observers)


def _estimate_errors(dataset: Dataset, prior: Prior, state: ChainState) -> AnswerModel:
    """Estimates slips, guesses and error rates, given the cells of ``state``.

    The sampler itself has one error rate for each transition. With an error rate for each observer,
    the labels of a cell would have different weights, but the tables of the sampler hold only ones
    − zeros.
    """
    held = state.facts[dataset.observer] & ~dataset.message_set
    matters = held & prior.members[state.subset[dataset.transition]]
    both = np.stack([dataset.transition, matters])
    cells, cell = np.unique(both, axis=1, return_inverse=True)
    wrong = float(np.exp(state.log_noise) @ NOISE)
    # The share of cells with label 1 is estimated from the answers: with few answers in each
    # cell, a share that is too low would be taken for guesses.
    kind = (matters > 0).astype(np.int64)
    ones = np.bincount(kind, dataset.label, 2) / np.bincount(kind, minlength=2).clip(1)
    one = ((ones - wrong) / (1 - 2 * wrong)).clip(0.02, 0.98)[(cells[1] > 0).astype(np.int64)]
    return learn_answers(dataset, cell.ravel(), one, wrong)
