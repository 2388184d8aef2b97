"""Methods for independent questions: mixtures and the Dirichlet process."""

from typing import Any

import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score

from tests.learning.conftest import made
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observed
from xplain.learning.mixture import sampler
from xplain.learning.mixture.kernels import WIDE
from xplain.learning.mixture.sampler import (
    DirichletMixture,
    Prior,
    SortedLabels,
    sample,
)

TYPES = [[0, 1], [2], [1, 3]]
FOUR = [[0, 7], [3], [2, 5], [1, 4]]


@pytest.mark.parametrize(
    ("types", "seed", "options", "method"),
    [
        # A model that fits the errors finds a type an observer.
        *((TYPES, int(100 * x), {"size": 250, "noise": x}, {}) for x in (0.0, 0.05, 0.1, 0.15)),
        # More messages than are tried at once.
        *((FOUR, 8, {"n": n, "size": 200}, {"depth": 2}) for n in (WIDE + 10, WIDE + 20)),
        # No type stays split among many observers.
        (
            [[0], [1, 2], [3]],
            2,
            {"per_type": 80, "size": 60, "noise": 0.05},
            {"chains": 2, "sweeps": 30},
        ),
    ],
)
def test_types_are_found_and_noise_makes_none(
    types: list[list[int]], seed: int, options: dict[str, Any], method: dict[str, Any]
) -> None:
    """Nobody answers the same questions."""
    dataset, truth = made(np.random.default_rng(seed), types, **options)
    found = DirichletMixture(**method).cluster(Observed(dataset), 0)
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


@pytest.mark.parametrize(
    ("observers", "concentration", "temperature"),
    [
        (20, 0.3, 1.0),
        (20, 4.0, 1.0),
        (12, 0.3, 1.0),
        (12, 0.3, 1000.0),  # heated sweeps are not drawn from the prior, and count for nothing
    ],
)
def test_observers_whose_answers_say_nothing_share_types_as_the_process_has_it(
    observers: int, concentration: float, temperature: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After all messages no label depends on the type, so the sampler draws from the prior, an urn
    with α / 4 balls of each of the four fact sets. Twenty observers count as many here."""
    monkeypatch.setattr(sampler, "MANY_OBSERVERS", 20)
    monkeypatch.setattr(sampler, "MOVES", 5)
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
