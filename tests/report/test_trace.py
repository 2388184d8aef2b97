"""Pictures: the explanation that is shown, with its description, and plots."""

import json
from dataclasses import replace
from itertools import chain, product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Annotation, Text

from tests.report import handmade
from xplain.domains.base import Item, Scene
from xplain.experiment.results import EPISODES, TypeNames
from xplain.learning.data.dataset import Dataset
from xplain.learning.prediction import CalibrationBin
from xplain.learning.types import Clustering
from xplain.report.plots import calibration, disagreements, draw, effects, posterior
from xplain.report.trace import Story, draw_trace, draw_typical, typical


def story(trace: int, user: str, cost: float) -> Story:
    asked = [{"about": "Do puddles matter", "reply": "yes"}]
    return {
        "trace": trace,
        "type": user,
        "cost": cost,
        "transitions": ["moves right to b", "moves on to c", "stays"],
        "positions": [[0, 0], [0, 1], [0, 2], [0, 2]],
        "prior": [0.5, 0.5],
        "steps": [
            {"messages": ["x"], "labels": [1], "belief": [0.8, 0.2], "questions": []},
            {"messages": [], "labels": [1, 0], "belief": [0.9, 0.1], "questions": asked},
            {"messages": ["z"], "labels": [0, 1, 1], "belief": [0.3, 0.7]},
        ],
    }


@pytest.mark.parametrize(
    ("costs", "drawn"),
    [
        ([7.0], 0),
        ([9.0, 1.0, 4.0], 2),
        ([9.0, 4.0, 1.0, 4.0, 0.0], 1),  # both cost the median: the first
        ([2.5, 2.0, 3.0, 1.0], 1),  # 2 and 2.5 are in the middle: the lower
        ([3.0, 3.0, 0.0, 9.0], 0),
        ([0.3, 0.1 + 0.2, 0.0], 0),  # equal but for rounding
    ],
)
def test_the_first_episode_of_median_cost_is_drawn(costs: list[float], drawn: int) -> None:
    found = [story(i, "A", cost) for i, cost in enumerate(costs)]
    assert typical(found) is found[drawn]


SENTENCES = {"x": "Puddles cost 3.", "y": "Never said."}
SAID = """The robot says:
before step 1: “Puddles cost 3.” (x)
before step 2 it asks: “Do puddles matter” – yes
before step 3: “z” (z)"""
ITEMS = (Item("goal", "G", ((0, 2), (4, 0))), Item("fire", "F", ((5, 2),), ("F1",)))


def draw_whole(figure: Figure) -> list[Axes]:
    """Draws a picture. No two parts of it overlap, nothing leaves it, and every cell has room for a
    letter."""
    FigureCanvasAgg(figure).draw()
    legends, ticks = figure.findobj(Legend), [axes.get_yticklabels() for axes in figure.axes]
    whole = (*figure.axes, *legends, *figure.texts, *chain(*ticks))
    parts = [part.get_window_extent() for part in whole]
    words = (own.get_window_extent() for own in figure.findobj(Text) if own.get_text())
    assert [part.count_overlaps(parts) for part in parts] == [1] * len(parts)  # itself
    for part in (*parts, *words):
        assert figure.bbox.padded(2).count_contains([part.min, part.max]) == 2
    return figure.axes


def colours(axes: Axes, column: int, row: int, *corners: tuple[float, float]) -> set[str]:
    """Reads a drawn picture's colours in some corners of a cell."""
    image = np.asarray(axes.figure.canvas.buffer_rgba())
    places = np.add((column, row), np.multiply(0.4, corners))
    return {to_hex(image[-int(y) - 1, int(x)] / 255) for x, y in axes.transData.transform(places)}


def cells(axes: Axes) -> dict[tuple[str, bool], tuple[int, int]]:
    """Finds the cell (row, column) of each text, and whether the text is in its lower half."""
    found = {}
    for text in (own for own in axes.texts if own.get_text()):
        ends = axes.transData.inverted().transform(text.get_window_extent())
        column, row = ends.mean(axis=0)
        assert np.abs(ends - np.round((column, row))).max() < 0.6
        found[text.get_text(), row > round(row)] = (round(row), round(column))
    return found


