from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.metrics import adjusted_rand_score

from tests.learning.conftest import made
from xplain.errors import InputError
from xplain.explanation.label_table import DENSE, LabelTable
from xplain.learning.data.dataset import Dataset, query_index
from xplain.learning.data.observers import Observed
from xplain.learning.labelers import FittedLabeler, Labeler, LabelerTrainer
from xplain.learning.paper import Agglomerative, Elbow, KMeans, Partitioner, disagreements
from xplain.learning.types import Clustering
from xplain.learning.user_types import (
    AskedOnce,
    Clusterer,
    Perfect,
    Single,
    UserTypes,
    label_table,
    learn_types,
    with_none_of_these,
)


class ClustererSuite:
    """What every clusterer must hold; inherit it and name yours."""

    clusterer: Clusterer
    needs_truth = False

    def test_one_cluster_number_an_observer_by_first_appearance(self) -> None:
        dataset, truth = made(np.random.default_rng(1), [[0, 1], [2]], shared=True)
        found = self.clusterer.cluster(Observed(dataset, truth), 3)
        assert found.assignment.shape == (len(dataset.observers),)
        firsts = list(dict.fromkeys(found.assignment.tolist()))
        assert firsts == list(range(found.n_types))

    def test_same_seed_same_clusters(self) -> None:
        dataset, truth = made(np.random.default_rng(2), [[0], [1], [2, 3]], noise=0.1)
        again = [
            self.clusterer.cluster(Observed(dataset, truth), 4).assignment.tolist()
            for _ in range(2)
        ]
        assert again[0] == again[1]

    def test_the_truth_is_used_by_those_who_say_so_only(self) -> None:
        dataset, truth = made(np.random.default_rng(3), [[0], [1, 2]], shared=True)
        if self.needs_truth:
            with pytest.raises(InputError, match="clusterer"):
                self.clusterer.cluster(Observed(dataset), 0)
        else:
            found = [
                self.clusterer.cluster(Observed(dataset, known), 0).assignment.tolist()
                for known in (truth, None, truth[::-1])
            ]
            assert found[0] == found[1] == found[2]


class FindsClearTypes(ClustererSuite):
    """Those who look at the data also find types that are easy to tell apart."""

    def test_clear_types_are_found(self) -> None:
        for seed in range(3):
            rng = np.random.default_rng(seed)
            dataset, truth = made(rng, [[0, 1], [2], [1, 3]], shared=True, size=300)
            found = self.clusterer.cluster(Observed(dataset), seed)
            assert adjusted_rand_score(truth, found.assignment) == 1

    def test_people_who_never_disagree_are_one_type(self) -> None:
        dataset, _ = made(np.random.default_rng(5), [[1]], per_type=5, shared=True)
        assert self.clusterer.cluster(Observed(dataset), 0).n_types == 1


class TestKMeans(FindsClearTypes):
    clusterer = Elbow(KMeans())


class TestAgglomerative(FindsClearTypes):
    clusterer = Elbow(Agglomerative())


class TestPerfect(ClustererSuite):
    clusterer = Perfect()
    needs_truth = True


class TestSingle(ClustererSuite):
    clusterer = Single()


@pytest.mark.parametrize("partition", [KMeans(), Agglomerative(), Agglomerative("single")])
def test_partitions_keep_equal_vectors_together(partition: Partitioner) -> None:
    rng = np.random.default_rng(0)
    vectors = rng.integers(0, 2, size=(30, 3)).astype(np.uint8)
    for k in range(1, 12):
        groups = partition.partition(vectors, k, 0)
        assert len(set(groups.tolist())) <= k
        for vector in np.unique(vectors, axis=0):
            assert len(set(groups[(vectors == vector).all(axis=1)].tolist())) == 1
    assert len(set(groups.tolist())) == len(np.unique(vectors, axis=0))


def test_k_means_counts_every_observer() -> None:
    # Three points in a row, the middle one as far from either end: it joins the smaller crowd, for
    # that moves the mean of fewer.
    row = np.array([[0, 0], [0, 1], [1, 1]], dtype=np.uint8)
    for crowds, joined in (([10, 3, 1], 2), ([1, 3, 10], 0)):
        groups = KMeans().partition(np.repeat(row, crowds, axis=0), 2, 0)
        first, middle, last = (groups[i] for i in (0, crowds[0], -1))
        assert first != last
        assert middle == (first, middle, last)[joined]


