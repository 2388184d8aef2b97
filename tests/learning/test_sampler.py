"""The sampler's steps and score, compared with posteriors of which all states are enumerated, and
the types that it finds."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import gammaln
from sklearn.metrics import adjusted_rand_score

from tests.learning.conftest import made
from tests.refusals import refused
from xplain.errors import TooLargeError
from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations
from xplain.learning.mixture import sampler
from xplain.learning.mixture.kernels import REACH, WIDE, resample_facts
from xplain.learning.mixture.sampler import (
    CELL,
    NOISE,
    ChainState,
    DirichletMixture,
    Prior,
    SortedLabels,
    init,
    resample_transitions,
    sample,
    split_merge,
)

LOG_NOISE = np.log(np.arange(1.0, len(NOISE) + 1) / np.arange(1.0, len(NOISE) + 1).sum())
"""Some prior over the levels of noise."""
CONCENTRATION = 0.7


def some_answers(
    rng: np.random.Generator, n: int, size: int, observers: int = 3, ones: float = 0.5
) -> SortedLabels:
    """Draws answers about three transitions, under any messages."""
    dataset = Dataset(
        features=np.arange(3.0)[:, None],
        feature_names=("place",),
        messages=tuple(f"m{j}" for j in range(n)),
        observers=tuple(f"o{o}" for o in range(observers)),
        observer=rng.integers(observers, size=size),
        transition=rng.integers(3, size=size),
        message_set=rng.integers(1 << n, size=size),
        label=(rng.random(size) < ones).astype(np.uint8),
    )
    return SortedLabels.of(dataset)


def counted(answers: SortedLabels, prior: Prior, state: ChainState) -> NDArray[np.int64]:
    """Counts [T, 2^depth, 2] the labels 0 and 1 of each cell, from the labels themselves."""
    counts = np.zeros_like(state.counts)
    held = state.facts[answers.owner] & ~answers.message_set
    for t, mask, label in zip(answers.transition, held, answers.label, strict=True):
        members = [int(j) for j in prior.subsets[state.subset[t]] if j >= 0]
        counts[t, sum((int(mask) >> j & 1) << i for i, j in enumerate(members)), label] += 1
    return counts


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
    ("sweeps", "temperature", "seed", "rare"),
    [
        *((300, 1.0, seed, 1e-3) for seed in range(3)),
        (300, 2.0, 300, 1e-3),
        *((20, temperature, 20, 3e-3) for temperature in (1.0, 2.0)),
    ],
)
def test_two_observers_are_drawn_from_their_posterior(
    sweeps: int, temperature: float, seed: int, rare: float
) -> None:
    """One by one, or by splits and merges of types, of which a sweep has twenty. A pair of fact
    sets as ``rare`` as this may never be drawn."""
    rng, n = np.random.default_rng(seed), 2
    answers, prior = some_answers(rng, n, 18, 2), Prior.of(n, 2)
    state = init(answers, prior, rng.integers(1 << n, size=2))
    while not (prior.size[state.subset] > 0).any():  # some fact matters
        resample_transitions(answers, prior, state, 1.0, rng)
    log_new, room = np.log(CONCENTRATION) - n * np.log(2), np.zeros(2, dtype=np.int64)
    visits = np.zeros((20, 1 << n, 1 << n))
    for batch in visits:
        for _ in range(sweeps):
            if sweeps < 100:
                split_merge(answers, prior, state, log_new, temperature, rng)
            else:
                used, members = np.unique(state.facts, return_counts=True)
                in_use = np.append(used, room), np.append(members, room), len(used)
                resample_facts(answers, prior, state, *in_use, log_new, temperature, rng)
            batch[tuple(state.facts)] += 1 / sweeps
    assert (state.counts == counted(answers, prior, state)).all()
    expected = np.empty((1 << n, 1 << n))
    for both in product(range(1 << n), repeat=2):
        facts = np.array(both)
        of_labels = log_joint(answers, prior, state._replace(facts=facts))
        drawn = of_labels[np.arange(3), state.subset, state.noise]
        restaurant = (both[0] == both[1]) + CONCENTRATION / 2**n
        expected[both] = (restaurant * np.exp(drawn.sum())) ** (1 / temperature)
    error = visits.std(axis=0, ddof=1) / len(visits) ** 0.5
    off = np.abs(visits.mean(axis=0) - expected / expected.sum())
    assert (off < 5 * error + rare).all()


@pytest.mark.parametrize(
    ("n", "depth", "size", "temperature"),
    [
        (2, 2, 36, 1.0),
        (2, 2, 36, 3.0),
        # Few labels, so that no fact may matter, which more blocks are drawn from than one.
        (WIDE + 18, 1, 9, 1.0),
    ],
)
def test_subsets_and_noise_are_drawn_from_their_posterior(
    n: int, depth: int, size: int, temperature: float
) -> None:
    rng = np.random.default_rng(3)
    answers, prior = some_answers(rng, n, size, ones=0.6), Prior.of(n, depth)
    state = init(answers, prior, np.array([(1 << n) - 1, 1, 3]))
    visits = np.zeros((20, 3, len(prior.size), len(NOISE)))
    for batch in visits:
        for _ in range(400):
            state.log_noise[:] = LOG_NOISE
            resample_transitions(answers, prior, state, temperature, rng)
            batch[np.arange(3), state.subset, state.noise] += 1 / 400
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
    answers, prior = some_answers(rng, 2, 12 * REACH, ones=ones), Prior.of(2, 2)
    state = init(answers, prior, np.array([3, 1, 0]))
    state.log_noise[:] = LOG_NOISE
    score = resample_transitions(answers, prior, state, 1.0, rng)
    expected = np.logaddexp.reduce(log_joint(answers, prior, state).reshape(3, -1), axis=1)
    assert score == pytest.approx(expected.sum(), rel=1e-9)


@pytest.mark.parametrize(
    ("observers", "n", "size", "sweeps"),
    [(12, 2, 50, 1), (4, 10, 250, 1), (120, 2, 400, 4), (100, WIDE + 2, 200, 1)],
)
def test_chains_are_compared_by_the_joint_of_the_same_variables(
    observers: int, n: int, size: int, sweeps: int
) -> None:
    """After one sweep it is that of the first state. Types of many observers are merged at the end
    with S and ε fixed; the score is summed over both, as that of any other chain. With many
    messages it is that of one S and ε."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        answers, prior = some_answers(rng, n, size, observers), Prior.of(n, 2)
        first = rng.integers(0, 1 << min(n, 10), observers) >> (8 if n > WIDE else 0)
        chain = sample(answers, prior, CONCENTRATION, first, sweeps, 2.0, rng)
        even = np.full(len(NOISE), -np.log(len(NOISE)))
        log_noise = even if sweeps == 1 else chain.best.log_noise
        joint, best = log_joint(answers, prior, chain.best, log_noise), chain.best
        expected = np.logaddexp.reduce(joint.reshape(3, -1), axis=1).sum()
        if n > WIDE:
            expected = joint[np.arange(3), best.subset, best.noise].sum()
            assert len(np.unique(best.facts)) < len(np.unique(first))
        members = np.unique(chain.best.facts, return_counts=True)[1]
        expected += (np.log(CONCENTRATION) - n * np.log(2) + gammaln(members)).sum()
        # A merge counts α / 2^n balls of each fact set, the restaurant the first of them.
        assert chain.score == pytest.approx(expected, rel=1e-5 if n > WIDE else 1e-9)


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
    found = DirichletMixture(**method).cluster(Observations(dataset), 0)
    assert adjusted_rand_score(truth, found.assignment) == 1


def test_the_posterior_is_a_distribution_and_no_more_certain_than_the_data() -> None:
    dataset, _ = made(np.random.default_rng(5), TYPES, size=250)
    sure = DirichletMixture().cluster(Observations(dataset), 0).posterior
    scarce = dataset.take(np.flatnonzero(np.arange(len(dataset)) % 25 == 0))
    unsure = DirichletMixture().cluster(Observations(scarce), 0).posterior
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


def test_too_many_sets_of_messages_are_refused() -> None:
    dataset, _ = made(np.random.default_rng(0), [[0]], size=5, n=19)
    with refused("depth=5: too many sets of 19 messages; at most 4", kind=TooLargeError):
        DirichletMixture(depth=5).cluster(Observations(dataset), 0)
