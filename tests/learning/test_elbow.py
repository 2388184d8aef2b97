import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kneed import KneeLocator

from xplain.learning.elbow import elbow


@pytest.mark.parametrize(
    ("curve", "k", "rule"),
    [
        # kneed's own answers on convex curves (see the project's notes on kneed 0.9)
        ([120, 60, 5, 4, 3, 2, 1, 0, 0], 3, "kneedle"),
        ([90, 60, 30, 1, 1, 0, 0, 0], 4, "kneedle"),
        ([50, 0, 0, 0, 0, 0, 0], 2, "kneedle"),
        # a first drop so large that kneedle stops at once, though all may go
        ([1000, 220, 130, 70, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 5, "few"),
        # kneedle finds nothing, or an end, in these
        ([0, 0, 0, 0], 1, "flat zero"),
        ([0], 1, "flat zero"),
        ([7], 1, "lowest"),
        ([7, 7, 7, 7, 7], 1, "lowest"),
        ([7, 0], 2, "few"),
        ([10, 1, 0], 3, "few"),
        ([40, 30, 20, 10, 0], 5, "few"),
        ([9, 9, 9, 9, 0], 5, "few"),
        ([9, 9, 9, 9, 3], 5, "lowest"),
    ],
)
def test_rules(curve: list[int], k: int, rule: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "xplain")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert elbow(np.array(curve), 0.05) == (k, rule)
    assert f"{k} user types by the rule {rule}" in caplog.text


def test_noise_that_never_goes_away_leaves_kneedle_its_say() -> None:
    curve = np.array([1000, 600, 300, 150, 140, 135, 130, 128, 126])
    assert elbow(curve, 0.05) == (4, "kneedle")


@pytest.mark.parametrize(
    "curve", [[1000, 225, 51, 0, 0, 0, 0, 0], [1000, 225, 51, 11, 3, 1, 0, 0, 0, 0, 0]]
)
def test_a_knee_one_too_early_does_not_count(curve: list[int]) -> None:
    # kneed says 3, which leaves 51 of 1000; the next k leaves at most 50.
    assert (
        KneeLocator(range(1, len(curve) + 1), curve, curve="convex", direction="decreasing").knee
        == 3
    )
    assert elbow(np.array(curve), 0.05) == (4, "few")
    # With 6 % allowed it is not too early.
    assert elbow(np.array(curve), 0.06) == (3, "kneedle")


@given(st.lists(st.integers(0, 500), min_size=1, max_size=12), st.floats(0, 0.3))
@settings(max_examples=200, deadline=None)
def test_whatever_the_rule_as_many_disagreements_go_as_can(drops: list[int], few: float) -> None:
    curve = np.array(drops)
    k, rule = elbow(curve, few)
    left = np.minimum.accumulate(curve)
    allowed = few * curve[0]
    if left[-1] <= allowed:
        assert left[k - 1] <= allowed
        assert rule != "lowest"
    if rule == "few":
        assert (left[: k - 1] > allowed).all()
    if rule == "lowest":
        assert left[k - 1] == left[-1]
        assert (left[: k - 1] > left[-1]).all()
    assert (rule == "flat zero") == (curve[0] == 0)
