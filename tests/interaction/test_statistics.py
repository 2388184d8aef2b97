"""Compares intervals with scipy, and with repeated sampling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from xplain.interaction.statistics import clustered_mean, clustered_ratio, clustered_share


@given(st.lists(st.floats(-100, 100), min_size=2, max_size=30))
def test_with_one_value_a_cluster_it_is_the_t_interval(values):
    estimate = clustered_mean(values, range(len(values)))
    error = float(stats.sem(values))
    assert estimate.mean == pytest.approx(np.mean(values), abs=1e-9)
    half = stats.t.ppf(0.975, len(values) - 1) * error
    assert estimate.high - estimate.mean == pytest.approx(half, abs=1e-9)
    assert estimate.mean - estimate.low == pytest.approx(half, abs=1e-9)


def test_intervals_cover_as_often_as_they_say():
    rng = np.random.default_rng(5)
    covered = 0
    rounds = 600
    for _ in range(rounds):
        effect = np.repeat(rng.normal(size=12), 5)
        values = 3.0 + effect + rng.normal(size=60)
        estimate = clustered_mean(values, np.repeat(range(12), 5))
        covered += estimate.low <= 3.0 <= estimate.high
    # 95 % of 600 within four standard deviations of a binomial.
    assert abs(covered / rounds - 0.95) < 4 * (0.95 * 0.05 / rounds) ** 0.5


@given(st.lists(st.floats(0, 1), min_size=2, max_size=10))
def test_an_interval_of_a_share_is_one_of_shares(values):
    plain = clustered_mean(values, range(len(values)))
    cut = clustered_mean(values, range(len(values)), possible=(0, 1))
    assert (cut.low, cut.high) == (max(0, plain.low), min(1, plain.high))
    assert 0 <= cut.low <= cut.mean + 1e-12
    assert cut.mean - 1e-12 <= cut.high <= 1


def test_ratios_cover_as_often_as_they_say_and_are_never_negative():
    rng = np.random.default_rng(6)
    covered, rounds = 0, 600
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


@pytest.mark.parametrize(
    ("right", "of", "copies"), [(0, 10, 1), (10, 10, 3), (3, 40, 1), (3, 9, 4)]
)
def test_cases_that_agree_within_clusters_are_wilsons_cases_one_a_cluster(right, of, copies):
    known = stats.binomtest(right, of).proportion_ci(method="wilson")
    cases = np.repeat(np.arange(of) < right, copies)
    found = clustered_share(cases, np.repeat(range(of), copies))
    assert (found.low, found.high) == pytest.approx((known.low, known.high))
    assert 0 <= found.low <= found.mean <= found.high <= 1


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
@pytest.mark.parametrize(
    ("seeds", "each", "alike", "least"),
    [(10, 3, 0.01, 0.92), (10, 3, 0.5, 0.92), (10, 3, 0.9, 0.92), (4, 12, 0.2, 0.9)],
)
def test_intervals_of_shares_cover_however_alike_the_cases_of_a_cluster_are(
    share, seeds, each, alike, least
):
    """Nested cases of a correlation ``alike`` (beta-binomial). Ten clusters of three cover 75 %
    when taken for thirty cases; four of twelve cover 84 % with the normal's quantile. (Four whose
    cases agree are four cases: there Wilson's own interval covers 87.5 % of halves.)"""
    rng, rounds = np.random.default_rng(7), 600
    sizes = share * (1 / alike - 1), (1 - share) * (1 / alike - 1)
    covered = 0
    for chance in rng.beta(*sizes, size=(rounds, seeds)):
        cases = rng.random((seeds, each)) < chance[:, None]
        found = clustered_share(cases.ravel(), np.repeat(range(seeds), each))
        covered += found.low <= share <= found.high
    assert covered / rounds > least


@given(st.lists(st.lists(st.booleans(), min_size=3, max_size=3), min_size=2, max_size=12))
def test_clusters_that_even_out_are_no_more_cases_than_there_are(clusters):
    """However little the clusters' shares vary, the interval holds that of as many independent
    cases."""
    cases = np.concatenate(clusters)
    known = stats.binomtest(int(cases.sum()), len(cases)).proportion_ci(method="wilson")
    found = clustered_share(cases, np.repeat(range(len(clusters)), 3))
    assert found.low <= known.low + 1e-12
    assert found.high >= known.high - 1e-12


def test_a_share_that_seeds_agree_on_by_chance_is_not_certain():
    found = clustered_share([True, False, True, True, True, False], [0, 0, 0, 1, 1, 1])
    assert found.mean == pytest.approx(2 / 3)
    assert found.low < 0.5 < 0.9 < found.high
    assert np.isnan(clustered_share([True, False], [4, 4]).low)
