"""What MLflow's pages open on: saved views of an experiment, and its description.

A view is a tag of the experiment, ``mlflow.sharedViewState.<key>``, that holds what the page of
runs keeps in the browser: filter, order, columns, charts. The keys are those of MLflow 3.17's page,
which ignores what it does not know.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from xplain.report.combinations import grouped, heading, value_label
from xplain.report.comparison import verdicts
from xplain.report.layout import plot_layout
from xplain.report.measure import is_problem
from xplain.report.summary import Summary, Value, is_number
from xplain.runs.plan import Job

if TYPE_CHECKING:
    from mlflow import MlflowClient

SWEEP_TAG = "xplain.sweep"
"""Tag of a sweep's parent: identity of the sweep."""

VIEW_TAG = "mlflow.sharedViewState."
ANSWER_TAG = "xplain.answer"
"""Tag of a sweep's parent: what won, by how much, whether that is decided."""
SWEEPS_VIEW = "sweeps"
"""Key of the view over all sweeps."""

MOST_CURVES = 12


@dataclass(frozen=True)
class MainKey:
    """The swept key on the horizontal axis of charts, whose steps are whole numbers.

    Attributes:
        key: "" where no key has several numbers for values.
        scale: a power of ten; a step is so many times the value.
    """

    key: str
    scale: int

    def step(self, values: Mapping[str, str]) -> int:
        """Of a job with these swept values."""
        return round(self.scale * float(values.get(self.key) or 0)) if self.key else 0

    @property
    def title(self) -> str:
        """What a step is: ``10 λ``."""
        return f"{'' if self.scale == 1 else f'{self.scale} '}{heading(self.key)}"


def swept_values(jobs: Sequence[Job]) -> dict[str, list[str]]:
    """``{swept key: its values}``, in the order of the jobs."""
    keys = dict.fromkeys(key for job in jobs for key in job.values)
    return {
        key: list(dict.fromkeys(job.values[key] for job in jobs if key in job.values))
        for key in keys
    }


def main_key(jobs: Sequence[Job]) -> MainKey:
    """The numeric key with most values, λ before others; seeds are replicates."""
    numbers = {
        key: [float(value) for value in own]
        for key, own in swept_values(jobs).items()
        if key != "seed" and len(own) > 1 and all(map(is_number, own))
    }
    key = max(numbers, key=lambda key: (len(numbers[key]), key == "lambda"), default="")
    scale = 1
    while scale < 10**6 and any(
        abs(scale * x - round(scale * x)) > 1e-9 for x in numbers.get(key, [])
    ):
        scale *= 10
    return MainKey(key, scale)


def bests(summary: Summary) -> dict[str, float]:
    """``{metric: mean}`` of the way that costs least, one a problem: ``best_regret`` where one was
    swept, else ``best_regret/λ 0.5`` and so on."""
    found = verdicts(summary)[:MOST_CURVES]
    name = f"best_{summary.measure.name}"
    return {_metric(name, one.problem): one.order[0].estimate.mean for one in found}


def curves(summary: Summary, main: MainKey) -> list[tuple[str, int, float]]:
    """(metric, step, value) for the parent's charts: a metric a line of the report's plot, which
    says what its steps are. Combinations of which a job is missing are left out: their mean would
    change later."""
    layout, measure = plot_layout(summary), summary.measure.name
    if not main.key or layout.x != main.key:
        return []
    found = []
    for values, frame in grouped(summary, (*layout.panels, *layout.lines))[:MOST_CURVES]:
        for value in summary.values(main.key):
            own = frame[frame[main.key] == value].dropna(subset=[measure])
            if len(own) and summary.complete({**values, main.key: value}):
                step = round(main.scale * float(value or 0))
                name = _metric(f"{measure} against {main.title}", values)
                found.append((name, step, summary.mean(own, measure).mean))
    return found


def _metric(name: str, values: Mapping[str, Value]) -> str:
    """Without the characters that MLflow refuses in names."""
    words = [
        str(value) if key in ("domain", "solver") else value_label(key, value)
        for key, value in values.items()
    ]
    return re.sub(r"[^\w./ -]", " ", "/".join([name, *words])).replace("   ", " ").strip()


def sweep_view(parent: str, summary: Summary, main: MainKey) -> dict[str, Any]:
    """The jobs of a sweep: the measure first, in sight whatever was swept; of several seeds their
    means, in groups that open. The best come first, where it is one problem that is solved, else
    the jobs in the order of the problems."""
    measure = summary.measure.name
    swept = [key for key in summary.keys if len(summary.values(key)) > 1]
    figures = dict.fromkeys((measure, "cost"))
    beside = [name.replace(" ", "_") for name in summary.counted]
    columns = [
        *(f"metrics.`{name}`" for name in figures),
        *(f"params.`{key}`" for key in (*swept, *(["seed"] if summary.seeds > 1 else []))),
        *(f"metrics.`{name}`" for name in (f"{measure}.low", f"{measure}.high", *beside)),
    ]
    chart = {
        "type": "SCATTER",
        "xaxis": {"key": main.key, "type": "PARAM"},
        "yaxis": {"key": measure, "type": "METRIC"},
        "displayName": f"{summary.measure.title} against {heading(main.key)}, a point a job",
    }
    posed = sorted((key for key in swept if is_problem(key)), key=lambda key: key != main.key)
    problem = f"params.`{posed[0]}`" if posed else None
    return {
        **_view(parent, problem or f"metrics.`{measure}`"),
        "selectedColumns": columns,
        "columnOrder": columns,
        "columnWidths": {column: _width(column) for column in columns},
        **(_means(swept) if summary.seeds > 1 and swept else {}),
        **(_charts(chart) if main.key else {}),
    }


