"""User types from clusters and their labelers; a user's own type finder with its own labelers."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.learning.conftest import made
from xplain.errors import InputError
from xplain.explanation.label_table import DENSE, LabelTable
from xplain.learning.data.dataset import Dataset, query_index
from xplain.learning.data.observers import Observations
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.learning.paper import Elbow, KMeans
from xplain.learning.prediction import predict_held_out
from xplain.learning.saved import LearnedTypes
from xplain.learning.types import Clustering
from xplain.learning.user_types import (
    LabelTableCache,
    UserTypes,
    find_types,
    label_table,
    learn_types,
)
from xplain.testing import TypeFinderConformance


def test_types_are_fitted_to_their_own_observers(rng: np.random.Generator) -> None:
    dataset, truth = made(rng, [[0], [1], [2]], per_type=2, size=400)
    truth = np.array([0, 0, 0, 0, 1, 1])
    types = learn_types(dataset, Clustering(truth, "test", "given"), LabelerTrainer(), 0)
    assert types.prior == pytest.approx([2 / 3, 1 / 3])
    for t, labeler in enumerate(types.labelers):
        own = dataset.of(np.flatnonzero(truth == t))
        assert labeler.n_train + labeler.n_test == len(np.unique(query_index(own)))
    table = label_table(types.labelers, dataset.features).array(dataset.n_messages)
    assert table.shape == (2, len(dataset.features), 16)
    # The last type needs message 2 at transition 2, whatever else is said.
    assert (table[1, 2] > 0.5).tolist() == [bool(h & 4) for h in range(16)]


@pytest.mark.parametrize("most", [1, 2, 4, 9])
def test_no_more_types_are_tried_than_allowed(rng: np.random.Generator, most: int) -> None:
    """Eight observers have many different vectors."""
    dataset, _ = made(rng, [[0], [1], [2], [0, 3]], per_type=2, size=40, noise=0.3)
    found = Elbow(KMeans(), max_types=most).cluster(Observations(dataset), 0)
    assert found.curve is not None
    assert len(found.curve) == min(most, 8)
    assert found.n_types <= most


@dataclass(frozen=True)
class ByTransition:
    """A labeler whose table depends on the transition itself, and on ``own``. It looks at the
    first two messages."""

    own: float
    n_messages: int
    asked: list[int] = field(default_factory=list)

    def entries(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """[T, 4]"""
        score = features.sum(axis=1) + transitions @ [3.0, 5.0, 7.0] + self.own
        return np.asarray(np.cos(score[:, None] + np.arange(4)) ** 2)

    def table(self, features: NDArray[np.float64], transitions: NDArray[np.int64]) -> LabelTable:
        self.asked.append(len(features))
        both = LabelTable.by_type([[0, 1]], self.entries(features, transitions)[None])
        n = self.n_messages
        return both.select_messages([range(n)]) if n <= DENSE else both


@pytest.mark.parametrize("n", [2, DENSE, DENSE + 1])
def test_transitions_that_share_their_features_are_told_apart_when_asked_once(n: int) -> None:
    """This holds together with a labeler that knows only features, and in overlapping batches."""
    rng = np.random.default_rng(4)
    dataset, _ = made(rng, [[0]], n=n)
    labelers: Any = (ByTransition(0.1, n), LabelerTrainer().fit(dataset, 0), ByTransition(0.7, n))
    others = replace(labelers[0], asked=[]), *labelers[1:]
    features = np.repeat(dataset.features[:3], 4, axis=0)  # four transitions of each
    transitions = rng.permutation(36).reshape(12, 3)
    once = LabelTableCache()
    for rows in ([0, 1, 4, 1], [1, 2, 3, 5], [*range(12)], [11, 0, 7]):
        known = features[rows], transitions[rows]
        found, expected = once.label_table(labelers, *known), label_table(others, *known)
        for given in (0, 1, 3, (1 << n) - 1):
            one, other = (
                table.label_probabilities(len(rows), given) for table in (found, expected)
            )
            assert np.array_equal(one, other)
            for i in (0, 2):
                truth = labelers[i].entries(features[rows], transitions[rows])
                assert np.array_equal(one[i], truth[:, given % 4])
    assert sum(labelers[0].asked) == (12 if n <= DENSE else 23)  # each transition once


def test_a_labeler_is_that_of_its_labels_however_clusters_are_numbered(
    rng: np.random.Generator,
) -> None:
    """The same data give the same labeler with other clusters, in another order, and alone."""
    dataset, truth = made(rng, [[0, 1], [2], [1, 3]], noise=0.1)
    trainer = LabelerTrainer(holdout=0.4)

    def tables(data: Dataset, assignment: NDArray[np.int64]) -> list[NDArray[np.float64]]:
        types = learn_types(data, Clustering(assignment, "test", "given"), trainer, 7)
        return list(label_table(types.labelers, data.features).array(data.n_messages))

    # Those of the last type come first, so that clusters are numbered the other way round.
    order = np.argsort(-truth, kind="stable")
    place = np.argsort(order)
    rows = np.argsort(place[dataset.observer], kind="stable")
    turned = replace(dataset.take(rows), observer=place[dataset.observer[rows]])
    found = tables(dataset, truth)
    for one, other in zip(found, reversed(tables(turned, truth[order])), strict=True):
        assert np.array_equal(one, other)
    assert np.array_equal(tables(dataset, np.minimum(truth, 1))[0], found[0])
    everyone = trainer.fit(dataset, 7).table(dataset.features).array(dataset.n_messages)[0]
    assert np.array_equal(tables(dataset, truth * 0)[0], everyone)


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

    def find(self, observed: Observations, seed: int) -> UserTypes:
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
    known = find_types(Observations(dataset), LabelerTrainer(), FirstAndRest(), 0)
    assert known.names == ("a", "b")
    assert known.shares == pytest.approx([1 / 6, 5 / 6])
    tables = known.tables(dataset.features, np.zeros((10, 3), np.int64))
    assert tables.learned.array(4)[:, 0, 0b111] == pytest.approx([0.4, 0.55])
    assert tables.perfect is None  # nobody knows the setting
    assert predict_held_out(dataset, FirstAndRest(), LabelerTrainer(), 0).types < 0
    types = FirstAndRest().find(Observations(dataset), 0)
    with pytest.raises(InputError, match="Told"):
        LearnedTypes.of(types, dataset).save(tmp_path / "types.npz")
