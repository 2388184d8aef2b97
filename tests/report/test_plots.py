"""Common properties of all plots."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from xplain.report.plots import draw


@pytest.mark.parametrize("least", [0.0, -4.0], ids=["costs", "regrets"])
def test_every_interval_is_inside_its_panel(least: float) -> None:
    rng = np.random.default_rng(5)
    points = pd.DataFrame(
        {"panel": panel, "line": line, "x": x, "mean": least + 2.0 * height * rng.random()}
        for height, panel in enumerate("abcdef", 1)  # the first panel of a row has the lowest
        for line in ("one", "other")
        for x in (0.5, 1.0, 2.0)
    ).eval("low = mean - 0.1 * (mean > 0.1)\nhigh = mean + 1")
    figure = draw(points, "x", "y", per_row=3)
    for axes, (_, own) in zip(figure.axes, points.groupby("panel"), strict=True):
        bottom, top = axes.get_ylim()
        assert bottom <= own["low"].min()
        assert top >= own["high"].max()
        assert least < 0 or bottom == 0


def test_points_of_four_lines_stay_at_two_ticks() -> None:
    points = pd.DataFrame(
        {"panel": "a", "line": line, "x": x, "mean": 1.0, "low": 0.5, "high": 1.5}
        for line in "pqrs"
        for x in (0.5, 2.0)
    )
    (axes,) = draw(points, "x", "y").axes
    drawn = [line.get_xdata() for line in axes.lines if len(line.get_xdata()) == 2]
    assert len(drawn) >= 4
    assert np.abs(np.array(drawn) - [0.5, 2.0]).max() < 0.1
