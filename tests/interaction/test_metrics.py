"""Every figure of a summary, recomputed from the records by loops over what was said."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tests.handmade import an_episode
from xplain.interaction.episode import Episode
from xplain.interaction.metrics import Record, by_step, summarise

TRIANGLE = [
    [[0]],
    [[1], [0, 0]],
    [[0], [1, 1], [0, 1, 0]],
]
"""Labels by hand: of a trace of one transition (one 0), of two (two 0s), of three (three 0s)."""


def padded(rows: list[list[int]]) -> np.ndarray:
    """Rows of a triangle as an episode keeps them: −1 for what was not asked."""
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
        # What the policy paid more than the reference: positive where it did worse.
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
    assert figures[name].low == pytest.approx(max(sum(each) / 3 - half, least))
    assert figures[name].high == pytest.approx(min(sum(each) / 3 + half, most))


def test_steps_by_hand():
    steps = by_step(RECORDS)
    # Of three traces, of one, two and three transitions; the prior is before the first.
    assert steps["episodes"].tolist() == [3, 3, 2, 1]
    expected = [1.2 / 3, (0.95 + 0.3 + 0.9) / 3, (0.91 + 0.4) / 2, 0.9]
    assert steps["belief_in_true_type"] == pytest.approx(expected)
    assert steps["messages_given"] == pytest.approx([(2 + 1 + 0) / 3, (1 + 0) / 2, 0])
    assert steps["inexplicable_labels_shown"] == pytest.approx([(1 + 0 + 1) / 3, (2 + 0) / 2, 2])


@st.composite
def recorded(draw, solvers=("solver", "oracle", "clairvoyant")):
    """Each solver's episodes with each user on traces of different lengths, in any order."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    users, lengths = int(rng.integers(1, 4)), rng.integers(1, 6, rng.integers(2, 5)).tolist()
    right = rng.integers(0, 2, (users, 3)).astype(bool)
    right[0, 0] = True
    records = [
        Record(solver, trace, user, right[user], an_episode(rng, m, types=3))
        for solver in solvers
        for trace, m in enumerate(lengths)
        for user in range(users)
    ]
    return [records[i] for i in rng.permutation(len(records))], users, lengths


def zeros_of_triangle(episode, k):
    return sum(int(episode.labels[k, i]) == 0 for i in range(k + 1))


def ones(mask):
    return bin(int(mask)).count("1")


def again(masks):
    """How many messages had been said at an earlier step."""
    heard = [j for mask in masks for j in range(8) if int(mask) >> j & 1]
    return len(heard) - len(set(heard))


def belief_in_true_type(record, k):
    return sum(b for b, true in zip(record.episode.beliefs[k], record.right, strict=True) if true)


def until_sure(record):
    m = len(record.episode.messages)
    for k in range(m + 1):
        if belief_in_true_type(record, k) > 0.9:
            return k
    return m + 1


@given(recorded())
@settings(max_examples=40, deadline=None)
def test_every_figure_is_the_mean_over_traces_and_users(data):
    records, users, lengths = data
    of = {(r.solver, r.trace, r.user_type): r for r in records}
    columns = {}
    for trace, m in enumerate(lengths):
        for user in range(users):
            own = of["solver", trace, user]
            episode = own.episode
            oracle = of["oracle", trace, user].episode.cost
            clairvoyant = of["clairvoyant", trace, user].episode.cost
            figures = {
                "cost": episode.cost,
                "messages": sum(map(ones, episode.messages)),
                "messages_again": again(episode.messages),
                "inexplicable_labels": sum(zeros_of_triangle(episode, k) for k in range(m)),
                "decision_ms": 1000 * sum(episode.seconds) / m,
                "steps_until_sure": until_sure(own),
                "final_belief": belief_in_true_type(own, m),
                "oracle_cost": oracle,
                "clairvoyant_cost": clairvoyant,
                "regret": episode.cost - oracle,
                "regret_to_clairvoyant": episode.cost - clairvoyant,
            }
            for name, value in figures.items():
                columns.setdefault(name, []).append((trace, value))
    if not any(count for _, count in columns["messages_again"]):
        del columns["messages_again"]  # left out where nothing was said again
    summary = summarise(records)
    dear, cheap = (sum(v for _, v in columns[name]) for name in ("oracle_cost", "clairvoyant_cost"))
    ratio = summary.pop("oracle_over_clairvoyant", None)
    assert (ratio is None) == (cheap == 0)
    if ratio is not None:
        assert ratio.mean == pytest.approx(dear / cheap)
    assert summary.keys() == columns.keys()
    for name, column in columns.items():
        assert summary[name].mean == pytest.approx(np.mean([value for _, value in column]))
        # As many users on each trace: the interval is that of the traces' means.
        means = [np.mean([v for t, v in column if t == trace]) for trace in range(len(lengths))]
        half = stats.t.ppf(0.975, len(means) - 1) * stats.sem(means)
        # It ends where the mean cannot be, but for what was seen (costs here are any numbers).
        seen = [value for _, value in column]
        least = -math.inf if name == "regret" else min(0, *seen)
        most = 1 if name == "final_belief" else math.inf
        low, high = max(np.mean(means) - half, least), min(np.mean(means) + half, most)
        assert summary[name].low == pytest.approx(low, abs=1e-9), name
        assert summary[name].high == pytest.approx(high, abs=1e-9), name


