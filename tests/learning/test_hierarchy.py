"""Where hierarchies are cut, by hand."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.learning.conftest import made
from xplain.learning import hierarchy
from xplain.learning.hierarchy import Gap, Share, Tree
from xplain.learning.labelers import LabelerTrainer


@pytest.mark.parametrize(
    ("few", "distinct", "k"),
    [
        (0.1, 4, 3),  # 10 of 100 are allowed
        (0.099, 4, 4),
        (0.11, 4, 2),
        (0.0, 4, 4),
        (0.0, 3, 3),  # more cuts would part equal vectors
    ],
)
def test_the_fewest_clusters_that_leave_at_most_a_share(few: float, distinct: int, k: int) -> None:
    dataset, _ = made(np.random.default_rng(0), [[0]])
    bits = np.eye(4, dtype=np.uint8)
    tree = Tree(np.zeros((3, 2), dtype=np.int64), distinct, bits, np.array([100, 11, 10, 0]))
    assert Share(few).choose(tree, dataset, LabelerTrainer(), 0)[0] == k


@pytest.mark.parametrize(("spread", "k"), [(0.1, 1), (0.05, 2)])
def test_a_gap_counts_only_beyond_its_standard_error(
    monkeypatch: pytest.MonkeyPatch, spread: float, k: int
) -> None:
    """Gaps of 1, 1.1 and 1.05. The second stands out from the first by 0.1: within the error of
    two references that differ by 2 · 0.1 (0.1 √1.5 ≈ 0.12), not of 2 · 0.05."""
    own = np.array([5.0, 3.0, 2.0])
    reference = own + np.array([1.0, 1.1, 1.05])
    answers = iter([own, reference + spread, reference - spread])

    def dispersions(
        bits: NDArray[np.uint8], cut: Callable[[int], NDArray[np.int64]], most: int
    ) -> NDArray[np.float64]:
        return next(answers)

    monkeypatch.setattr(hierarchy, "_dispersions", dispersions)
    dataset, _ = made(np.random.default_rng(0), [[0]])
    bits = np.eye(3, dtype=np.uint8)
    tree = Tree(np.array([[0, 1], [2, 3]]), 3, bits, np.zeros(3, dtype=np.int64))
    assert Gap(references=2).choose(tree, dataset, LabelerTrainer(), 0)[0] == k
