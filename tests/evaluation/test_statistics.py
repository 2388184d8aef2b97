"""Intervals against scipy, and against repeated sampling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from xplain.evaluation.statistics import clustered_mean, clustered_ratio


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=30))
def test_with_one_value_a_cluster_it_is_the_t_interval(values):
    estimate = clustered_mean(values, range(len(values)))
    error = float(stats.sem(values))
    assert estimate.mean == pytest.approx(np.mean(values), abs=1e-9)
    half = stats.t.ppf(0.975, len(values) - 1) * error
    assert estimate.high - estimate.mean == pytest.approx(half, abs=1e-9)
    assert estimate.mean - estimate.low == pytest.approx(half, abs=1e-9)


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=10), st.integers(2, 5))
def test_copies_within_a_cluster_add_no_information(values, copies):
    once = clustered_mean(values, range(len(values)))
    again = clustered_mean(np.repeat(values, copies), np.repeat(range(len(values)), copies))
    assert again.low == pytest.approx(once.low, abs=1e-9)
    assert again.high == pytest.approx(once.high, abs=1e-9)


def test_one_cluster_leaves_the_interval_unknown():
    estimate = clustered_mean([1.0, 2.0], [7, 7])
    assert estimate.mean == 1.5
    assert np.isnan(estimate.low)
    assert np.isnan(estimate.high)


def test_intervals_cover_as_often_as_they_say():
    rng = np.random.default_rng(5)
    covered = 0
    rounds = 1500
    for _ in range(rounds):
        effect = np.repeat(rng.normal(size=12), 5)
        values = 3.0 + effect + rng.normal(size=60)
        estimate = clustered_mean(values, np.repeat(range(12), 5))
        covered += estimate.low <= 3.0 <= estimate.high
    # 95 % of 1500 within four standard deviations of a binomial.
    assert abs(covered / rounds - 0.95) < 4 * (0.95 * 0.05 / rounds) ** 0.5


@given(st.lists(st.floats(0.1, 100), min_size=4, max_size=20), st.floats(0.1, 10))
def test_a_ratio_that_never_varies_is_certain(below, ratio):
    estimate = clustered_ratio(np.multiply(below, ratio), below, range(len(below)))
    assert estimate.mean == pytest.approx(ratio)
    assert (estimate.low, estimate.high) == (pytest.approx(ratio), pytest.approx(ratio))


def test_ratios_cover_as_often_as_they_say_and_are_never_negative():
    rng = np.random.default_rng(6)
    covered, rounds = 0, 1500
    for _ in range(rounds):
        below = np.repeat(rng.gamma(4, size=40), 3)
        above = 1.5 * below + np.repeat(rng.gamma(2, size=40), 3)  # mean 8 over mean 4
        estimate = clustered_ratio(above, below, np.repeat(range(40), 3))
        covered += estimate.low <= 2.0 <= estimate.high
    # Linearised: a little short of 95 % with 40 clusters.
    assert 0.92 < covered / rounds < 0.97
    rare = clustered_ratio([0, 0, 0, 9], [1, 1, 1, 1], range(4))
    assert rare.low == 0
    assert np.isnan(clustered_ratio([1, 2], [1, 1], [0, 0]).low)
