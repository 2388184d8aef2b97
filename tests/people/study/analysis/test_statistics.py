"""Compares statistics with published figures, other programs, brute force, and their defining
properties."""

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from xplain.people.study.analysis import (
    compare,
    hedges,
    holm,
    paper_table,
    stratified_permutation,
)


def test_holm_by_hand() -> None:
    # Holm (1979): 4 tests, α multiplied by 4, 3, 2, 1 from the smallest p on.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    with_gap = holm([0.01, float("nan"), 0.04])
    assert with_gap[0] == pytest.approx(0.02)
    assert np.isnan(with_gap[1])


def test_none_of_the_papers_p_values_survives_the_correction() -> None:
    adjusted = holm([row["p_value"] for row in paper_table().values()])
    assert adjusted == pytest.approx([0.072, 0.072, 0.072])


def test_hedges_interval_holds_the_truth_as_often_as_it_says() -> None:
    rng, delta, hits, rounds = np.random.default_rng(1), 0.7, 0, 600
    for _ in range(rounds):
        a, b = rng.normal(delta, 1, 15), rng.normal(0, 1, 12)
        # The small-sample factor scales both ends; it belongs to the estimate, not to the truth.
        _, low, high = hedges(float(stats.ttest_ind(a, b).statistic), 15, 12)
        factor = 1 - 3 / (4 * 25 - 1)
        hits += low <= delta * factor <= high
    assert 0.93 <= hits / rounds <= 0.97


def test_hedges_is_unbiased_and_mirrors() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(1, 1, (4000, 6)), rng.normal(0, 1, (4000, 6))
    t = stats.ttest_ind(a, b, axis=1).statistic
    correction = hedges(1.0, 6, 6)[0]  # g is proportional to t
    assert abs((t * correction).mean() - 1.0) < 0.04
    g, low, high = hedges(2.5, 20, 18)
    assert hedges(-2.5, 20, 18) == pytest.approx((-g, -high, -low))
    # Zero lies on the interval's edge exactly if the test's p is 0.05.
    critical = float(stats.t.isf(0.025, 36))
    assert hedges(critical, 19, 19)[1] == pytest.approx(0, abs=1e-9)


def test_permutation_test_is_the_share_of_all_arrangements() -> None:
    x, y = np.array([3.0, 5.0, 9.0, 1.0]), np.array([2.0, 4.0, 4.0, 0.0])
    strata_x, strata_y = np.array(["a", "a", "b", "b"]), np.array(["a", "a", "b", "b"])
    a, b = np.array([3.0, 5, 2, 4]), np.array([9.0, 1, 4, 0])
    total, observed = a.sum() + b.sum(), abs(x.mean() - y.mean())
    extreme = [
        abs(
            (a[list(i)].sum() + b[list(j)].sum()) / 4
            - (total - a[list(i)].sum() - b[list(j)].sum()) / 4
        )
        >= observed - 1e-9
        for i in combinations(range(4), 2)
        for j in combinations(range(4), 2)
    ]
    exact = np.mean(extreme)
    found = stratified_permutation(x, y, strata_x, strata_y, seed=0, permutations=40_000)
    assert found == pytest.approx(exact, abs=0.012)


def test_permutation_test_does_not_take_a_type_for_an_effect() -> None:
    # Both conditions are alike within each type; only the types differ.
    values = np.array([10.0] * 8 + [0.0] * 2)
    other = np.array([10.0] * 2 + [0.0] * 8)
    strata = np.array(["a"] * 8 + ["b"] * 2), np.array(["a"] * 2 + ["b"] * 8)
    assert stratified_permutation(values, other, *strata, seed=0) == 1.0
    assert compare(values, other, list(strata[0]), list(strata[1]), 0)["student_p"] < 0.01


def test_a_group_without_spread_is_compared_without_a_warning() -> None:
    """By hand: means 6 and 3, pooled variance 1 / 2, error √(1 / 2 (1 / 3 + 1 / 3)) = √(1 / 3)."""
    found = compare([6, 6, 6], [2, 3, 4], ["a"] * 3, ["a"] * 3, 0)
    assert found["student_t"] == pytest.approx(3 * np.sqrt(3))
    assert found["student_df"] == 4
