import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.linear_model import LogisticRegression

from tests.learning.conftest import made
from xplain.data.dataset import query_index
from xplain.errors import InputError
from xplain.learning.labelers import LabelerTrainer, split


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


def test_points_number_distinct_pairs(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0]], n=3)
    seen: dict[tuple[int, int], set[int]] = {}
    for tau, given_set, point in zip(
        dataset.transition.tolist(),
        dataset.message_set.tolist(),
        query_index(dataset).tolist(),
        strict=True,
    ):
        seen.setdefault((tau, given_set), set()).add(point)
    assert all(len(numbers) == 1 for numbers in seen.values())
    assert {min(numbers) for numbers in seen.values()} == set(range(len(seen)))


def test_confidence_is_the_smoothed_share_of_held_out_labels_got_right(
    rng: np.random.Generator,
) -> None:
    dataset, _ = made(rng, [[0, 1]], noise=0.15)
    labeler = LabelerTrainer(refit=False).fit(dataset, 7)
    test = dataset.take(np.flatnonzero(split(dataset, 0.25, 7)))
    right = (labeler.predict(test.features[test.transition], test.message_set) == test.label).sum()
    assert labeler.n_test == len(test)
    assert labeler.n_train == len(dataset) - len(test)
    assert labeler.accuracy == pytest.approx(right / len(test))
    assert labeler.confidence == pytest.approx((right + 1) / (len(test) + 2))


def test_a_rule_that_a_tree_can_hold_is_learned(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0, 2]], size=400)
    labeler = LabelerTrainer().fit(dataset, 1)
    assert labeler.accuracy > 0.98
    assert labeler.confidence < 1


@pytest.mark.parametrize("classifier", [LogisticRegression(), None])
def test_labels_of_one_kind_give_a_constant_labeler(
    rng: np.random.Generator, classifier: LogisticRegression | None
) -> None:
    dataset, _ = made(rng, [[]], size=30)
    assert dataset.label.all()
    trainer = LabelerTrainer(classifier) if classifier else LabelerTrainer()
    labeler = trainer.fit(dataset, 0)
    table = labeler.table(dataset.features, dataset.n_messages)
    assert (table == labeler.confidence).all()
    assert 0.5 < labeler.confidence < 1


def test_one_point_alone_tells_nothing(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0]], size=30)
    labeler = LabelerTrainer().fit(dataset.take(np.array([0])), 0)
    assert labeler.n_test == 0
    assert labeler.confidence == 0.5


def test_same_seed_same_labeler(rng: np.random.Generator) -> None:
    dataset, _ = made(rng, [[0, 1]], noise=0.2)
    tables = [
        LabelerTrainer().fit(dataset, seed).table(dataset.features, dataset.n_messages)
        for seed in (5, 5, 6)
    ]
    assert (tables[0] == tables[1]).all()
    assert (tables[0] != tables[2]).any()


@pytest.mark.parametrize(
    ("field", "value"),
    [("holdout", 0.0), ("holdout", 1.0), ("confidence", "maybe"), ("classifier", "tree")],
)
def test_bad_values_are_named(field: str, value: object) -> None:
    with pytest.raises(InputError, match=f"labeler.{field}"):
        LabelerTrainer(**{field: value})  # type: ignore[arg-type]
