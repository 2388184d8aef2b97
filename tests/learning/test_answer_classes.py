"""Classes of answers without messages."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import betaln, gammaln
from sklearn.metrics import adjusted_rand_score

from xplain.learning.data.dataset import Dataset
from xplain.learning.data.observers import Observations
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.mixture.classes import SHRINKAGE, answer_classes
from xplain.learning.mixture.sampler import DirichletMixture
from xplain.learning.prediction import predict_held_out


def answered(labels: np.ndarray, asked: np.ndarray | None = None) -> Dataset:
    """Makes labels [O, T] of items with different numbers, only those ``asked`` [O, T]."""
    observers, items = labels.shape
    o, t = np.nonzero(np.ones_like(labels) if asked is None else asked)
    nothing = np.zeros(len(o), dtype=np.int64)
    features = np.arange(float(items))[:, None]
    names = tuple(f"o{i:03d}" for i in range(observers))
    return Dataset(features, ("item",), (), names, o, t, nothing, labels[o, t].astype(np.uint8))


def people(seed: int, per_class: int = 60, items: int = 12) -> tuple[Dataset, np.ndarray, float]:
    """Draws people of three classes; items have slips and guesses up to 0.3. Returns also each
    person's class, and the agreement index of a judge who knows all rates."""
    rng = np.random.default_rng(seed)
    true = rng.random((3, items)) < 0.5
    slip, guess = rng.uniform(0, 0.3, (2, items))
    truth = np.repeat(np.arange(3), per_class)
    one = np.where(true, 1 - slip, guess)
    labels = rng.random((len(truth), items)) < one[truth]
    likely = (labels @ np.log(one).T + ~labels @ np.log(1 - one).T).argmax(axis=1)
    return answered(labels), truth, adjusted_rand_score(truth, likely)


def partitions(count: int):
    """Lists all partitions into classes, as the class of each person."""

    def grow(begun: list[int]):
        if len(begun) == count:
            yield np.array(begun)
            return
        for k in range(max(begun, default=-1) + 2):
            yield from grow([*begun, k])

    return list(grow([]))


def restaurant(sizes: np.ndarray) -> float:
    """Computes log P(partition), where α is drawn from an exponential of mean 1."""
    n, k = int(sizes.sum()), len(sizes)

    def weigh(alpha: float) -> float:
        return float(np.exp(k * np.log(alpha) + gammaln(alpha) - gammaln(alpha + n) - alpha))

    return float(np.log(quad(weigh, 0, np.inf)[0]) + gammaln(sizes).sum())


def test_what_is_expected_is_that_of_all_partitions() -> None:
    labels = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1], [0, 1, 1]])
    asked = np.array([[1, 1, 1], [1, 1, 0], [1, 1, 1], [0, 1, 1]])
    data = answered(labels, asked)
    mean = ((labels * asked).sum(axis=0) + 1) / (asked.sum(axis=0) + 2)
    total, expected, number = 0.0, np.zeros((4, 3)), np.zeros(5)
    for partition in partitions(4):
        member = partition == np.arange(partition.max() + 1)[:, None]
        ones, zeros = member @ (labels * asked), member @ ((1 - labels) * asked)
        prior = restaurant(member.sum(axis=1))
        for c in SHRINKAGE:
            first, second = c * mean, c * (1 - mean)
            evidence = betaln(first + ones, second + zeros) - betaln(first, second)
            weight = np.exp(prior + evidence.sum())
            total += weight
            number[len(member)] += weight
            expected += weight * ((first + ones) / (c + ones + zeros))[partition]
    found = answer_classes(data, 1.0, 20, 0)
    assert found.expected == pytest.approx(expected / total, abs=0.02)
    for k, share in found.posterior.items():
        assert share == pytest.approx(number[k] / total, abs=0.03)


def test_classes_are_found_and_predict_better_than_means() -> None:
    data, truth, at_best = people(0)
    found = DirichletMixture().cluster(Observations(data), 0)
    assert adjusted_rand_score(truth, found.assignment) > at_best - 0.2
    assert found.n_types in (3, 4)
    assert found.expected is not None
    assert found.expected.shape == (180, 12)
    known = predict_held_out(data, DirichletMixture(), LabelerTrainer(), 0)
    assert known.gain[0] > 0
    assert known.types > max(known.one_type, known.question_mean)
    assert "better" in known.verdict


def test_answers_without_types_support_none() -> None:
    rng = np.random.default_rng(0)
    labels = rng.random((80, 10)) < rng.random(10)
    known = predict_held_out(answered(labels), DirichletMixture(), LabelerTrainer(), 0)
    assert known.gain[0] <= 0
    assert known.types > known.question_mean - 0.02  # and cost next to nothing
    assert "not" in known.verdict
