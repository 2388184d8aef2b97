"""Labelers: predictions, confidence, and the accuracy on held-out questions; answers by hand."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from sklearn.ensemble import GradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.tree import DecisionTreeClassifier

from tests.domains.configs import domain_of
from tests.learning.conftest import made
from xplain import Clustering, Setting, TooLargeError
from xplain.domains.users.types import RandomCover
from xplain.learning.data.dataset import Dataset, inputs, query_index
from xplain.learning.data.observers import SimulatedObservers
from xplain.learning.data.queries import Independent, Shared
from xplain.learning.labelers import FittedLabeler, LabelerTrainer, fresh_accuracy, split
from xplain.learning.prediction import (
    calibration,
    log_likelihood,
    log_likelihoods,
    predict_held_out,
)
from xplain.learning.user_types import Single, learn_types
from xplain.randomness import derive_seed


def fitted(
    classifier: Any, n: int, confidence: float, tested: int, calibrated: bool = False
) -> FittedLabeler:
    return FittedLabeler(
        classifier=classifier,
        n_messages=n,
        confidence=confidence,
        n_test=tested,
        calibrated=calibrated,
    )


@given(seed=st.integers(0, 10_000), size=st.integers(2, 60), holdout=st.floats(0.05, 0.95))
@settings(max_examples=40, deadline=None)
def test_no_point_is_on_both_sides_of_a_split(seed: int, size: int, holdout: float) -> None:
    dataset, _ = made(np.random.default_rng(seed), [[0]], size=size, n=2)
    test = split(dataset, holdout, seed)
    pairs = list(zip(dataset.transition.tolist(), dataset.message_set.tolist(), strict=True))
    held = {pair for pair, out in zip(pairs, test, strict=True) if out}
    kept = {pair for pair, out in zip(pairs, test, strict=True) if not out}
    assert not held & kept
    assert kept
    assert held or len(set(pairs)) == 1


@pytest.mark.parametrize("repeats", [1, 2, 5])
def test_confidence_is_the_smoothed_share_of_held_out_questions_got_right(
    rng: np.random.Generator, repeats: int
) -> None:
    """Each question counts once, however often it was answered; with different answers the share of
    right answers counts."""
    once, _ = made(rng, [[0, 1]], noise=0.15)
    dataset = once.take(np.repeat(np.arange(len(once)), repeats))
    labeler, seed = LabelerTrainer().fit(dataset, 7), derive_seed(7, "labelers")
    dataset = dataset.take(np.lexsort((dataset.label, dataset.message_set, dataset.transition)))
    held = split(dataset, 0.25, seed)
    train, test = (dataset.take(np.flatnonzero(rows)) for rows in (~held, held))
    trained = LabelerTrainer().fit_unmeasured(train, seed)
    said = trained.predict(test.features[test.transition], test.message_set)
    votes: dict[tuple[int, int], list[bool]] = {}
    for tau, told, hit in zip(test.transition, test.message_set, said == test.label, strict=True):
        votes.setdefault((tau, told), []).append(hit)
    right = sum(np.mean(vote) for vote in votes.values())
    assert labeler.n_test == len(votes)
    assert labeler.n_train + labeler.n_test == len(np.unique(query_index(dataset)))
    assert (labeler.accuracy, labeler.confidence) == (
        pytest.approx(right / len(votes)),
        pytest.approx((right + 1) / (len(votes) + 2)),
    )


def test_leaves_of_a_fitted_tree_by_hand() -> None:
    # Without the message 1 label of 4 is a one, with it 5 of 6.
    label = np.array([1, 0, 0, 0, 1, 1, 1, 1, 1, 0])
    x = np.stack([np.zeros(10), [0] * 4 + [1] * 6], axis=1).astype(np.float32)
    tree = DecisionTreeClassifier().fit(x, label)
    labeler = fitted(tree, 1, 0.7, 8, calibrated=True)
    # (1 + 2 · 0.3) / (4 + 2), and (5 + 2 · 0.7) / (6 + 2)
    assert labeler.table(np.zeros((1, 1))).array(1)[0] == pytest.approx(
        np.array([[1.6 / 6, 6.4 / 8]])
    )
    # Not calibrated, and calibrated by one label: never surer than 1 - 1 / (1 + 2).
    for tested, calibrated, low in ((8, False, 0.3), (1, True, 1 / 3)):
        other = fitted(tree, 1, 0.7, tested, calibrated=calibrated)
        expected = np.array([[low, 1 - low]])
        assert other.table(np.zeros((1, 1))).array(1)[0] == pytest.approx(expected)


@given(seed=st.integers(0, 10_000), n=st.integers(1, 7))
@settings(max_examples=25, deadline=None)
def test_the_table_over_what_a_tree_looks_at_is_the_whole_table(seed: int, n: int) -> None:
    dataset, _ = made(np.random.default_rng(seed), [[0]], size=60, n=n)
    labeler = LabelerTrainer().fit(dataset, seed)
    features = dataset.features[:3]
    whole = labeler.table(features)
    assert whole.rows == [list(range(n))] * whole.n_types
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("xplain.learning.labelers.DENSE", 0)
        some = labeler.table(features)
    assert np.array_equal(some.array(n), whole.array(n))
    tree, width = labeler.classifier, features.shape[1]
    x = inputs(np.repeat(features, 1 << n, axis=0), np.tile(np.arange(1 << n), 3), n)
    tested = tree.tree_.feature[tree.decision_path(x).indices]
    assert some.rows == [np.unique(tested[tested >= width] - width).tolist()]


def test_sixteen_messages_are_the_most_that_are_looked_at() -> None:
    """Makes a tree with one path for each message, one after the other."""
    for count in (16, 17):
        x = np.zeros((count + 1, 24), dtype=np.float32)
        x[np.arange(count), 1 + np.arange(count)] = 1
        tree = DecisionTreeClassifier(random_state=0).fit(x, np.arange(count + 1) < count)
        labeler = fitted(tree, 23, 0.9, 1)
        if count == 16:
            found = labeler.table(np.zeros((1, 1)))
            assert found.rows == [list(range(16))]
            assert not found.p[0, 0, 0] > 0.5
            assert (found.p[0, 1:, 0] > 0.5).all()
        else:
            with pytest.raises(TooLargeError, match="17 of 23 messages"):
                labeler.table(np.zeros((1, 1)))


@pytest.mark.parametrize(
    "model",
    [DecisionTreeClassifier(max_depth=4), GradientBoostingClassifier(), LogisticRegression()],
)
def test_equal_rows_may_be_one_row_with_a_weight(
    rng: np.random.Generator, model: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, _ = made(rng, [[0, 2]], noise=0.2, size=120)
    dataset = replace(dataset, features=rng.random((len(dataset.features), 3)))  # no split ties
    repeated = dataset.take(rng.integers(len(dataset), size=2000))
    tables = []
    for most in (10_000, 100):
        monkeypatch.setattr("xplain.learning.labelers.MANY", most)
        labeler = LabelerTrainer(model, confidence="leaf").fit(repeated, 3)
        tables.append(labeler.table(dataset.features).array(dataset.n_messages))
    assert tables[0] == pytest.approx(tables[1], abs=1e-3)
    assert np.ptp(tables[0]) > 0.3


@pytest.mark.parametrize(("holdout", "n"), [(0.25, 2), (0.9, 1)])
def test_fresh_questions_have_message_sets_that_were_not_learned_from(
    rng: np.random.Generator, holdout: float, n: int
) -> None:
    """Each of the message sets is left out once. Each question counts once."""
    dataset, _ = made(rng, [[0, 1], [1]], noise=0.2, n=n)
    trainer, right = LabelerTrainer(holdout=holdout), np.empty(len(dataset))
    for told in range(1 << n):
        new = dataset.message_set == told
        labeler = trainer.fit(dataset.take(np.flatnonzero(~new)), 4)
        said = labeler.predict(dataset.features[dataset.transition], dataset.message_set)
        right[new] = (said == dataset.label)[new]
    queries = query_index(dataset)
    shares = [right[queries == query].mean() for query in np.unique(queries)]
    assert fresh_accuracy(dataset, trainer, 4) == pytest.approx(np.mean(shares))
    alone = dataset.take(np.flatnonzero(dataset.message_set == 0))
    assert np.isnan(fresh_accuracy(alone, trainer, 4))


def test_what_is_said_of_fresh_questions_is_what_they_show() -> None:
    """With sixty labels of each observer and the same questions for all, this figure is right
    within two standard errors, and the accuracy on held-out (transition, message set) is too
    high."""
    domain = domain_of("domain=four_rooms")
    gaps = []
    for seed in range(8):
        setting = Setting.build(domain, RandomCover(3).types(domain, np.random.default_rng(seed)))
        observed = SimulatedObservers(points=60).collect(setting, Shared(), seed)
        later = SimulatedObservers(1, 1000).collect(setting, Independent(), seed + 10**6)
        for user_type in range(3):
            own, new = (
                o.dataset.of(np.flatnonzero(o.truth == user_type)) for o in (observed, later)
            )
            labeler = LabelerTrainer().fit(own, seed)
            said = labeler.predict(new.features[new.transition], new.message_set)
            shown = labeler.accuracy, fresh_accuracy(own, LabelerTrainer(), seed)
            gaps.append(np.array(shown) - (said == new.label).mean())
    held_out, fresh = np.mean(gaps, axis=0)
    error = np.std(gaps, axis=0, ddof=1) / len(gaps) ** 0.5
    assert held_out > 2 * error[0]
    assert abs(fresh) < 2 * error[1]


def test_who_gave_no_label_before_is_predicted_by_everybodys(rng: np.random.Generator) -> None:
    """All labels of the second type are held out, so only everybody's labels predict it."""
    dataset, truth = made(rng, [[0], [1]], per_type=1, size=300)
    train, test = (dataset.of(np.array([o])) for o in range(2))
    given = Clustering(truth, "", "")
    found = log_likelihoods(train, test, learn_types(train, given, LabelerTrainer(), 3))
    everybody = LabelerTrainer().fit(train, 3)
    assert np.array_equal(found, log_likelihood(everybody, test))
    # Each label by the labeler of its own cluster, in the order of the labels.
    both = log_likelihoods(dataset, dataset, learn_types(dataset, given, LabelerTrainer(), 3))
    for o in range(2):
        own = dataset.of(np.array([o]))
        alone = log_likelihood(LabelerTrainer().fit(own, 3), own)
        assert np.array_equal(both[dataset.observer == o], alone)


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