def test_the_picture_shows_every_step_of_the_typical_episode(tmp_path: Path) -> None:
    one = story(12, "E", 2.5)
    lines = [one | {"solver": "solver"}, one | {"cost": 2.5, "type": "D", "solver": "oracle"}]
    (tmp_path / EPISODES).write_text("\n".join(map(json.dumps, lines)))
    types = TypeNames(("D", "E"), ("type_1", "type_2"), (0, 1), (0, 1))
    run = replace(
        handmade.results("", {}, ()),
        messages=SENTENCES,
        types=types,
        scene=Scene(6, 3, ((1, 1),), ITEMS),
    )
    figure, _, caption = draw_typical(tmp_path, run)
    assert caption == (
        "trace 12, user of type E: cost 2.5, the median of 1 episode (the first with this cost)"
    )
    place, steps, belief = draw_whole(figure)
    title = "What the robot says to a user of type E: 1 question, 2 messages; 2 inexplicable labels"
    read = [*(text.get_text() for text in figure.texts), steps.get_title("left")]
    assert [text.replace("\n", " ") for text in read] == [
        title,
        SAID.replace("\n", " "),
        caption,
    ]
    assert cells(place) == {
        ("G", False): (4, 0),  # and in the first row
        ("F1", False): (5, 2),
        ("1", True): (0, 1),
        ("2,3", True): (0, 2),
    }
    arrows = [own for own in place.texts if isinstance(own, Annotation)]
    for row, column in product(range(6), range(3)):
        (drawn,) = colours(place, column, row, (1, -1), (-1, 1))
        assert (drawn == "#ffffff") == ((row, column) not in ((1, 1), (0, 2), (4, 0), (5, 2)))
    keys = [[own.get_text() for own in axes.get_legend().texts] for axes in (place, steps, belief)]
    marks = ["messages before the step", "question before the step"]
    labels = ["explicable", "inexplicable (?)"]
    shown = {own.get_label(): own.get_xydata().T.tolist() for own in (*steps.lines, *belief.lines)}
    key = {
        text: to_hex(own.get_color())
        for text, own in zip(keys[1], steps.get_legend().legend_handles, strict=True)
    }
    for k, i in product(range(3), repeat=2):
        label = one["steps"][k]["labels"][i] if i <= k else 2
        assert colours(steps, k, i, *product((-1, 1), repeat=2)) == {
            (key["inexplicable (?)"], key["explicable"], "#ffffff")[label]
        }
    assert colours(steps, 1, 0, (1.25, 0), (1.25, 2.5), (1.25, 5)) == {key[marks[0]]}
    names = [
        [own.get_text() for own in axis.get_ticklabels()]
        for axis in (steps.yaxis, steps.xaxis, belief.xaxis, place.xaxis)
    ]
    found = {
        "arrows": [(own.xyann, own.xy) for own in arrows],
        "start": place.lines[-1].get_xydata().tolist(),
        "legends": keys,
        "marks": [shown[key] for key in marks],
        "questions": sorted(own.get_position() for own in steps.texts),
        "beliefs": [shown[key] for key in keys[2]],
        "ticks": names,
        "ends": [place.get_xlim(), place.get_ylim(), belief.get_ylim()],
        "steps": steps.get_xlim(),
    }
    assert found == {
        "arrows": [((0, 0), (1, 0)), ((1, 0), (2, 0))],
        "start": [[0, 0]],
        "legends": [["G  goal", "F  fire"], labels + marks, ["type_2 (the user's)", "type_1"]],
        "marks": [[[-0.5, 1.5], [1, 1]], [[1], [1]]],
        "questions": [(1, 1), (2, 0)],
        "beliefs": [[[-0.5, 0, 1, 2], own] for own in ([0.5, 0.2, 0.1, 0.7], [0.5, 0.8, 0.9, 0.3])],
        "ticks": [
            ["1. moves right to b", "2. moves on to c", "3. stays"],
            [*"123"],
            [*"123"],
            [*"012"],
        ],
        "ends": [(-0.5, 2.5), (5.5, -0.5), (-0.05, 1.05)],
        "steps": belief.get_xlim(),  # a step is above its belief
    }
    for axes in (steps, place):
        sides = np.abs(np.diff(axes.transData.transform([(0, 0), (1, 1)]), axis=0)) / figure.dpi
        assert ((sides > 0.2) & (sides < 0.6)).all()
    assert np.ptp(sides) < 1e-6  # the map's cells are squares


def test_without_a_map_effects_are_below_their_transitions() -> None:
    one = story(3, "E", 1.0) | {
        "positions": [],
        "changes": [["has a key", "is at home"], ["c"], ["d ddd"] * 20],
    }
    (steps,) = draw_whole(draw_trace(None, one, "", SENTENCES, ["type_1"]))
    names = [own.get_text() for own in steps.get_yticklabels()]
    assert names[:2] == ["1. moves right to b\nhas a key; is at home", "2. moves on to c\nc"]
    assert names[2].count("\n") == 2
    for width in (steps.bbox.width, steps.bbox.height):
        assert 0.6 < width / steps.figure.dpi < 4


