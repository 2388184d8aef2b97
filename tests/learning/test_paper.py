"""The paper's learner: message sets of observers, disagreements, and the elbow of their curve."""

import warnings
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kneed import KneeLocator
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.tree import DecisionTreeClassifier

from tests.learning.conftest import made
from xplain.errors import TooLargeError
from xplain.learning.data.dataset import Dataset, inputs
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.paper import disagreements, elbow, minimal_message_set, minimal_message_sets


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
    ],
)
def test_rules(curve: list[int], k: int, rule: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "xplain")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert elbow(np.array(curve), 0.05) == (k, rule)
    assert f"{k} user types by the rule {rule}" in caplog.text


@given(st.lists(st.integers(0, 500), min_size=1, max_size=15), st.floats(0, 0.3))
@settings(max_examples=300, deadline=None)
def test_a_knee_that_kneedle_finds_stands(drops: list[int], few: float) -> None:
    """The knee is used for any remaining disagreements; the other rules are for curves without a
    knee."""
    curve = np.array(drops)
    k, rule = elbow(curve, few)
    left = np.minimum.accumulate(curve)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        places = range(1, len(left) + 1)
        knee = KneeLocator(places, left.tolist(), curve="convex", direction="decreasing").knee
    bends = knee is not None and 1 < knee < len(left)
    allowed = few * curve[0]
    assert (rule == "flat zero") == (curve[0] == 0)
    assert (rule == "kneedle") == (bends and curve[0] > 0)
    if rule == "flat zero":
        assert k == 1
    elif rule == "kneedle":
        assert k == knee
    elif left[-1] <= allowed:
        assert rule == "no knee, few"
        assert left[k - 1] <= allowed
        assert (left[: k - 1] > allowed).all()
    else:
        assert rule == "no knee, lowest"
        assert left[k - 1] == left[-1]
        assert (left[: k - 1] > left[-1]).all()
