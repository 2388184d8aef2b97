"""What a run says in MLflow, noted by a client that keeps what it is sent."""

from __future__ import annotations

import itertools
import logging
import re
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from xplain.experiment.results import ElbowFigures, Figure, Results, TypeNames
from xplain.report.summary import Summary
from xplain.runs.mlflow import MLflow, refuse_unusable
from xplain.runs.mlflow_run import MOST_PARAMETERS, fill, parameters
from xplain.runs.mlflow_views import main_key, sweep_view
from xplain.runs.plan import Job

RESULTS = Results(
    name="by hand",
    xplain="0",
    code="c0de",
    git={},
    started=1000.5,
    seconds={"learn": 2.0, "explain": 3.5},
    choices={"solver": "qmdp", "domain": "rescue"},
    config={"seed": 4, "lambda": 0.5, "solver": {"memory": {"limit": 2}}},
    metrics={"regret": Figure(1.25, 1.0, 1.5), "types": Figure(3.0, None, None)},
    bounds={"gap": 0.01},
    learning={"adjusted_rand_index": 0.9},
    elbow=ElbowFigures("kneedle", (40.0, 7.0, 1.0)),
    messages={},
    scene=None,
    types=TypeNames((), (), (), ()),
    steps={"belief_in_true_type": (0.2, 0.6, 0.9)},
    episodes=(),
)


class Notebook:
    """Takes what a client of MLflow is told."""

    def __init__(self) -> None:
        self.metrics: list[tuple[str, float, int]] = []
        self.params: dict[str, str] = {}
        self.tags: dict[str, str] = {}
        self.times: set[int] = set()
        self.files: list[str] = []
        self.ended: list[tuple[str, str, int]] = []

    def log_batch(self, run: str, metrics: Any, params: Any, tags: Any) -> None:
        self.metrics += [(one.key, one.value, one.step) for one in metrics]
        self.times |= {one.timestamp for one in metrics}
        self.params |= {one.key: one.value for one in params}
        self.tags |= {one.key: one.value for one in tags}

    def log_artifact(self, run: str, path: str) -> None:
        self.files.append(Path(path).name)

    def set_terminated(self, run: str, status: str, end: int) -> None:
        self.ended.append((run, status, end))


def noted(folder: Path) -> Notebook:
    notebook = Notebook()
    fill(notebook, "run", folder, RESULTS)  # type: ignore[arg-type]
    return notebook


def curve(notebook: Notebook, name: str) -> dict[int, float]:
    return {step: value for key, value, step in notebook.metrics if key == name}


def test_curves_stand_at_the_numbers_they_belong_to(tmp_path: Path) -> None:
    notebook = noted(tmp_path)
    # Disagreements with one type, two, three; beliefs before the first step, after it, …
    assert curve(notebook, "disagreements") == {1: 40.0, 2: 7.0, 3: 1.0}
    assert curve(notebook, "belief_in_true_type") == {0: 0.2, 1: 0.6, 2: 0.9}


def test_each_figure_is_logged_once_under_its_name(tmp_path: Path) -> None:
    notebook = noted(tmp_path)
    single = {key: value for key, value, _ in notebook.metrics if "belief" not in key}
    del single["disagreements"]
    assert single == {
        "regret": 1.25,
        "regret.low": 1.0,
        "regret.high": 1.5,
        "adjusted_rand_index": 0.9,
        "seconds": 5.5,
    }
    assert len(notebook.metrics) == len(single) + 3 + 3
    assert notebook.params == {"solver": "qmdp", "domain": "rescue", "seed": "4", "lambda": "0.5"}
    assert notebook.tags["xplain.rule"] == "kneedle"
    assert "regret 1.250" in notebook.tags["mlflow.note.content"]


def test_swept_keys_are_parameters_and_few_others_are(tmp_path: Path) -> None:
    many = {f"key{i}": i for i in range(40)}
    swept = {"users.count": "3", "solver": "qmdp", "solver.memory.limit": "2"}
    found = parameters(replace(RESULTS, config=many), swept)
    assert len(found) == MOST_PARAMETERS
    assert {"users.count": "3", "solver.memory.limit": "2", "solver": "qmdp"}.items() <= (
        found.items()
    )


