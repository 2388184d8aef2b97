"""User types from clusters and their labelers; a user's own type finder; the paper's learner:
message sets of observers, disagreements, and the elbow of their curve."""

import warnings
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.tree import DecisionTreeClassifier

from tests.learning.conftest import made
from xplain import Clustering, InputError, LearnedTypes, TooLargeError
from xplain.explanation.label_table import DENSE, LabelTable
from xplain.learning.data.dataset import Dataset, inputs
from xplain.learning.data.observers import Observations
from xplain.learning.labelers import Labeler, LabelerTrainer
from xplain.learning.paper import (
    Elbow,
    KMeans,
    disagreements,
    elbow,
    minimal_message_set,
    minimal_message_sets,
)
from xplain.learning.prediction import predict_held_out
from xplain.learning.user_types import (
    LabelTableCache,
    UserTypes,
    find_types,
    label_table,
    learn_types,
)
from xplain.testing import TypeFinderConformance


@pytest.mark.parametrize("most", [1, 2, 4, 9])
def test_no_more_types_are_tried_than_allowed(rng: np.random.Generator, most: int) -> None:
    """Eight observers have many different vectors."""
    dataset, _ = made(rng, [[0], [1], [2], [0, 3]], per_type=2, size=40, noise=0.3)
    found = Elbow(KMeans(), max_types=most).cluster(Observations(dataset), 0)
    assert len(found.curve) == min(most, 8)
    assert found.n_types <= most


@dataclass(frozen=True)
class ByTransition:
    """A labeler whose table depends on the transition itself, and on ``own``. It looks at the last
    two messages."""

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
        last = [self.n_messages - 2, self.n_messages - 1]
        return LabelTable.by_type([last], self.entries(features, transitions)[None])


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
        for told in (0, 1, 3, (1 << n) - 1):
            one, other = (table.label_probabilities(len(rows), told) for table in (found, expected))
            assert np.array_equal(one, other)
            for i in (0, 2):
                truth = labelers[i].entries(features[rows], transitions[rows])
                assert np.array_equal(one[i], truth[:, told >> n - 2])
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
    known, tables_of = find_types(Observations(dataset), LabelerTrainer(), FirstAndRest(), 0)
    assert (known.learned_types, known.type_shares) == (("a", "b"), pytest.approx([1 / 6, 5 / 6]))
    tables = tables_of(dataset.features, np.zeros((10, 3), np.int64))
    assert tables.learned.array(4)[:, 0, 0b111] == pytest.approx([0.4, 0.55])
    assert tables.perfect is None  # nobody knows the setting
    assert predict_held_out(dataset, FirstAndRest(), LabelerTrainer(), 0).types < 0
    types = FirstAndRest().find(Observations(dataset), 0)
    with pytest.raises(InputError, match="Told"):
        LearnedTypes.of(types, dataset).save(tmp_path / "types.npz")


def enumerated(classifier: object, features: NDArray[np.float64], n: int) -> int:
    """Finds the set by its definition: fewest inexplicable transitions, then fewest messages, then
    message order."""
    best: tuple[int, int] | None = None
    answer = 0
    for size in range(n + 1):
        for members in combinations(range(n), size):
            mask = sum(1 << j for j in members)
            x = inputs(features, np.full(len(features), mask), n)
            cost = int((classifier.predict(x) == 0).sum())  # type: ignore[attr-defined]
            if best is None or (cost, size) < best:
                best, answer = (cost, size), mask
    return answer


def fitted(model: object, seed: int, n: int, ones: float, rows: int = 80) -> tuple[object, NDArray]:
    """Fits a classifier to random labels. These are harder than any data, because no message set
    helps all observers."""
    rng = np.random.default_rng(seed)
    features = rng.random((8, 2)).round(2)
    x = inputs(features[rng.integers(8, size=rows)], rng.integers(1 << n, size=rows), n)
    y = (rng.random(rows) < ones).astype(int)
    y[:2] = 0, 1
    return model.fit(x, y), features  # type: ignore[attr-defined]


@given(seed=st.integers(0, 10_000), n=st.integers(1, 8), ones=st.floats(0.2, 0.95))
@settings(max_examples=60, deadline=None)
def test_tree_search_is_enumeration(seed: int, n: int, ones: float) -> None:
    classifier, features = fitted(DecisionTreeClassifier(random_state=0), seed, n, ones)
    times = np.random.default_rng(seed).integers(1, 5, size=len(features))
    features = np.repeat(features, times, axis=0)  # a transition counts as often as it occurs
    assert minimal_message_set(classifier, features, n) == enumerated(classifier, features, n)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("model", [LogisticRegression(), RandomForestClassifier(5, random_state=0)])
