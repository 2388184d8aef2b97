"""Predicted answers, compared with results by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from tests.learning.conftest import made
from xplain.learning.data.dataset import Dataset
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.prediction import calibration, predict, predict_held_out
from xplain.learning.types import Clustering
from xplain.learning.user_types import Single, learn_types


def test_an_observer_is_predicted_by_the_types_that_their_labels_speak_for(
    rng: np.random.Generator,
) -> None:
    """Bayes' rule by hand, for known observers and new ones, whose names come in another order."""
    dataset, truth = made(rng, [[0], [1, 2]], size=60)
    types = learn_types(dataset, Clustering(truth, "true", ""), LabelerTrainer(), 0)
    assert np.ptp(types.prior) == 0
    types = replace(types, prior=np.array([0.3, 0.7]))
    few = dataset.take(np.flatnonzero(np.arange(len(dataset)) % 7 == 0))
    asked = replace(
        dataset.take(np.arange(20)),
        observers=("new", *dataset.observers[::-1]),
        observer=np.arange(20) % (len(dataset.observers) + 1),
    )
    found = predict(few, types, asked)
    for p in range(20):
        name = asked.observers[asked.observer[p]]
        weight = types.prior.copy()
        if name != "new":
            own = few.of(np.array([few.observers.index(name)]))
            for t, labeler in enumerate(types.labelers):
                one = labeler.probability(own.features[own.transition], own.message_set)
                weight[t] *= np.where(own.label == 1, one, 1 - one).prod()
        row, told = asked.features[asked.transition[[p]]], asked.message_set[[p]]
        each = [labeler.probability(row, told)[0] for labeler in types.labelers]
        assert found[p] == pytest.approx(weight @ each / weight.sum())
    assert np.ptp(found) > 0.1
    assert np.array_equal(found, predict(few, types, replace(asked, label=1 - asked.label)))


def test_intervals_of_calibration_are_wilsons():
    """The ends of an interval solve |ones − p| = z √(p (1 − p) / n)."""
    [one] = calibration(np.full(1, 0.5), np.array([1], dtype=np.uint8))
    many = calibration(np.linspace(0, 1, 57), np.tile([1, 0, 0], 19).astype(np.uint8))
    for part in (one, *many):
        for end in (part.low, part.high):
            reached = norm.ppf(0.975) * np.sqrt(end * (1 - end) / part.labels)
            assert abs(part.ones - end) == pytest.approx(reached, abs=1e-9)
    assert sum(part.labels for part in many) == 57


@pytest.mark.parametrize("count", [2, 4])
def test_of_few_labels_one_is_held_out_and_one_is_learned_from(count: int) -> None:
    """Labels are without messages; each label is held out with probability 1/4."""
    rows = np.arange(count)
    dataset = Dataset(
        rows[:, None].astype(float), ("place",), ("m",), ("a", "b"),
        rows % 2, rows, np.zeros(count, np.int64), (rows % 2).astype(np.uint8),
    )  # fmt: skip
    for seed in range(40):
        found = predict_held_out(dataset, Single(), LabelerTrainer(), seed)
        assert 1 <= sum(part.labels for part in found.calibration) < count
        assert np.isfinite([found.types, found.one_type, found.question_mean, *found.gain]).all()
