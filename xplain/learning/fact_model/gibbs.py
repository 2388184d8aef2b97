"""Collapsed Gibbs sampling of :mod:`xplain.learning.fact_model.model`: one chain.

A sweep draws (S, ε) of every transition, then R of every observer, then tries to split and merge
whole types where observers are many.
"""

from __future__ import annotations

from math import lgamma, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xplain.learning.fact_model.model import ChainState, Prior, SortedLabels, facts_that_matter
from xplain.learning.fact_model.resample_facts import FactScratch as ObserverScratch
from xplain.learning.fact_model.resample_facts import InUse, resample_facts
from xplain.learning.fact_model.resample_transitions import WIDE, resample_transitions
from xplain.learning.fact_model.resample_transitions import TransitionScratch as TransitionScratch
from xplain.learning.fact_model.split_merge import MANY_OBSERVERS, merge_types, split_merge


class Chain(NamedTuple):
    """One run of the sampler.

    Attributes:
        best: its state of the highest score.
        score: log of that state's joint probability with the labels, f integrated out, and up to
            12 messages S and ε summed out.
        types: [sweeps / 2] int64, types that differ, after each sweep that counts (heated ones do
            not).
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

    Over the first half of the sweeps probabilities are taken to the power 1 / temperature, the
    temperature falling from ``initial_temperature`` to 1.
    """
    n, depth = answers.n_messages, prior.subsets.shape[1]
    log_new = log(concentration) - n * log(2)
    of_transition = TransitionScratch.of(
        answers.transition_start, len(prior.size), depth, len(prior.log_flip)
    )
    of_observer = ObserverScratch.of(n, depth)
    state = init(answers, prior, first)
    best, best_score = state, -np.inf
    types = np.zeros(sweeps, dtype=np.int64)
    for sweep in range(sweeps):
        # From the initial temperature straight down to 1 over the first half, 1 from there on.
        heat = max(1.0 - sweep / max(sweeps // 2, 1), 0.0)
        temperature = 1.0 + (initial_temperature - 1.0) * heat
        held = state.facts[answers.owner] & ~answers.message_set
        score = resample_transitions(answers, prior, state, held, temperature, rng, of_transition)
        used, members = np.unique(state.facts, return_counts=True)
        score += _log_restaurant(members, log_new)
        types[sweep] = len(set((used & facts_that_matter(prior, state)).tolist()))
        if score > best_score:
            best, best_score = state.copy(), score
        in_use = InUse.of(used, members, len(first))
        about = answers, prior, state, in_use, len(used), log_new, temperature
        resample_facts(*about, rng, of_observer)
        if len(first) >= MANY_OBSERVERS:
            split_merge(answers, prior, state, log_new, temperature, rng)
    if len(first) >= MANY_OBSERVERS:
        best_score += merge_types(answers, prior, best, log_new)
        if n <= WIDE:  # merges compare with S and ε fixed; chains are compared with both summed out
            held = best.facts[answers.owner] & ~answers.message_set
            merged = answers, prior, best.copy(), held, 1.0, rng, of_transition
            members = np.unique(best.facts, return_counts=True)[1]
            best_score = resample_transitions(*merged) + _log_restaurant(members, log_new)
    return Chain(best, best_score, types[sweeps // 2 :])


def init(answers: SortedLabels, prior: Prior, first: NDArray[np.int64]) -> ChainState:
    """The state in which observers hold ``first`` [O] wrong, no fact matters anywhere, and all
    levels of noise are as likely; nothing is counted yet."""
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


def _log_restaurant(members: NDArray[np.int64], log_new: float) -> float:
    """log P(who shares a type, and each type's fact set) of types with ``members`` [K]."""
    return sum(log_new + lgamma(size) for size in members.tolist())