def _means(keys: Sequence[str]) -> dict[str, Any]:
    """A row a combination of these keys, with the mean over its jobs."""
    by = [{"mode": "param", "groupByData": key} for key in keys]
    return {"groupBy": {"aggregateFunction": "average", "groupByKeys": by}}


def chart_view(parent: str, summary: Summary, main: MainKey) -> dict[str, Any]:
    """The jobs by solver or other choice, and one chart of the measure against the main key with a
    line for each: means over seeds, the band from least to greatest."""
    layout, measure = plot_layout(summary), summary.measure
    keys = (*layout.lines, *layout.panels) or ("solver",)
    chart = {
        "type": "LINE",
        "metricKey": measure.name,
        "selectedMetricKeys": [measure.name],
        "xAxisKey": "step",
        "xAxisScaleType": "linear",
        "scaleType": "linear",
        "lineSmoothness": 0,
        "displayPoints": True,
        "displayName": f"{measure.title} against {main.title}",
    }
    return {
        **sweep_view(parent, summary, main),
        **_means(keys),
        "useGroupedValuesInCharts": True,
        **_charts(chart),
    }


def sweeps_view() -> dict[str, Any]:
    """One row a sweep with what it answered, the newest first: figures of unlike sweeps have no
    order."""
    params = ("jobs", "domain", "solver", "lambda")
    columns = [f"tags.`{ANSWER_TAG}`", *(f"params.`{name}`" for name in params)]
    return {
        **_EVERYTHING,
        "searchFilter": f"tags.`{SWEEP_TAG}` LIKE '%'",
        "orderByKey": "attributes.start_time",
        "orderByAsc": False,
        "selectedColumns": columns,
        "columnOrder": columns,
        "columnWidths": {columns[0]: 700},
    }


def _view(parent: str, order: str) -> dict[str, Any]:
    return {
        **_EVERYTHING,
        "searchFilter": f"tags.`mlflow.parentRunId` = '{parent}'",
        "orderByKey": order,
        "orderByAsc": True,
    }


def _width(column: str) -> int:
    """Pixels: as narrow as its heading allows, so that figures are seen without scrolling."""
    name = column.partition("`")[2].rstrip("`")
    return max(80, 8 * len(name) + 24)


_EVERYTHING = {"runsHiddenMode": "SHOW_ALL"}
"""All runs are in a chart, not the first ten. What a view leaves out is as MLflow's page has it by
itself: no filter but the view's, table and charts side by side."""


def _charts(chart: Mapping[str, Any]) -> dict[str, Any]:
    """One chart, in a wide section of its own above those that the page makes by itself."""
    section = "xplain-section"
    return {
        "compareRunSections": [
            {
                "uuid": section,
                "name": chart["displayName"],
                "display": True,
                "isReordered": True,
                "columns": 1,
                "cardHeight": 420,
            }
        ],
        "compareRunCharts": [
            {
                "uuid": "xplain-regret",
                "metricSectionId": section,
                "deleted": False,
                "isGenerated": False,
                **chart,
            }
        ],
        "isAccordionReordered": True,
    }


def save_view(client: MlflowClient, experiment: str, key: str, view: Mapping[str, Any]) -> None:
    """Writes a view, over one of this key."""
    client.set_experiment_tag(experiment, VIEW_TAG + key, json.dumps(view))


def view_address(pages: str, experiment: str, key: str, chart: bool = False) -> str:
    """Where a view is opened.

    Args:
        pages: where the user interface is, up to the ``#``; just ``#`` in MLflow's own texts.
        experiment: its id.
        key: of the view.
        chart: whether charts are shown first, beside the list, or the table of runs.
    """
    page = f"{pages}/experiments/{experiment}/runs"
    mode = "&compareRunsMode=CHART" if chart else ""
    return f"{page}?workflowType=machine_learning&viewStateShareKey={key}{mode}"


def describe_experiment(client: MlflowClient, experiment: str, newest: str = "") -> None:
    """The experiment's description, which begins with links, and the view over all sweeps.

    Args:
        client, experiment: where to.
        newest: link to the newest sweep, in Markdown; "" keeps the one that is there.
    """
    save_view(client, experiment, SWEEPS_VIEW, sweeps_view())
    before = client.get_experiment(experiment).tags.get("mlflow.note.content", "")
    newest = newest or next((line for line in before.split(SEPARATOR) if "ewest" in line), "")
    text = SEPARATOR.join(
        [
            *([newest] if newest else []),
            f"[All sweeps]({view_address('#', experiment, SWEEPS_VIEW)})",
            ABOUT,
        ]
    )
    if text != before:
        client.set_experiment_tag(experiment, "mlflow.note.content", text)


SEPARATOR = " · "
ABOUT = (
    "Personalized explanations of a robot's decisions: each run explains traces to simulated users "
    "of every type. **Regret** is what an explanation cost minus what it costs an agent that knows "
    "the user's type."
)
