import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.learning.conftest import made
from xplain.learning.data.dataset import Dataset
from xplain.learning.paper import disagreements


def of_one(dataset: Dataset, assignment: NDArray[np.int64]) -> int:
    (found,) = disagreements(dataset, [assignment])
    return int(found)


def pairwise(dataset: Dataset, assignment: NDArray[np.int64]) -> int:
    """Definition 1, read aloud."""
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
    assert of_one(dataset, assignment) == pairwise(dataset, assignment)


def test_one_cluster_has_most_and_the_true_types_none(rng: np.random.Generator) -> None:
    dataset, truth = made(rng, [[0], [1, 2]], shared=True)
    assert of_one(dataset, truth) == 0
    assert of_one(dataset, np.zeros_like(truth)) > 0
    assert of_one(dataset, np.arange(len(truth))) == 0


def test_a_data_set_without_disagreement(rng: np.random.Generator) -> None:
    dataset, truth = made(rng, [[]])
    assert of_one(dataset, np.zeros_like(truth)) == 0


def test_two_answers_of_one_observer_disagree_in_every_clustering(
    rng: np.random.Generator,
) -> None:
    dataset, _ = made(rng, [[0]], per_type=2, size=1, n=1)
    twice = Dataset(
        dataset.features,
        dataset.feature_names,
        dataset.messages,
        dataset.observers,
        np.array([0, 0, 1]),
        np.zeros(3, dtype=np.int64),
        np.zeros(3, dtype=np.int64),
        np.array([0, 1, 1], dtype=np.uint8),
    )
    assert of_one(twice, np.array([0, 0])) == 2
    assert of_one(twice, np.array([0, 1])) == 1
