import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.learning.conftest import made
from xplain.learning.data.dataset import Dataset
from xplain.learning.paper import disagreements


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
    found = disagreements(dataset, [assignment, np.zeros(6, np.int64)])
    assert found.tolist() == [pairwise(dataset, one) for one in (assignment, np.zeros(6, np.int64))]