def test_search_by_predictions_is_enumeration(model: object, seed: int) -> None:
    classifier, features = fitted(model, seed, 5, 0.7)
    assert minimal_message_set(classifier, features, 5) == enumerated(classifier, features, 5)


def test_classifiers_that_look_at_too_many_messages_are_refused() -> None:
    tree, features = fitted(DecisionTreeClassifier(random_state=0), 0, 30, 0.5, rows=900)
    with pytest.raises(TooLargeError, match="of 30 messages"):
        minimal_message_set(tree, features, 30)
    model, features = fitted(LogisticRegression(), 0, 13, 0.7)
    with pytest.raises(TooLargeError, match="any of 13 messages"):
        minimal_message_set(model, features, 13)


def test_observers_vectors_are_what_their_type_needs(rng: np.random.Generator) -> None:
    dataset, truth = made(rng, [[0, 2], [1], []], size=400)
    needed = np.array([0b0101, 0b0010, 0])
    assert minimal_message_sets(dataset, LabelerTrainer(), 0).tolist() == needed[truth].tolist()


def test_who_gave_no_label_needs_nothing(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0], [1], [2]], per_type=1, size=200)
    heard = dataset.take(np.flatnonzero(dataset.observer != 1))
    assert minimal_message_sets(heard, LabelerTrainer(), 0).tolist() == [0b001, 0, 0b100]


def pairwise(dataset: Dataset, assignment: NDArray[np.int64]) -> int:
    """Counts disagreements by Definition 1."""
    total = 0
    for i in range(len(dataset)):
        for j in range(i):
            total += (
                assignment[dataset.observer[i]] == assignment[dataset.observer[j]]
                and dataset.transition[i] == dataset.transition[j]
                and dataset.message_set[i] == dataset.message_set[j]
                and dataset.label[i] != dataset.label[j]
            )
    return total


@given(seed=st.integers(0, 10_000), clusters=st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_counts_are_the_pairs_of_the_definition(seed: int, clusters: int) -> None:
    rng = np.random.default_rng(seed)
    dataset, _ = made(rng, [[0], [1], [0, 1]], per_type=2, size=40, n=2, noise=0.2)
    assignment = rng.integers(clusters, size=6)
    found = disagreements(dataset, [assignment, np.zeros(6, np.int64)])
    assert found.tolist() == [pairwise(dataset, one) for one in (assignment, np.zeros(6, np.int64))]


@pytest.mark.parametrize(
    ("curve", "k", "rule"),
    [
        # kneed's own answers on convex curves (see the project's notes on kneed 0.9)
        ([120, 60, 5, 4, 3, 2, 1, 0, 0], 3, "kneedle"),
        ([90, 60, 30, 1, 1, 0, 0, 0], 4, "kneedle"),
        ([50, 0, 0, 0, 0, 0, 0], 2, "kneedle"),
        # a first drop so large that kneedle stops too early: its knee stands
        ([1000, 220, 130, 70, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 3, "kneedle"),
        ([1000, 225, 51, 0, 0, 0, 0, 0], 3, "kneedle"),
        # disagreements that noise makes, which never go away
        ([1000, 600, 300, 150, 140, 135, 130, 128, 126], 4, "kneedle"),
        ([0, 0, 0, 0], 1, "flat zero"),
        ([0], 1, "flat zero"),
        # kneedle finds nothing, or an end, in these
        ([7], 1, "no knee, lowest"),
        ([7, 7, 7, 7, 7], 1, "no knee, lowest"),
        ([7, 0], 2, "no knee, few"),
        ([10, 1, 0], 3, "no knee, few"),
        ([40, 30, 20, 10, 0], 5, "no knee, few"),
        ([9, 9, 9, 9, 0], 5, "no knee, few"),
        ([100, 99, 98, 2, 1, 0, 0, 0], 4, "no knee, few"),
        ([9, 9, 9, 9, 3], 5, "no knee, lowest"),
        ([100, 99, 98, 97, 5], 5, "no knee, few"),
        # a partition may be worse than one with fewer types
        ([12, 8, 9, 2, 1, 0], 4, "kneedle"),
        ([12, 8, 3, 0, 2], 4, "no knee, few"),
    ],
)
def test_rules(curve: list[int], k: int, rule: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "xplain")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert elbow(np.array(curve), 0.05) == (k, rule)
    assert f"{k} user types by the rule {rule}" in caplog.text
