from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from sklearn.ensemble import GradientBoostingClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.svm import LinearSVC
from sklearn.tree import DecisionTreeClassifier

from tests.learning.conftest import made
from xplain.errors import InputError, TooLargeError
from xplain.learning.data.dataset import Dataset, inputs, query_index
from xplain.learning.labelers import FittedLabeler, LabelerTrainer, split
from xplain.randomness import derived_seed


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
    """Each question once, however often it was answered; of a split vote the share that agrees."""
    once, _ = made(rng, [[0, 1]], noise=0.15)
    dataset = once.take(np.repeat(np.arange(len(once)), repeats))
    labeler = LabelerTrainer(refit=False).fit(dataset, 7)
    test = dataset.take(np.flatnonzero(split(dataset, 0.25, derived_seed(7, "labelers"))))
    said = labeler.predict(test.features[test.transition], test.message_set)
    votes: dict[tuple[int, int], list[bool]] = {}
    for tau, told, hit in zip(test.transition, test.message_set, said == test.label, strict=True):
        votes.setdefault((tau, told), []).append(hit)
    right = sum(np.mean(vote) for vote in votes.values())
    assert len(votes) < len(test) / repeats, "no question comes twice: nothing is tested here"
    assert labeler.n_test == len(votes)
    assert labeler.n_train + labeler.n_test == len(np.unique(query_index(dataset)))
    assert labeler.accuracy == pytest.approx(right / len(votes))
    assert labeler.confidence == pytest.approx((right + 1) / (len(votes) + 2))


def test_one_point_alone_tells_nothing(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0]], size=30)
    labeler = LabelerTrainer().fit(dataset.take(np.array([0])), 0)
    assert labeler.n_test == 0
    assert labeler.confidence == 0.5


@pytest.mark.parametrize(
    ("field", "value"),
    [("holdout", 0.0), ("holdout", 1.0), ("confidence", "maybe"), ("classifier", "tree")],
)
def test_bad_values_are_named(field: str, value: object) -> None:
    with pytest.raises(InputError, match=f"labeler.{field}"):
        LabelerTrainer(**{field: value})  # type: ignore[arg-type]


def coin_flips(rng: np.random.Generator, cells: int, repeats: int) -> Dataset:
    """Labels drawn by lot, one a (transition, message set), each given ``repeats`` times: nothing
    to learn, but much to remember."""
    count = cells * 16
    order = rng.permutation(np.repeat(np.arange(count), repeats))
    return Dataset(
        features=rng.random((cells, 3)),
        feature_names=("a", "b", "c"),
        messages=tuple(f"m{j}" for j in range(4)),
        observers=("o",),
        observer=np.zeros(len(order), dtype=np.int64),
        transition=order // 16,
        message_set=order % 16,
        label=rng.integers(2, size=count).astype(np.uint8)[order],
    )


@pytest.mark.parametrize("refit", [True, False])
@pytest.mark.parametrize("repeats", [1, 5])
def test_nobody_foretells_labels_drawn_by_lot(
    rng: np.random.Generator, refit: bool, repeats: int
) -> None:
    dataset = coin_flips(rng, 200, repeats)
    labeler = LabelerTrainer(refit=refit).fit(dataset, 3)
    error = (0.25 / labeler.n_test) ** 0.5
    assert labeler.accuracy == pytest.approx(0.5, abs=4 * error)
    assert labeler.confidence == pytest.approx(0.5, abs=4 * error)


@pytest.mark.parametrize("refit", [True, False])
def test_only_a_refitted_labeler_has_seen_all_labels(rng: np.random.Generator, refit: bool) -> None:
    dataset = coin_flips(rng, 200, 1)
    labeler = LabelerTrainer(refit=refit).fit(dataset, 3)
    shown = dataset.features[dataset.transition]
    right = labeler.predict(shown, dataset.message_set) == dataset.label
    held = split(dataset, 0.25, derived_seed(3, "labelers"))
    assert right[~held].all()
    assert right[held].mean() == pytest.approx(1 if refit else labeler.accuracy)


