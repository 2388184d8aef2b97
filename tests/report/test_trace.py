"""Pictures: the explanation that is shown, with its description, and plots."""

from itertools import product

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.text import Text

from xplain.domains.base import Item, Scene
from xplain.report.plots import draw
from xplain.report.trace import Story, describe_choice, draw_trace, typical


def story(trace: int, user: str, cost: float) -> Story:
    asked = [{"about": "Do puddles matter", "reply": "yes"}]
    return {
        "trace": trace,
        "type": user,
        "cost": cost,
        "transitions": ["a", "b", "c"],
        "positions": [[0, 0], [0, 1], [0, 2], [0, 2]],
        "prior": [0.5, 0.5],
        "steps": [
            {"messages": ["x"], "labels": [1], "belief": [0.8, 0.2], "questions": []},
            {"messages": [], "labels": [1, 0], "belief": [0.9, 0.1], "questions": asked},
            {"messages": ["z"], "labels": [0, 1, 1], "belief": [0.7, 0.3]},
        ],
    }


@pytest.mark.parametrize(
    ("costs", "drawn"),
    [
        ([7.0], 0),
        ([9.0, 1.0, 4.0], 2),
        ([9.0, 4.0, 1.0, 4.0, 0.0], 1),  # both cost the median: the first
        ([8.0, 2.0, 3.0, 1.0], 1),  # 2 and 3 are in the middle: the lower
        ([3.0, 3.0, 0.0, 9.0], 0),
        ([0.3, 0.1 + 0.2, 0.0], 0),  # equal but for rounding
    ],
)
def test_the_first_episode_of_median_cost_is_drawn(costs: list[float], drawn: int) -> None:
    found = [story(i, "A", cost) for i, cost in enumerate(costs)]
    assert typical(found) is found[drawn]


SENTENCES = {"x": "Puddles cost 3.", "y": "Never said."}


@pytest.mark.parametrize("scene", [None, Scene(1, 3)], ids=["list", "map"])
def test_the_picture_says_what_the_robot_says_and_which_episode_it_is(scene: Scene | None) -> None:
    one = story(12, "E", 2.5)
    caption = describe_choice(one, 100)
    assert caption == (
        "trace 12, user of type E: cost 2.5, the median of 100 episodes (the first with this cost)"
    )
    figure = draw_trace(scene, one, caption, SENTENCES, ["type_1", "type_2 (the user's)"])
    FigureCanvasAgg(figure).draw()
    texts = [text.get_text() for text in figure.findobj(Text)]
    assert caption in texts
    (said,) = (text for text in texts if text.startswith("The robot says:"))
    assert "before step 1: “Puddles cost 3.” (x)" in said
    assert "before step 2 it asks: “Do puddles matter” – yes" in said
    assert "Never said" not in said
    drawn = (line for axes in figure.findobj(Axes) for line in axes.get_lines())
    lines = {line.get_label(): line.get_ydata() for line in drawn}
    for number, name in enumerate(("type_1", "type_2 (the user's)")):
        np.testing.assert_array_equal(
            lines[name], [[0.5, 0.8, 0.9, 0.7], [0.5, 0.2, 0.1, 0.3]][number]
        )


def colours(axes: Axes, column: int, row: int, *corners: tuple[float, float]) -> set[str]:
    """Reads a drawn picture's colours in some corners of a cell."""
    image = np.asarray(axes.figure.canvas.buffer_rgba())
    places = np.add((column, row), np.multiply(0.4, corners))
    return {to_hex(image[-int(y) - 1, int(x)] / 255) for x, y in axes.transData.transform(places)}


def test_every_label_and_every_cell_of_the_map_is_in_its_place() -> None:
    one, scene = story(0, "E", 1.0), Scene(6, 3, ((1, 1),), (Item("goal", "G", ((0, 2),)),))
    figure = draw_trace(scene, one, "", {}, ["type_1", "type_2"])
    FigureCanvasAgg(figure).draw()
    place, steps, belief = figure.axes
    marks, words = steps.get_legend().legend_handles, steps.get_legend().texts
    key = {own.get_text(): to_hex(mark.get_color()) for mark, own in zip(marks, words, strict=True)}
    for k, i in product(range(3), repeat=2):
        label = one["steps"][k]["labels"][i] if i <= k else 2
        assert colours(steps, k + 1, i + 1, *product((-1, 1), repeat=2)) == {
            (key["inexplicable (?)"], key["explicable"], "#ffffff")[label]
        }
    assert colours(steps, 2, 1, (1.25, 0), (1.25, 2.5), (1.25, 5)) == {
        key["messages before the step"]
    }
    for row, column in product(range(6), range(3)):
        (drawn,) = colours(place, column, row, (1, -1), (-1, 1))
        assert (drawn == "#ffffff") == ((row, column) not in ((1, 1), (0, 2)))
    assert (place.get_xlim(), place.get_ylim()) == ((-0.5, 2.5), (5.5, -0.5))
    assert place.get_position().width > 0.8 * place.get_position(original=True).width
    assert steps.get_xlim() == belief.get_xlim()  # a step is above its belief
    for axes in (steps, belief):
        assert 0 < axes.get_legend().get_window_extent().x0 - axes.bbox.x1 < axes.bbox.width / 4


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
    drawn = [  # without the line at 0
        line.get_xdata()
        for line in axes.lines
        if len(line.get_xdata()) == 2 and line.get_marker() != "None"
    ]
    assert len(drawn) >= 4
    assert np.abs(np.array(drawn) - [0.5, 2.0]).max() < 0.1