def test_linkages_join_by_nearest_or_farthest_members() -> None:
    # Points at 0, 2, 4, 6 and 9 on a line: the nearest neighbours chain up to 6; by their farthest
    # members {4, 6} is nearer to 9 (5) than to {0, 2} (6).
    line = np.array([[i < place for i in range(9)] for place in (0, 2, 4, 6, 9)], dtype=np.uint8)
    for linkage, expected in (("single", [0, 0, 0, 0, 1]), ("complete", [0, 0, 1, 1, 1])):
        groups = Agglomerative(linkage).partition(line, 2, 0)
        assert (groups == groups[0]).tolist() == [one == 0 for one in expected]


def test_curve_holds_the_disagreements_up_to_as_many_clusters_as_observers(
    rng: np.random.Generator,
) -> None:
    dataset, truth = made(rng, [[0], [1]], shared=True)
    found = Elbow(KMeans()).cluster(Observed(dataset), 0)
    assert found.curve is not None
    # Two types that need a message each: together they disagree, apart never again.
    assert found.curve.tolist() == [*disagreements(dataset, [np.zeros_like(truth)]), *[0] * 5]
    assert found.curve[0] > 0
    assert found.vectors is not None
    assert found.vectors.tolist() == np.array([0b01, 0b10])[truth].tolist()


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


@pytest.mark.parametrize("weight", [float("nan"), -0.5])
def test_a_weight_of_none_of_these_below_0_is_refused(
    rng: np.random.Generator, weight: float
) -> None:
    dataset, truth = made(rng, [[0], [1]], per_type=1)
    given = Clustering(truth, "test", "given")
    types = learn_types(dataset, given, LabelerTrainer(), 0)
    with pytest.raises(InputError, match="none_of_these"):
        with_none_of_these(types, dataset, weight)


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Elbow(KMeans(), few=1.0), "few"),
        (lambda: Elbow(KMeans(), few=-0.1), "few"),
        (lambda: Elbow(KMeans(), max_types=0), "max_types"),
        (lambda: KMeans(starts=0), "starts"),
        (lambda: Agglomerative("ward"), "linkage"),
    ],
)
def test_bad_values_are_named(make: Any, key: str) -> None:
    with pytest.raises(InputError, match=rf"clusterer\.(partition\.)?{key}="):
        make()


@pytest.mark.parametrize("most", [1, 2, 4, 9])
def test_no_more_types_are_tried_than_allowed(rng: np.random.Generator, most: int) -> None:
    """Of eight observers with many different vectors."""
    dataset, _ = made(rng, [[0], [1], [2], [0, 3]], per_type=2, size=40, noise=0.3)
    found = Elbow(KMeans(), max_types=most).cluster(Observed(dataset), 0)
    assert found.curve is not None
    assert len(found.curve) == min(most, 8)
    assert found.n_types <= most


def test_known_labelers_are_not_fitted_again(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0], [1], [2]], per_type=2)
    fitted = []

    class Trainer(LabelerTrainer):
        def fit(self, dataset: Dataset, seed: int) -> Labeler:
            fitted.append(sorted(set(dataset.observer.tolist())))
            return super().fit(dataset, seed)

    def types(groups: list[int], **known: Any) -> UserTypes:
        given = Clustering(np.array(groups), "test", "given")
        return learn_types(dataset, given, Trainer(), 0, **known)

    perfect = types([0, 0, 1, 1, 2, 2])
    del fitted[:]
    # Observers 0 and 1 are together again, the others are not, and clusters come in another order.
    found = types([0, 0, 1, 2, 2, 2], known=perfect.by_observers)
    assert fitted == [[2], [3, 4, 5]]
    assert found.labelers[0] is perfect.labelers[0]


