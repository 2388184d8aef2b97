import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.ensemble import RandomForestClassifier
from sklearn.tree import DecisionTreeClassifier

from tests.learning.conftest import made
from xplain.learning.data.dataset import inputs
from xplain.learning.labelers import LabelerTrainer
from xplain.learning.tree_leaves import cubes


@given(seed=st.integers(0, 10_000), n=st.integers(1, 7))
@settings(max_examples=25, deadline=None)
def test_cubes_are_the_leaves_that_the_tree_itself_applies(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    features = rng.random((6, 2))
    rows, masks = rng.integers(6, size=60), rng.integers(1 << n, size=60)
    x = inputs(features[rows], masks, n)
    model = DecisionTreeClassifier(random_state=0).fit(x, rng.integers(0, 2, 60))
    found = cubes(model.tree_, features, n)
    for t in range(6):
        own = found.transition == t
        for given_set in range(1 << n):
            inside = (given_set & found.ones == found.ones) & (given_set & found.zeros == 0) & own
            expected = model.apply(inputs(features[t : t + 1], np.array([given_set]), n))
            assert found.leaf[inside].tolist() == expected.tolist()


@pytest.mark.parametrize("confidence", ["accuracy", "leaf"])
@pytest.mark.parametrize("forest", [False, True])
def test_table_holds_the_probability_of_every_message_set(
    rng: np.random.Generator, confidence: str, forest: bool
) -> None:
    dataset, _ = made(rng, [[0, 2]], noise=0.1)
    model = RandomForestClassifier(5) if forest else DecisionTreeClassifier(min_samples_leaf=2)
    labeler = LabelerTrainer(model, confidence=confidence).fit(dataset, 3)  # type: ignore[arg-type]
    table = labeler.table(dataset.features).array(dataset.n_messages)[0]
    every = np.arange(1 << dataset.n_messages)
    for row, features in zip(table, dataset.features, strict=True):
        rows = np.tile(features, (len(every), 1))
        assert row == pytest.approx(labeler.probability(rows, every))
        if confidence == "accuracy":  # a forest's average may disagree with its vote at a half
            assert ((row > 0.5) == labeler.predict(rows, every)).all()
    assert table.min() > 0
    assert table.max() < 1
