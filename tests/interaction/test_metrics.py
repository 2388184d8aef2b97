"""Computes every figure of a summary again, by loops over the records; compares intervals with
scipy, and with repeated sampling."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from xplain.interaction.episode import Episode
from xplain.interaction.metrics import Record, by_step, summarise
from xplain.interaction.statistics import clustered_mean, clustered_ratio, clustered_share

TRIANGLE = [
    [[0]],
    [[1], [0, 0]],
    [[0], [1, 1], [0, 1, 0]],
]
"""Handmade labels of traces with one transition (one 0), two (two 0s) and three (three 0s)."""


def padded(rows: list[list[int]]) -> np.ndarray:
    """Pads the rows of a triangle as in an episode; −1 is no label."""
    return np.array([row + [-1] * (len(rows) - len(row)) for row in rows], dtype=np.int8)


def by_hand(
    solver: str, trace: int, user: int, cost: float, belief: list[float], messages: list[int]
) -> Record:
    m = trace + 1
    beliefs = np.array([[1 - b, b] for b in belief])
    seconds = np.full(m, 0.002)
    labels = padded(TRIANGLE[trace])
    episode = Episode(np.array(messages), labels, labels, beliefs, seconds, 0.0, 0.0, cost)
    return Record(solver, trace, user, np.array([False, True]), episode)


RECORDS = [
    by_hand("oracle", 2, 0, 2.5, [0, 0, 0, 0], [0, 0, 0]),
    by_hand("solver", 0, 0, 5.0, [0.5, 0.95], [3]),
    by_hand("clairvoyant", 0, 0, 1.0, [1, 1], [0]),
    by_hand("solver", 2, 0, 4.0, [0.5, 0.9, 0.4, 0.9], [0, 0, 0]),
    by_hand("clairvoyant", 1, 0, 1.5, [1, 1, 1], [0, 0]),
    by_hand("oracle", 0, 0, 4.0, [0, 0], [0]),
    by_hand("solver", 1, 0, 9.0, [0.2, 0.3, 0.91], [1, 2]),
    by_hand("oracle", 1, 0, 10.0, [0, 0, 0], [0, 0]),
    by_hand("clairvoyant", 2, 0, 0.5, [1, 1, 1, 1], [0, 0, 0]),
]


@pytest.mark.parametrize(
    ("name", "each"),
    [
        ("cost", [5, 9, 4]),
        ("oracle_cost", [4, 10, 2.5]),
        ("clairvoyant_cost", [1, 1.5, 0.5]),
        # The policy's cost minus the reference's: positive if the policy is worse.
        ("regret", [1, -1, 1.5]),
        ("regret_to_clairvoyant", [4, 7.5, 3.5]),
        ("messages", [2, 2, 0]),
        ("inexplicable_labels", [1, 2, 3]),
        ("decision_ms", [2, 2, 2]),
        # Sure after one step, after two, and never in a trace of three: belief must exceed 0.9.
        ("steps_until_sure", [1, 2, 4]),
        ("final_belief", [0.95, 0.91, 0.9]),
    ],
)
def test_figures_by_hand(name, each):
    figures = summarise(RECORDS)
    assert figures[name].mean == pytest.approx(sum(each) / 3)
    half = stats.t.ppf(0.975, 2) * stats.sem(each)
    # A belief is at most 1, and only the regret to the oracle can be negative.
    least, most = (-math.inf if name == "regret" else 0), 1 if name == "final_belief" else math.inf
    assert (figures[name].low, figures[name].high) == (
        pytest.approx(max(sum(each) / 3 - half, least)),
        pytest.approx(min(sum(each) / 3 + half, most)),
    )


def test_steps_by_hand():
    steps = by_step(RECORDS)
    # There are three traces of one, two and three transitions; the prior comes first.
    assert steps["episodes"].tolist() == [3, 3, 2, 1]
    expected = [1.2 / 3, (0.95 + 0.3 + 0.9) / 3, (0.91 + 0.4) / 2, 0.9]
    assert steps["belief_in_true_type"] == pytest.approx(expected)


@pytest.mark.parametrize("reference", ["oracle", "clairvoyant"])
def test_a_regret_is_left_out_where_its_reference_did_not_run(reference):
    figures = summarise([record for record in RECORDS if record.solver != reference])
    name = {"oracle": "regret", "clairvoyant": "regret_to_clairvoyant"}[reference]
    left_out = {name, f"{reference}_cost"}
    assert summarise(RECORDS).keys() - figures.keys() == left_out


def test_no_recognition_where_nobody_knows_which_type_is_the_true_one():
    unknown = [
        Record(r.solver, r.trace, r.user_type, np.zeros(2, dtype=bool), r.episode) for r in RECORDS
    ]
    known, left_out = summarise(RECORDS).keys(), {"steps_until_sure", "final_belief"}
    assert known - summarise(unknown).keys() == left_out > known & {"fit", "questions"}


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


@pytest.mark.parametrize(
    ("right", "of", "copies"), [(0, 10, 1), (10, 10, 3), (3, 40, 1), (3, 9, 4)]
)
def test_cases_that_agree_within_clusters_are_wilsons_cases_one_a_cluster(right, of, copies):
    known = stats.binomtest(right, of).proportion_ci(method="wilson")
    cases = np.repeat(np.arange(of) < right, copies)
    found = clustered_share(cases, np.repeat(range(of), copies))
    assert (found.low, found.high) == pytest.approx((known.low, known.high))
    assert np.isnan(clustered_share(cases, np.zeros(len(cases))).low)  # one cluster tells nothing


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
    """However little the clusters' shares vary, the interval contains the interval of as many
    independent cases."""
    cases = np.concatenate(clusters)
    known = stats.binomtest(int(cases.sum()), len(cases)).proportion_ci(method="wilson")
    found = clustered_share(cases, np.repeat(range(len(clusters)), 3))
    assert found.low <= known.low + 1e-12
    assert found.high >= known.high - 1e-12