def test_the_main_key_is_the_one_with_most_numbers_and_its_steps_are_whole() -> None:
    def jobs(**values: list[str]) -> list[Job]:
        keys = list(values)
        return [
            Job(str(found), "", (), dict(zip(keys, found, strict=True)), str(found), "")
            for found in itertools.product(*values.values())
        ]

    main = main_key(
        jobs(trade=["0", ".02", ".125"], solver=["a", "b", "c", "d"], seed=list("0123"))
    )
    assert (main.key, main.scale) == ("trade", 1000)
    assert main.step({"trade": ".125", "solver": "a"}) == 125
    both = {"count": ["2", "3"], "lambda": ["0.5", "1"]}
    assert main_key(jobs(**both)).key == "lambda"
    assert main_key(jobs(solver=["a", "b"])).key == ""
    assert main_key(jobs(solver=["a", "b"])).step({"solver": "a"}) == 0


def test_a_run_ends_when_its_work_did_and_hides_no_file(tmp_path: Path) -> None:
    for name in ("results.json", ".lock", "elbow.svg"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    notebook = noted(tmp_path)
    # Milliseconds: 1000.5 s + 2 s + 3.5 s.
    assert notebook.ended == [("run", "FINISHED", 1_006_000)]
    assert notebook.times == {1_006_000}
    assert notebook.files == ["elbow.svg", "results.json"]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError("no space left\nsecond line"), "(no space left)"),
        (OSError("  \n"), "(OSError)"),
        (ValueError("x" * 300), "(" + "x" * 200 + ")"),
    ],
)
def test_what_mlflow_does_not_take_costs_a_warning_that_says_why(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    error: Exception,
    said: str,
) -> None:
    def fails(self: MLflow, outputs: Path) -> Any:
        raise error

    monkeypatch.setattr(MLflow, "store", fails)
    with caplog.at_level(logging.WARNING):
        assert MLflow().log(tmp_path / "run", tmp_path) == []
    assert said in caplog.text
    assert f"xplain sync {tmp_path / 'run'}" in caplog.text


def test_a_database_that_another_process_holds_is_refused_and_none_is_made(tmp_path: Path) -> None:
    path = tmp_path / "mlflow.db"
    refuse_unusable(f"sqlite:///{path}")
    assert not path.exists()
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("CREATE TABLE t (x)")
        refuse_unusable(f"sqlite:///{path}")
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(sqlite3.OperationalError, match="locked"):
            refuse_unusable(f"sqlite:///{path}", patience=0.1)
    refuse_unusable("postgresql://somewhere/else")  # not for us to try


def test_the_command_that_opens_the_pages_names_the_runs_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shows = "mlflow ui --backend-store-uri "
    own, far = tmp_path / "outputs", tmp_path / "far"
    assert MLflow().how_to_open(own) == shows + "sqlite:///outputs/mlflow.db"
    assert MLflow().how_to_open(far) == shows + f"sqlite:///{far}/mlflow.db"
    elsewhere = MLflow(uri="sqlite:////data/all.db")
    assert elsewhere.how_to_open(own) == elsewhere.how_to_open(far) == shows + elsewhere.uri
    assert MLflow(uri="http://lab:5000").how_to_open(own) is None


def test_the_view_of_a_sweep_begins_with_its_measure_and_has_what_was_swept() -> None:
    swept = {"lambda": ["1", "2"], "users.count": ["2", "3"], "solver": ["qmdp"]}
    summary = SimpleNamespace(
        keys=tuple(swept),
        values=swept.__getitem__,
        seeds=3,
        measure=SimpleNamespace(name="above_floor", title="cost above the clairvoyant's"),
        counted=("messages", "inexplicable labels", "questions"),
    )
    jobs = tuple(Job(value, "", (), {"lambda": value}, value, "") for value in ("1", "2"))
    view = sweep_view("parent", cast("Summary", summary), main_key(jobs))
    columns = [re.sub(r"`|params\.|metrics\.", "", column) for column in view["columnOrder"]]
    ends = ["above_floor.low", "above_floor.high", "messages", "inexplicable_labels", "questions"]
    assert columns == ["above_floor", "cost", "lambda", "users.count", "seed", *ends]
    assert view["selectedColumns"] == view["columnOrder"] == list(view["columnWidths"])
