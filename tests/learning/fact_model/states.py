"""States of the sampler, and their counts, computed from the labels."""

import numpy as np
from numpy.typing import NDArray

from xplain.learning.mixture.kernels import resample_transitions
from xplain.learning.mixture.sampler import ChainState, Prior, SortedLabels, init


def begun(
    answers: SortedLabels, prior: Prior, facts: NDArray[np.int64], rng: np.random.Generator
) -> ChainState:
    """Makes a state with these R, and draws S and ε once, so that some fact matters."""
    state = init(answers, prior, facts)
    while not (prior.size[state.subset] > 0).any():
        resample_transitions(answers, prior, state, 1.0, rng)
    return state


def counted(answers: SortedLabels, prior: Prior, state: ChainState) -> NDArray[np.int64]:
    """Counts [T, 2^depth, 2] the labels 0 and 1 of each cell, from the labels themselves."""
    counts = np.zeros_like(state.counts)
    held = state.facts[answers.owner] & ~answers.message_set
    for t, mask, label in zip(answers.transition, held, answers.label, strict=True):
        members = [int(j) for j in prior.subsets[state.subset[t]] if j >= 0]
        counts[t, sum((int(mask) >> j & 1) << i for i, j in enumerate(members)), label] += 1
    return counts
