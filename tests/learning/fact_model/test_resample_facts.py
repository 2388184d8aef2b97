"""Compares the Gibbs step of the observers with the posterior, all states of which are
enumerated."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.learning.fact_model.states import begun, counted
from xplain.learning.mixture.kernels import resample_facts
from xplain.learning.mixture.sampler import CELL, NOISE, ChainState, Prior, SortedLabels

N, CONCENTRATION = 2, 0.7


@pytest.mark.parametrize("seed", range(3))
def test_two_observers_are_drawn_from_their_posterior(seed: int) -> None:
    rng = np.random.default_rng(seed)
    answers, prior = some_answers(rng), Prior.of(N, 2)
    state = begun(answers, prior, rng.integers(1 << N, size=2), rng)
    log_new, room = np.log(CONCENTRATION) - N * np.log(2), np.zeros(2, dtype=np.int64)
    visits = np.zeros((20, 1 << N, 1 << N))
    for batch in visits:
        for _ in range(300):
            used, members = np.unique(state.facts, return_counts=True)
            in_use = np.append(used, room), np.append(members, room), len(used)
            resample_facts(answers, prior, state, *in_use, log_new, 1.0, rng)
            batch[tuple(state.facts)] += 1 / 300
    assert (state.counts == counted(answers, prior, state)).all()
    error = visits.std(axis=0, ddof=1) / len(visits) ** 0.5
    assert (np.abs(visits.mean(axis=0) - posterior(answers, prior, state)) < 5 * error + 1e-3).all()


def some_answers(rng: np.random.Generator) -> SortedLabels:
    """Draws the answers of two people to nine questions each, about three transitions, with any
    messages."""
    transition = np.concatenate([np.sort(rng.integers(3, size=9)) for _ in range(2)])
    rows = np.argsort(transition, kind="stable")
    return SortedLabels(
        start=np.array([0, 9, 18]),
        transition=transition,
        message_set=rng.integers(1 << N, size=18),
        label=rng.integers(2, size=18),
        owner=np.repeat([0, 1], 9),
        rows=rows,
        transition_start=np.searchsorted(transition[rows], np.arange(4)),
        n_messages=N,
    )


def posterior(answers: SortedLabels, prior: Prior, state: ChainState) -> NDArray[np.float64]:
    """Computes [2^n, 2^n] P(R of the first person, R of the second | labels, S, ε)."""
    log_joint = np.empty((1 << N, 1 << N))
    for both in product(range(1 << N), repeat=2):
        restaurant = ((both[0] == both[1]) + CONCENTRATION / 2**N) / (1 + CONCENTRATION)
        log_joint[both] = np.log(restaurant)
        held = np.array(both)[answers.owner] & ~answers.message_set
        for t, (z, e) in enumerate(zip(state.subset, state.noise, strict=True)):
            cell = held & prior.members[z]
            for one in np.unique(cell[answers.transition == t]):
                labels = answers.label[(answers.transition == t) & (cell == one)]
                wrong = np.where(labels == 1, NOISE[e], 1 - NOISE[e]).prod()  # where f = 0
                right = np.where(labels == 1, 1 - NOISE[e], NOISE[e]).prod()
                before = CELL[int(one == 0)]
                log_joint[both] += np.log(before * right + (1 - before) * wrong)
    joint: NDArray[np.float64] = np.exp(log_joint)
    return np.asarray(joint / joint.sum())
