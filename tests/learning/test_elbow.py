import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kneed import KneeLocator

from xplain.learning.paper import elbow


@pytest.mark.parametrize(
    ("curve", "k", "rule"),
    [
        # kneed's own answers on convex curves (see the project's notes on kneed 0.9)
        ([120, 60, 5, 4, 3, 2, 1, 0, 0], 3, "kneedle"),
        ([90, 60, 30, 1, 1, 0, 0, 0], 4, "kneedle"),
        ([50, 0, 0, 0, 0, 0, 0], 2, "kneedle"),
        # a first drop so large that kneedle stops too early: its knee stands
        ([1000, 220, 130, 70, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], 3, "kneedle"),
        ([1000, 225, 51, 0, 0, 0, 0, 0], 3, "kneedle"),
        # disagreements that noise makes, which never go away
        ([1000, 600, 300, 150, 140, 135, 130, 128, 126], 4, "kneedle"),
        ([0, 0, 0, 0], 1, "flat zero"),
        ([0], 1, "flat zero"),
        # kneedle finds nothing, or an end, in these
        ([7], 1, "no knee, lowest"),
        ([7, 7, 7, 7, 7], 1, "no knee, lowest"),
        ([7, 0], 2, "no knee, few"),
        ([10, 1, 0], 3, "no knee, few"),
        ([40, 30, 20, 10, 0], 5, "no knee, few"),
        ([9, 9, 9, 9, 0], 5, "no knee, few"),
        ([100, 99, 98, 2, 1, 0, 0, 0], 4, "no knee, few"),
        ([9, 9, 9, 9, 3], 5, "no knee, lowest"),
    ],
)
def test_rules(curve: list[int], k: int, rule: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "xplain")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert elbow(np.array(curve), 0.05) == (k, rule)
    assert f"{k} user types by the rule {rule}" in caplog.text


@given(st.lists(st.integers(0, 500), min_size=1, max_size=15), st.floats(0, 0.3))
@settings(max_examples=300, deadline=None)
def test_a_knee_that_kneedle_finds_stands(drops: list[int], few: float) -> None:
    """Whatever it leaves; and the rules for curves without a knee hold where there is none."""
    curve = np.array(drops)
    k, rule = elbow(curve, few)
    left = np.minimum.accumulate(curve)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        places = range(1, len(left) + 1)
        knee = KneeLocator(places, left.tolist(), curve="convex", direction="decreasing").knee
    bends = knee is not None and 1 < knee < len(left)
    allowed = few * curve[0]
    assert (rule == "flat zero") == (curve[0] == 0)
    assert (rule == "kneedle") == (bends and curve[0] > 0)
    if rule == "flat zero":
        assert k == 1
    elif rule == "kneedle":
        assert k == knee
    elif left[-1] <= allowed:
        assert rule == "no knee, few"
        assert left[k - 1] <= allowed
        assert (left[: k - 1] > allowed).all()
    else:
        assert rule == "no knee, lowest"
        assert left[k - 1] == left[-1]
        assert (left[: k - 1] > left[-1]).all()
