"""Compares the Gibbs step of the transitions with the posterior of (S, ε), which is enumerated."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import gammaln

from tests.learning.fact_model.states import counted
from xplain.learning.data.dataset import Dataset
from xplain.learning.mixture.kernels import REACH, WIDE, resample_transitions
from xplain.learning.mixture.sampler import (
    CELL,
    NOISE,
    ChainState,
    Prior,
    SortedLabels,
    init,
    sample,
)

LOG_NOISE = np.log(np.arange(1.0, len(NOISE) + 1) / np.arange(1.0, len(NOISE) + 1).sum())
"""Some prior over the levels of noise."""


def some_answers(rng: np.random.Generator, n: int, size: int, ones: float) -> SortedLabels:
    """Draws answers of three observers about two transitions, under any messages."""
    dataset = Dataset(
        features=np.arange(2.0)[:, None],
        feature_names=("place",),
        messages=tuple(f"m{j}" for j in range(n)),
        observers=("a", "b", "c"),
        observer=rng.integers(3, size=size),
        transition=rng.integers(2, size=size),
        message_set=rng.integers(1 << n, size=size),
        label=(rng.random(size) < ones).astype(np.uint8),
    )
    return SortedLabels.of(dataset)


def log_joint(
    answers: SortedLabels,
    prior: Prior,
    state: ChainState,
    log_noise: NDArray[np.float64] = LOG_NOISE,
) -> NDArray[np.float64]:
    """Computes [T, Z, E] log P(S, ε and the labels about a transition | everybody's R), summed over
    f."""
    held = state.facts[answers.owner] & ~answers.message_set
    found = np.empty((len(state.subset), len(prior.size), len(NOISE)))
    for t, z, e in np.ndindex(found.shape):
        about = answers.transition == t
        cell = held & prior.members[z]
        value = prior.log_subset[z] + log_noise[e]
        for one in np.unique(cell[about]):
            label = answers.label[about & (cell == one)]
            ones, zeros = int(label.sum()), int((1 - label).sum())
            right, wrong = np.log1p(-NOISE[e]), np.log(NOISE[e])
            before = CELL[int(one == 0)]
            value += np.logaddexp(
                np.log(before) + ones * right + zeros * wrong,
                np.log1p(-before) + ones * wrong + zeros * right,
            )
        found[t, z, e] = value
    return found


@pytest.mark.parametrize(
    ("n", "depth", "size", "temperature"),
    [
        (2, 2, 24, 1.0),
        (2, 2, 24, 3.0),
        # Few labels, so that no fact may matter, which more blocks are drawn from than one.
        (WIDE + 18, 1, 6, 1.0),
    ],
)
def test_subsets_and_noise_are_drawn_from_their_posterior(
    n: int, depth: int, size: int, temperature: float
) -> None:
    rng = np.random.default_rng(3)
    answers, prior = some_answers(rng, n, size, 0.6), Prior.of(n, depth)
    state = init(answers, prior, np.array([(1 << n) - 1, 1, 3]))
    visits = np.zeros((20, 2, len(prior.size), len(NOISE)))
    for batch in visits:
        for _ in range(400):
            state.log_noise[:] = LOG_NOISE
            resample_transitions(answers, prior, state, temperature, rng)
            batch[[0, 1], state.subset, state.noise] += 1 / 400
    assert (state.counts == counted(answers, prior, state)).all()
    share = np.bincount(state.noise, minlength=len(NOISE)) + 0.02
    assert np.exp(state.log_noise) == pytest.approx(share / share.sum())
    expected = log_joint(answers, prior, state) / temperature
    expected = np.exp(expected - expected.max(axis=(1, 2), keepdims=True))
    expected /= expected.sum(axis=(1, 2), keepdims=True)
    # Of 20 batches the mean; where a state is rare, by the binomial law of 8,000 draws.
    error = visits.std(axis=0, ddof=1) / 20**0.5 + (expected * (1 - expected) / 8_000) ** 0.5
    assert (np.abs(visits.mean(axis=0) - expected) < 5 * error + 2e-4).all()


@pytest.mark.parametrize("ones", [0.0, 0.5, 1.0])
def test_the_score_is_the_sum_over_all_of_them_however_many_labels_agree(ones: float) -> None:
    """This holds also beyond the size of the table, for hundreds of equal labels of a cell."""
    rng = np.random.default_rng(4)
    answers, prior = some_answers(rng, 2, 12 * REACH, ones), Prior.of(2, 2)
    state = init(answers, prior, np.array([3, 1, 0]))
    state.log_noise[:] = LOG_NOISE
    score = resample_transitions(answers, prior, state, 1.0, rng)
    expected = np.logaddexp.reduce(log_joint(answers, prior, state).reshape(2, -1), axis=1)
    assert score == pytest.approx(expected.sum(), rel=1e-9)


def test_chains_of_many_observers_are_compared_by_the_joint_of_the_same_variables() -> None:
    """Types are merged at the end with S and ε fixed; the score is summed over both, as that of any
    other chain."""
    rng, n, observers = np.random.default_rng(5), 2, 120
    dataset = Dataset(
        features=np.arange(2.0)[:, None],
        feature_names=("place",),
        messages=("m0", "m1"),
        observers=tuple(f"o{o}" for o in range(observers)),
        observer=rng.integers(observers, size=400),
        transition=rng.integers(2, size=400),
        message_set=rng.integers(1 << n, size=400),
        label=rng.integers(0, 2, 400).astype(np.uint8),
    )
    answers, prior = SortedLabels.of(dataset), Prior.of(n, 2)
    first = rng.integers(0, 1 << n, observers)
    chain = sample(answers, prior, 0.5, first, 4, 2.0, rng)
    joint = log_joint(answers, prior, chain.best, chain.best.log_noise).reshape(2, -1)
    members = np.unique(chain.best.facts, return_counts=True)[1]
    restaurant = (np.log(0.5) - n * np.log(2) + gammaln(members)).sum()
    expected = np.logaddexp.reduce(joint, axis=1).sum() + restaurant
    assert chain.score == pytest.approx(expected, rel=1e-9)
