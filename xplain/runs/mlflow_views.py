"""What MLflow's pages open on: saved views of an experiment, and its description.

A view is a tag of the experiment, ``mlflow.sharedViewState.<key>``, that holds what the page of
runs keeps in the browser: filter, order, columns, charts. The keys are those of MLflow 3.17's page,
which ignores what it does not know.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xplain.report.combinations import (
    Combination,
    combinations,
    grouped,
    heading,
    value_label,
)
from xplain.report.layout import plot_layout
from xplain.report.summary import Summary, Value

if TYPE_CHECKING:
    from mlflow import MlflowClient

VIEW_OF = "xplain.in"
"""Tag of a sweep's parent and of its children: the parent's id."""

VIEW_TAG = "mlflow.sharedViewState."
SWEEPS_VIEW = "sweeps"
"""Key of the view over all sweeps."""

FIGURES = ("regret", "regret.low", "regret.high", "cost", "messages", "inexplicable_labels")
"""Columns of a sweep's view beside what was swept."""

MOST_CURVES = 12


@dataclass(frozen=True)
class Curve:
    """A line of the parent's chart: its metric, and (step, regret)."""

    name: str
    points: tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Chart:
    """Regret against the main swept key.

    Attributes:
        title: says what a step is.
        curves: one a line and panel of the report's plot.
    """

    title: str
    curves: tuple[Curve, ...]


def every_combination(summary: Summary) -> list[Combination]:
    """All swept combinations of which a regret is known."""
    found = combinations(summary, summary.keys)
    return [one for one in found if "regret" in one.estimates]


def chart_of(summary: Summary) -> Chart:
    """The curves for MLflow, whose steps are whole numbers. Combinations of which a job is missing
    are left out: their mean would change later."""
    layout = plot_layout(summary)
    if layout.x is None or not layout.numeric:
        return Chart("", ())
    numbers = [value for value in summary.values(layout.x) if isinstance(value, float)]
    scale = _scale(numbers)
    curves = []
    for values, frame in grouped(summary, (*layout.panels, *layout.lines)):
        points = []
        for value in numbers:
            own = frame[frame[layout.x] == value].dropna(subset=["regret"])
            if len(own) and summary.complete({**values, layout.x: value}):
                points.append((round(scale * value), summary.mean(own, "regret").mean))
        if points:
            curves.append(Curve(_metric("regret", values), tuple(points)))
    times = "" if scale == 1 else f"{scale} × "
    return Chart(f"regret against {times}{heading(layout.x)}", tuple(curves))


def _scale(numbers: list[float]) -> int:
    """A power of ten that makes all of them whole."""
    scale = 1
    while scale < 10**6 and any(abs(scale * x - round(scale * x)) > 1e-9 for x in numbers):
        scale *= 10
    return scale


def _metric(name: str, values: Mapping[str, Value]) -> str:
    """Without the characters that MLflow refuses in names."""
    words = [
        str(value) if key in ("domain", "solver") else value_label(key, value)
        for key, value in values.items()
    ]
    return re.sub(r"[^\w./ -]", " ", "/".join([name, *words])).replace("   ", " ").strip()


def sweep_view(parent: str, summary: Summary, chart: Chart) -> dict[str, Any]:
    """Flat rows of a sweep's jobs: what was swept and their figures, the least regret first."""
    swept = ["solver", "lambda", *(k for k in summary.keys if k not in ("solver", "lambda"))]
    if summary.seeds > 1:
        swept.append("seed")
    return {
        **_view(f"tags.`{VIEW_OF}` = '{parent}'", "regret"),
        "selectedColumns": [
            *(f"params.`{key}`" for key in swept),
            *(f"metrics.`{name}`" for name in FIGURES),
        ],
        **_charts(chart),
    }


def sweeps_view() -> dict[str, Any]:
    """One row a sweep, the newest first, with its best regret."""
    return {
        **_view("tags.`xplain.sweep` LIKE '%'", None),
        "selectedColumns": [
            "metrics.`best_regret`",
            "params.`solver`",
            "params.`lambda`",
            "params.`jobs`",
            "attributes.`Duration`",
            "attributes.`Description`",
        ],
    }


def _view(condition: str, metric: str | None) -> dict[str, Any]:
    return {
        "searchFilter": condition,
        "orderByKey": "attributes.start_time" if metric is None else f"metrics.`{metric}`",
        "orderByAsc": metric is not None,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "datasetsFilter": [],
        "modelVersionFilter": "All Runs",
        "runsHiddenMode": "SHOW_ALL",
        "viewMaximized": False,
        "runListHidden": False,
    }


def _charts(chart: Chart) -> dict[str, Any]:
    """Our chart in a section of its own, above those that the page makes by itself."""
    if not chart.curves:
        return {}
    names = [curve.name for curve in chart.curves[:MOST_CURVES]]
    return {
        "compareRunSections": [
            {
                "uuid": "xplain-section",
                "name": chart.title,
                "display": True,
                "isReordered": True,
            }
        ],
        "compareRunCharts": [
            {
                "uuid": "xplain-regret",
                "type": "LINE",
                "metricSectionId": "xplain-section",
                "deleted": False,
                "isGenerated": False,
                "metricKey": names[0],
                "selectedMetricKeys": names,
                "xAxisKey": "step",
                "xAxisScaleType": "linear",
                "scaleType": "linear",
                "lineSmoothness": 0,
                "displayPoints": True,
                "displayName": chart.title,
            }
        ],
        "isAccordionReordered": True,
    }


def save_view(client: MlflowClient, experiment: str, key: str, view: Mapping[str, Any]) -> None:
    """Writes a view, over one of this key."""
    client.set_experiment_tag(experiment, VIEW_TAG + key, json.dumps(view))


def view_address(pages: str, experiment: str, key: str) -> str:
    """Where a view is opened.

    Args:
        pages: where the user interface is, up to the ``#``.
        experiment: its id.
        key: of the view.
    """
    page = f"{pages}/experiments/{experiment}/runs"
    return f"{page}?workflowType=machine_learning&viewStateShareKey={key}"


def describe_experiment(client: MlflowClient, experiment: str, pages: str) -> None:
    """The experiment's description, and the view over all sweeps."""
    save_view(client, experiment, SWEEPS_VIEW, sweeps_view())
    link = view_address(pages, experiment, SWEEPS_VIEW)
    text = (
        "Personalized explanations of a robot's decisions: each run explains traces to simulated "
        "users of every type. **regret** is what an explanation cost minus what it costs an agent "
        f"that knows the user's type. [All sweeps with their best regret]({link}); the description "
        "of each sweep links its table."
    )
    client.set_experiment_tag(experiment, "mlflow.note.content", text)