@pytest.mark.parametrize("refit", [True, False])
def test_an_untested_labeler_predicts_as_the_tested_one(
    rng: np.random.Generator, refit: bool
) -> None:
    dataset, _ = made(rng, [[0, 1]], size=60, noise=0.3)
    fresh, _ = made(rng, [[0, 1]], size=400)
    trainer = LabelerTrainer(LogisticRegression(), holdout=0.4, refit=refit)
    queries = fresh.features[fresh.transition], fresh.message_set
    tested, untested = trainer.fit(dataset, 3), trainer.fit(dataset, 3, measured=False)
    shares = [
        own.classifier.predict_proba(inputs(*queries, dataset.n_messages))
        for own in (tested, untested)
    ]
    assert np.array_equal(*shares)
    assert np.array_equal(tested.predict(*queries), untested.predict(*queries))
    assert (untested.n_test, untested.confidence) == (0, 0.5)


class Leaves:
    """A tree of two leaves: ``share`` of ones in the second, among labels of this ``weight``."""

    classes_ = np.array([0, 1])

    def __init__(self, share: float, weight: float) -> None:
        self.share = share
        self.tree_ = SimpleNamespace(weighted_n_node_samples=np.array([7.0, weight]))

    def predict_proba(self, x: NDArray[np.float32]) -> NDArray[np.float64]:
        return np.full((len(x), 2), [1 - self.share, self.share])

    def apply(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        return np.ones(len(x), dtype=np.int64)


@pytest.mark.parametrize(
    ("share", "weight", "expected"),
    [
        (0.6, 0.0, 0.9),  # no label: the confidence of the majority alone
        (0.6, 2.0, 0.75),  # two labels weigh as much as it does
        (0.6, 6.0, 0.675),  # (6 · 0.6 + 2 · 0.9) / 8
        (0.6, np.inf, 0.6),  # its own labels alone
        (0.2, 0.0, 0.1),
        (0.2, 2.0, 0.15),
        (0.2, np.inf, 0.2),
        (1.0, 2.0, 0.95),
        (1.0, np.inf, 0.99),  # 98 tested labels tell no more
        (0.0, np.inf, 0.01),
    ],
)
def test_a_leaf_is_drawn_to_the_confidence_as_by_two_more_labels(
    share: float, weight: float, expected: float
) -> None:
    labeler = fitted(Leaves(share, weight), 1, 0.9, 98, calibrated=True)
    found = labeler.probability(np.zeros((1, 1)), np.zeros(1, dtype=np.int64))
    assert found == pytest.approx([expected])


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
    plain = fitted(tree, 1, 0.7, 8)
    assert plain.table(np.zeros((1, 1))).array(1)[0] == pytest.approx(np.array([[0.3, 0.7]]))


@given(seed=st.integers(0, 10_000), n=st.integers(1, 7))
@settings(max_examples=25, deadline=None)
def test_the_table_over_what_a_tree_looks_at_is_the_whole_table(seed: int, n: int) -> None:
    dataset, _ = made(np.random.default_rng(seed), [[0]], size=60, n=n)
    labeler = LabelerTrainer().fit(dataset, seed)
    features = dataset.features[:3]
    whole = labeler.table(features)
    assert whole.is_dense(n)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("xplain.learning.labelers.DENSE", 0)
        some = labeler.table(features)
    assert np.array_equal(some.array(n), whole.array(n))
    assert set(whole.effective()[0]) <= set(some.rows[0])


def test_sixteen_messages_are_the_most_that_are_looked_at() -> None:
    """A tree of one path a message, in a row."""
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


def test_shares_of_a_leaf_need_a_classifier_that_gives_them() -> None:
    with pytest.raises(InputError, match="leaf needs predict_proba"):
        LabelerTrainer(LinearSVC(), confidence="leaf")
    LabelerTrainer(LinearSVC())


def test_a_labeler_that_looks_at_too_many_messages_is_refused(rng: np.random.Generator) -> None:
    n = 30
    features, masks = np.zeros((4000, 1)), rng.integers(0, 1 << n, 4000)
    x = inputs(features, masks, n)
    tree = DecisionTreeClassifier(random_state=0).fit(x, rng.integers(0, 2, 4000))
    with pytest.raises(TooLargeError, match="labeler=pruned"):
        fitted(tree, n, 0.9, 1).table(features[:1])
    with pytest.raises(TooLargeError, match="labeler=pruned"):
        fitted(LogisticRegression().fit(x, x[:, 1]), n, 0.9, 1).table(features[:1])


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
