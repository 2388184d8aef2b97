"""A user's own type finder with its own labelers works without other changes."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.learning.conftest import made
from xplain.errors import InputError
from xplain.explanation.label_table import LabelTable
from xplain.learning.data.observers import Observed
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.learning.prediction import predict_held_out
from xplain.learning.saved import LearnedTypes
from xplain.learning.types import Clustering
from xplain.learning.user_types import UserTypes, find_types
from xplain.testing import TypeFinderConformance


class Told(Labeler):
    """A labeler of people who find more transitions explicable after more messages."""

    def __init__(self, n_messages: int, step: float) -> None:
        self.n_messages, self.step = n_messages, step

    def table(self, features: NDArray[np.float64], transitions: Any = None) -> LabelTable:
        """Returns the table of all transitions."""
        told = np.bitwise_count(np.arange(1 << self.n_messages))
        return LabelTable.dense([np.tile(0.1 + self.step * told, (len(features), 1))])


class FirstAndRest:
    """The first observer is one type, all others are another."""

    def find(self, observed: Observed, seed: int) -> UserTypes:
        """Finds the two types."""
        n = observed.dataset.n_messages
        group = (np.arange(len(observed.dataset.observers)) > 0).astype(np.int64)
        found = Clustering(group, "own", "the first")
        labelers = tuple(Told(n, 0.1 + 0.05 * t) for t in range(found.n_types))
        return UserTypes(labelers, found, ("a", "b")[: len(labelers)], found.shares)


class TestFirstAndRest(TypeFinderConformance):
    finds_types = False

    @pytest.fixture
    def component(self) -> FirstAndRest:
        return FirstAndRest()

    def test_observers_who_answer_alike_are_of_one_type(self, component: Any) -> None:
        """Not here."""


def test_its_types_are_what_agents_know(tmp_path: Any) -> None:
    dataset, _ = made(np.random.default_rng(0), [[0], [1]])
    known = find_types(Observed(dataset), LabelerTrainer(), FirstAndRest(), 0)
    assert known.names == ("a", "b")
    assert known.shares == pytest.approx([1 / 6, 5 / 6])
    tables = known.tables(dataset.features, np.zeros((10, 3), np.int64))
    assert tables.learned.array(4)[:, 0, 0b111] == pytest.approx([0.4, 0.55])
    assert tables.perfect is None  # nobody knows the setting
    assert predict_held_out(dataset, FirstAndRest(), LabelerTrainer(), 0).types < 0
    types = FirstAndRest().find(Observed(dataset), 0)
    with pytest.raises(InputError, match="Told"):
        LearnedTypes.of(types, dataset).save(tmp_path / "types.npz")