@given(recorded())
@settings(max_examples=40, deadline=None)
def test_every_step_is_the_mean_of_those_that_come_so_far(data):
    records, _, lengths = data
    steps = by_step(records)
    own = [record for record in records if record.solver == "solver"]
    longest = max(lengths)
    assert len(steps["episodes"]) == len(steps["belief_in_true_type"]) == longest + 1
    assert len(steps["messages_given"]) == len(steps["inexplicable_labels_shown"]) == longest
    for k in range(longest + 1):
        there = [record for record in own if len(record.episode.messages) >= k]
        assert steps["episodes"][k] == len(there)
        beliefs = [belief_in_true_type(record, k) for record in there]
        assert steps["belief_in_true_type"][k] == pytest.approx(np.mean(beliefs))
    for k in range(longest):
        there = [record.episode for record in own if len(record.episode.messages) > k]
        given_here = [ones(episode.messages[k]) for episode in there]
        assert steps["messages_given"][k] == pytest.approx(np.mean(given_here))
        zeros = [zeros_of_triangle(episode, k) for episode in there]
        assert steps["inexplicable_labels_shown"][k] == pytest.approx(np.mean(zeros))


@pytest.mark.parametrize("reference", ["oracle", "clairvoyant"])
def test_a_regret_is_left_out_where_its_reference_did_not_run(reference):
    figures = summarise([record for record in RECORDS if record.solver != reference])
    name = {"oracle": "regret", "clairvoyant": "regret_to_clairvoyant"}[reference]
    left_out = {name, f"{reference}_cost", "oracle_over_clairvoyant"}
    assert summarise(RECORDS).keys() - figures.keys() == left_out


def test_what_learned_labels_cost_is_against_the_same_solver_with_true_ones():
    known = [
        by_hand("true_labels", 0, 0, 3.0, [0.5, 0.9], [1]),
        by_hand("true_labels", 1, 0, 4.5, [0.5, 0.9, 1], [1, 0]),
        by_hand("true_labels", 2, 0, 1.5, [0.5, 0.9, 1, 1], [1, 0, 0]),
    ]
    assert "cost_over_true_labels" not in summarise(RECORDS)
    figures = summarise(RECORDS + known)
    assert figures["cost_over_true_labels"].mean == pytest.approx((5 + 9 + 4) / (3 + 4.5 + 1.5))
    # Nothing else is of these records.
    del figures["cost_over_true_labels"]
    assert figures == summarise(RECORDS)
    for_nothing = [by_hand("true_labels", trace, 0, 0.0, [0.5], [1]) for trace in range(3)]
    assert summarise(RECORDS + for_nothing) == summarise(RECORDS)  # no multiple of nought


def test_no_recognition_where_nobody_knows_which_type_is_the_true_one():
    unknown = [
        Record(r.solver, r.trace, r.user_type, np.zeros(2, dtype=bool), r.episode) for r in RECORDS
    ]
    left_out = summarise(RECORDS).keys() - summarise(unknown).keys()
    assert left_out == {"steps_until_sure", "final_belief"}


def test_one_trace_leaves_every_interval_unknown():
    figures = summarise([record for record in RECORDS if record.trace == 0])
    assert figures["regret"].mean == 1
    assert all(math.isnan(e.low) and math.isnan(e.high) for e in figures.values())