@pytest.mark.parametrize("least", [0.0, -4.0], ids=["costs", "regrets"])
def test_every_interval_is_inside_its_panel(least: float) -> None:
    rng = np.random.default_rng(5)
    points = pd.DataFrame(
        {"panel": panel, "line": line, "x": x, "mean": least + 2.0 * height * rng.random()}
        for height, panel in enumerate("abcdef", 1)  # the first panel of a row has the lowest
        for line in ("one", "other")
        for x in (0.5, 1.0, 2.0)
    ).eval("low = mean - 0.1 * (mean > 0.1)\nhigh = mean + 1")
    figure = draw(points, "x", "y", per_row=4)
    assert (figure.get_size_inches() > (4 * 3, 2 * 3)).all()
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_ylabel() for axes in shown] == ["y", "", "", "", "y", ""]
    for axes, (_, own) in zip(shown, points.groupby("panel"), strict=True):
        bottom, top = axes.get_ylim()
        assert bottom <= own["low"].min()
        assert top >= own["high"].max()
        assert least < 0 or bottom == 0


def test_an_effect_is_the_share_with_a_message_less_the_share_without() -> None:
    """All labels have the last message, so its effect is unknown."""
    observer, given, label = np.random.default_rng(3).integers(((3,), (8,), (2,)), size=(3, 60))
    names, nothing = ("a long name", "b" * 20, "c" * 30), np.zeros(60, np.int64)
    dataset = Dataset(
        np.zeros((1, 1)), ("f",), names, names, observer, nothing, given | 4, label.astype(np.uint8)
    )
    figure = effects(dataset, Clustering(np.array([0, 1, 0]), "", ""), ["first", "second"])
    for own, axes in zip((observer != 1, observer == 1), figure.axes, strict=True):
        (drawn,) = axes.containers
        shares = [
            [label[own & (given >> bit & 1 == one)].mean() for one in (0, 1)] for bit in (0, 1)
        ]
        gains = [*(100 * (one - zero) for zero, one in shares), np.nan]
        np.testing.assert_allclose(drawn.lines[0].get_xydata(), [*enumerate(gains)])
        texts = axes.get_xticklabels()
        assert [text.get_text() for text in texts] == [*names]
        # Turned lines of text are apart if the distance of their ends, seen along them, is a line.
        apart = np.diff(axes.transData.transform([(0, 0), (1, 0)])[:, 0]) / figure.dpi * 72
        assert all(
            apart * np.sin(np.radians(text.get_rotation())) > text.get_fontsize() for text in texts
        )
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["first", "second"]


@pytest.mark.parametrize(
    ("figure", "curve", "chosen", "words"),
    [
        (
            disagreements([9.0 - k for k in range(9)], 12, "elbow"),
            {k: 10 - k for k in range(1, 10)},
            9,
            "chosen: 12 (elbow)",
        ),
        (posterior({2: 0.75, 3: 0.25}, 2), {1: 0, 2: 0.75, 3: 0.25, 4: 0}, 2, "taken: 2"),
    ],
    ids=["disagreements", "posterior"],
)
def test_the_chosen_number_of_types_is_marked(figure, curve, chosen, words) -> None:
    (axes,) = figure.axes
    assert dict(axes.containers[0].lines[0].get_xydata()) == curve
    assert dict(axes.lines[-1].get_xydata()[[chosen - 1]]) == {chosen: curve[chosen]}
    assert np.isfinite(axes.lines[-1].get_ydata()).sum() == 1
    assert [text.get_text() for text in figure.legends[0].texts] == [words]
    assert all(tick == int(tick) for tick in axes.get_xticks())


def test_predictions_are_beside_the_line_of_those_that_are_right() -> None:
    bins = [CalibrationBin(0.2, 0.1, 0.05, 0.3, 44), CalibrationBin(0.7, 0.8, 0.6, 0.9, 40)]
    (axes,) = calibration(bins).axes
    found, ideal = (line.lines for line in axes.containers)
    assert np.abs(found[0].get_xydata() - [(0.2, 0.1), (0.7, 0.8)]).max() < 0.02
    ends = np.array(found[2][0].get_segments())[:, :, 1]
    np.testing.assert_allclose(ends, [(0.05, 0.3), (0.6, 0.9)])
    assert np.abs(ideal[0].get_xydata() - [(0, 0), (1, 1)]).max() < 0.02
    assert axes.get_xlabel().endswith("(2 parts of at least 40 labels)")
