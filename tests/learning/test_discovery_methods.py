"""Methods for independent questions: mixtures and the Dirichlet process."""

from math import lgamma

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import adjusted_rand_score

from tests.learning.conftest import made
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observed
from xplain.learning.mixture.kernels import WIDE
from xplain.learning.mixture.sampler import (
    CELL,
    MANY_OBSERVERS,
    NOISE,
    DirichletMixture,
    Prior,
    SortedLabels,
    sample,
)

TYPES = [[0, 1], [2], [1, 3]]


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.1, 0.15])
def test_types_are_found_and_noise_makes_none(noise: float) -> None:
    """Nobody answers the same questions. A model that fits the errors would find one type for each
    observer."""
    seed = int(100 * noise)
    dataset, truth = made(np.random.default_rng(seed), TYPES, size=250, noise=noise)
    found = DirichletMixture().cluster(Observed(dataset), seed)
    assert adjusted_rand_score(truth, found.assignment) == 1


def test_the_posterior_is_a_distribution_and_no_more_certain_than_the_data() -> None:
    dataset, _ = made(np.random.default_rng(5), TYPES, size=250)
    sure = DirichletMixture().cluster(Observed(dataset), 0).posterior
    scarce = dataset.take(np.flatnonzero(np.arange(len(dataset)) % 25 == 0))
    unsure = DirichletMixture().cluster(Observed(scarce), 0).posterior
    assert sure is not None
    assert unsure is not None
    for posterior in (sure, unsure):
        assert sum(posterior.values()) == pytest.approx(1)
    assert sure[3] > 0.9
    assert max(unsure.values()) < sure[3]


@pytest.mark.parametrize("n", [20, 30])
def test_more_messages_than_are_tried_at_once(n: int) -> None:
    assert n > WIDE
    dataset, truth = made(np.random.default_rng(8), [[0, 7], [3], [2, 5], [1, 4]], n=n, size=200)
    found = DirichletMixture(depth=2).cluster(Observed(dataset), 0)
    assert adjusted_rand_score(truth, found.assignment) == 1


def test_no_type_stays_split_among_many_observers() -> None:
    dataset, truth = made(
        np.random.default_rng(2), [[0], [1, 2], [3]], per_type=80, size=60, noise=0.05
    )
    found = DirichletMixture(chains=2, sweeps=30).cluster(Observed(dataset), 0)
    assert adjusted_rand_score(truth, found.assignment) == 1


@pytest.mark.parametrize(
    ("observers", "concentration", "temperature"),
    [
        (MANY_OBSERVERS + 20, 0.3, 1.0),
        (MANY_OBSERVERS + 20, 4.0, 1.0),
        (12, 0.3, 1.0),
        (12, 0.3, 1000.0),  # heated sweeps are not drawn from the prior, and count for nothing
    ],
)
def test_observers_whose_answers_say_nothing_share_types_as_the_process_has_it(
    observers: int, concentration: float, temperature: float
) -> None:
    """After all messages no label depends on the type, so the sampler draws from the prior, an urn
    with α / 4 balls of each of the four fact sets."""
    everybody = np.arange(observers)
    dataset = Dataset(
        features=np.arange(24.0)[:, None],
        feature_names=("place",),
        messages=("m0", "m1"),
        observers=tuple(f"o{o}" for o in everybody),
        observer=everybody,
        transition=everybody % 24,
        message_set=np.full(observers, 3),
        label=(everybody % 5 > 1).astype(np.uint8),
    )
    answers, prior = SortedLabels.of(dataset), Prior.of(2, 2)
    first = np.zeros(observers, dtype=np.int64)
    rng = np.random.default_rng(1)
    found = sample(answers, prior, concentration, first, 2000, temperature, rng).types
    assert len(found) == 1000
    step = np.arange(observers)
    not_one = np.log((step + 0.75 * concentration) / (step + concentration)).sum()
    batches = found.reshape(20, -1).mean(axis=1)
    error = batches.std(ddof=1) / 20**0.5
    assert batches.mean() == pytest.approx(4 * (1 - np.exp(not_one)), abs=4 * error + 0.005)


def log_evidence(ones: int, zeros: int, noise: float, prior: float) -> float:
    right, wrong = np.log1p(-noise), np.log(noise)
    return float(
        np.logaddexp(
            np.log(prior) + ones * right + zeros * wrong,
            np.log1p(-prior) + ones * wrong + zeros * right,
        )
    )


@pytest.mark.parametrize("n", [2, 10])
@given(seed=st.integers(0, 1000))
@settings(max_examples=3, deadline=None)
def test_score_is_the_joint_probability_by_its_definition(n: int, seed: int) -> None:
    dataset, _ = made(np.random.default_rng(seed), [[0], [1]], per_type=2, size=25 * n, n=n)
    answers, prior = SortedLabels.of(dataset), Prior.of(n, 2)
    everything = (1 << n) - 1
    first = np.array([0, 1, everything, everything])
    rng = np.random.default_rng(seed)
    # One sweep: the score is that of the first state, before anything is drawn.
    score = sample(answers, prior, 0.7, first, 1, 1.0, rng).score
    expected = 3 * (np.log(0.7) - n * np.log(2)) + 2 * lgamma(1) + lgamma(2)
    held = first[dataset.observer] & ~dataset.message_set
    for t in range(len(dataset.features)):
        rows = dataset.transition == t
        terms = []
        for z, positions in enumerate(prior.subsets):
            mask = sum(1 << int(j) for j in positions if j >= 0)
            for noise in NOISE:
                value = prior.log_subset[z] - np.log(len(NOISE))
                for cell in np.unique(held[rows] & mask):
                    labels = dataset.label[rows & (held & mask == cell)]
                    ones = int(labels.sum())
                    before = CELL[int(cell == 0)]
                    value += log_evidence(ones, len(labels) - ones, noise, before)
                terms.append(value)
        expected += np.logaddexp.reduce(terms)
    assert score == pytest.approx(expected, abs=1e-6)
