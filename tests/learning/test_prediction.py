"""What is expected to be answered, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from tests.learning.conftest import made
from xplain.learning.clustering import Clustering
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.prediction import predicted
from xplain.learning.user_types import learn_types


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
    found = predicted(few, types, asked)
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
    assert np.array_equal(found, predicted(few, types, replace(asked, label=1 - asked.label)))