def test_labelers_are_asked_once_of_each_transition(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, truth = made(rng, [[0], [1]])
    types = learn_types(dataset, Clustering(truth, "test", "given"), LabelerTrainer(), 0)
    asked = []
    table = FittedLabeler.table
    monkeypatch.setattr(
        FittedLabeler, "table", lambda own, rows, n: asked.append(len(rows)) or table(own, rows, n)
    )
    once, n = AskedOnce(), dataset.n_messages
    for rows in ([0, 1, 0], [1, 2], [2, 0]):
        features, transitions = dataset.features[rows], np.zeros((len(rows), 3), np.int64)
        both = types.labelers[::-1]
        found = once.label_table(both, features, transitions).array(n)
        assert np.array_equal(found, label_table(both, features).array(n))
    assert len(np.unique(dataset.features[:3], axis=0)) == 3
    # Two labelers: three transitions once through the memory, every row without it.
    assert sum(asked) == 2 * 3 + 2 * 7


@dataclass(frozen=True)
class ByTransition:
    """A labeler whose table depends on the transition itself, and on ``own``. It looks at the
    first two messages."""

    own: float
    n_messages: int

    def entries(
        self, features: NDArray[np.float64], transitions: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """[T, 4]"""
        score = features.sum(axis=1) + transitions @ [3.0, 5.0, 7.0] + self.own
        return np.asarray(np.cos(score[:, None] + np.arange(4)) ** 2)

    def table(self, features: NDArray[np.float64], transitions: NDArray[np.int64]) -> LabelTable:
        both = LabelTable.by_type([[0, 1]], self.entries(features, transitions)[None])
        n = self.n_messages
        return both.over([range(n)]) if n <= DENSE else both


@pytest.mark.parametrize("n", [2, DENSE, DENSE + 1])
def test_transitions_that_share_their_features_are_told_apart_when_asked_once(n: int) -> None:
    """Beside a labeler that knows features alone, and in batches that overlap."""
    rng = np.random.default_rng(4)
    dataset, _ = made(rng, [[0]], n=n)
    labelers: Any = (ByTransition(0.1, n), LabelerTrainer().fit(dataset, 0), ByTransition(0.7, n))
    features = np.repeat(dataset.features[:3], 4, axis=0)  # four transitions of each
    transitions = rng.permutation(36).reshape(12, 3)
    once = AskedOnce()
    for rows in ([0, 1, 4, 1], [1, 2, 3, 5], [*range(12)], [11, 0, 7]):
        known = features[rows], transitions[rows]
        found, expected = once.label_table(labelers, *known), label_table(labelers, *known)
        for given in (0, 1, 3, (1 << n) - 1):
            one, other = (
                table.label_probabilities(len(rows), given) for table in (found, expected)
            )
            assert np.array_equal(one, other)
            for i in (0, 2):
                truth = labelers[i].entries(features[rows], transitions[rows])
                assert np.array_equal(one[i], truth[:, given % 4])


def test_a_labeler_is_that_of_its_labels_however_clusters_are_numbered(
    rng: np.random.Generator,
) -> None:
    """The same data give the same labeler: among other clusters, in another order, alone."""
    dataset, truth = made(rng, [[0, 1], [2], [1, 3]], noise=0.1)
    trainer = LabelerTrainer(holdout=0.4, refit=False)

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


def test_more_clusters_than_distinct_vectors_keep_the_last_partition(
    rng: np.random.Generator,
) -> None:
    """There is nothing left to part: the curve goes on level to the number of observers."""
    dataset, _ = made(rng, [[0], [1]], per_type=4, shared=True, noise=0.1)
    asked: list[int] = []

    class Counted(Agglomerative):
        def partition(self, vectors: NDArray[np.uint8], k: int, seed: int) -> NDArray[np.int64]:
            asked.append(k)
            return super().partition(vectors, k, seed)

    found = Elbow(Counted()).cluster(Observed(dataset), 0)
    assert found.vectors is not None
    assert found.curve is not None
    distinct = len(np.unique(found.vectors))
    assert asked == list(range(1, distinct + 1))
    assert len(found.curve) == 8
    assert (found.curve[distinct - 1 :] == found.curve[distinct - 1]).all()
    assert found.n_types <= distinct
