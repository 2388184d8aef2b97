"""Computes every figure of a summary again, by loops over the records."""

import math

import numpy as np
import pytest
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
    assert figures[name].low == pytest.approx(max(sum(each) / 3 - half, least))
    assert figures[name].high == pytest.approx(min(sum(each) / 3 + half, most))


def test_steps_by_hand():
    steps = by_step(RECORDS)
    # There are three traces of one, two and three transitions; the prior comes first.
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
