"""Runs and sweeps in MLflow, read with its own client."""

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.entities import Run

from tests.report import handmade
from tests.runs.sweeps import planned
from xplain.errors import InputError, XplainError
from xplain.experiment.results import ElbowFigures, Figure, save_results
from xplain.report.folder import FAILURE, ListedJob, SweepFolder
from xplain.report.frame import Summary
from xplain.runs.folder import without_passwords
from xplain.runs.job import mark_failed
from xplain.runs.mlflow import MLflow, sync, view

PARENT = "mlflow.parentRunId"


@pytest.fixture
def outputs(tmp_path: Path, empty_store: Path) -> Path:
    """Makes an outputs folder with an empty database."""
    shutil.copy(empty_store, tmp_path / "mlflow.db")
    return tmp_path


@pytest.fixture
def client(outputs: Path) -> MlflowClient:
    return MlflowClient(f"sqlite:///{outputs / 'mlflow.db'}")


@pytest.fixture
def folder(outputs: Path) -> SweepFolder:
    """Runs a sweep of three jobs."""
    return planned(outputs, 3)


def runs(client: MlflowClient) -> list[Run]:
    experiment = client.get_experiment_by_name("xplain")
    return list(client.search_runs([experiment.experiment_id]))


def parent(client: MlflowClient) -> Run:
    (found,) = (run for run in runs(client) if PARENT not in run.data.tags)
    return found


def children(client: MlflowClient) -> dict[str, str]:
    """Returns ``{name: status}`` of the jobs' runs."""
    below = {PARENT: parent(client).info.run_id}.items()
    return {
        str(run.info.run_name): str(run.info.status)
        for run in runs(client)
        if below <= run.data.tags.items()
    }


def fail(folder: SweepFolder, job: ListedJob) -> None:
    mark_failed(folder.of(job), RuntimeError("no memory"))


def finish(folder: SweepFolder, job: ListedJob, started: float = 1e9) -> None:
    folder.address(job).mkdir(parents=True, exist_ok=True)
    episodes = tuple(handmade.episode(name, 0, "A", 1.0) for name in ("oracle", "solver"))
    own = handmade.results(job.label, {}, episodes)
    own = replace(own, started=started, fingerprint=job.fingerprint)
    save_results(folder.address(job), own)


def send(folder: SweepFolder) -> None:
    sync([folder.path], folder.path.parents[1], MLflow())


def test_a_run_has_its_figures_curves_choices_and_files(
    outputs: Path, client: MlflowClient
) -> None:
    own = replace(
        handmade.results("by hand", {}, (handmade.episode("solver", 0, "A", 1.0),)),
        started=1000.5,
        seconds={"learn": 2.0, "explain": 3.5},
        config={"seed": 4, "lambda": 0.5, "solver": {"memory": {"limit": 2}}},
        metrics={"regret": Figure(1.25, 1.0, 1.5), "cost": Figure(3.0, None, None)},
        learning={"adjusted_rand_index": 0.9},
        elbow=ElbowFigures("kneedle", (40.0, 7.0, 1.0)),
        fingerprint="one",
    )
    place = outputs / "runs" / "mine"
    place.mkdir(parents=True)
    save_results(place, own)
    (place / "config.yaml").touch()
    for _ in range(2):  # sent twice, it is there once
        lines = MLflow().log(place, outputs)
        assert lines[0].startswith("MLflow: http://127.0.0.1:5000/#/experiments/")
        (run,) = runs(client)
    assert run.info.status == "FINISHED"
    # Milliseconds: 1000.5 s, and 2 s + 3.5 s more.
    assert (run.info.start_time, run.info.end_time) == (1_000_500, 1_006_000)
    assert sorted(run.data.metrics)[0] == "regret"  # what a comparison draws
    single = {key: value for key, value in run.data.metrics.items() if "/" not in key}
    assert single == {"regret": 1.25, "regret_low": 1.0, "regret_high": 1.5}
    assert run.data.metrics["solver/seconds"] == 5.5
    assert run.data.metrics["types/adjusted_rand_index"] == 0.9
    for name in run.data.metrics:  # nothing over a pretended step
        assert [point.step for point in client.get_metric_history(run.info.run_id, name)] == [0]
    assert run.data.params == {**own.choices, "seed": "4", "lambda": "0.5"}
    files = {file.path for file in client.list_artifacts(run.info.run_id)}
    assert files == {"config.yaml", "results.json"}


def test_a_sweep_is_a_parent_with_a_child_for_each_job_that_ended(
    client: MlflowClient, folder: SweepFolder
) -> None:
    """It keeps its parent and what was sent; what ran again takes the place of what was sent."""
    first, second, third = folder.jobs
    send(folder)
    assert (parent(client).info.status, children(client)) == ("KILLED", {})
    fail(folder, second)
    send(folder)
    assert children(client) == {second.label: "FAILED"}
    (failed,) = (run for run in runs(client) if PARENT in run.data.tags)
    assert failed.data.tags["xplain.error"] == "RuntimeError: no memory"
    at = int(1000 * (folder.of(second) / FAILURE).stat().st_mtime)
    assert (failed.info.start_time, failed.info.end_time) == (at, at)
    assert [file.path for file in client.list_artifacts(failed.info.run_id)] == [FAILURE]
    finish(folder, third)
    for _ in range(2):
        send(folder)
        assert children(client) == {second.label: "FAILED", third.label: "FINISHED"}
        assert parent(client).info.status == "FAILED"
    before = {run.info.run_id for run in runs(client)}
    finish(folder, second)
    finish(folder, third, started=2e9)
    send(folder)
    assert children(client) == {second.label: "FINISHED", third.label: "FINISHED"}
    assert parent(client).info.status == "KILLED"
    again = {run.info.run_id for run in runs(client)}
    assert before & again == {parent(client).info.run_id}
    finish(folder, first)
    send(folder)
    assert again < {run.info.run_id for run in runs(client)}
    assert children(client) == {job.label: "FINISHED" for job in folder.jobs}
    info = parent(client).info
    assert (info.status, info.start_time) == ("FINISHED", int(1000 * folder.about["started"]))


def test_what_a_dead_sender_left_open_is_sent_again(
    client: MlflowClient, folder: SweepFolder
) -> None:
    for job in folder.jobs:
        finish(folder, job)
    send(folder)
    child = next(run.info.run_id for run in runs(client) if PARENT in run.data.tags)
    for run_id in (child, parent(client).info.run_id):
        client.update_run(run_id, "RUNNING")
    send(folder)
    assert child not in {run.info.run_id for run in runs(client)}
    assert {run.info.status for run in runs(client)} == {"FINISHED"}
    assert len(children(client)) == 3


def test_a_view_of_the_sweep_shows_what_was_swept_and_the_measure(
    client: MlflowClient, folder: SweepFolder
) -> None:
    finish(folder, folder.jobs[0])
    send(folder)
    experiment = client.get_experiment_by_name("xplain")
    (shared,) = (
        json.loads(value)
        for key, value in experiment.tags.items()
        if key.startswith("mlflow.sharedViewState.")
    )
    assert set(shared) == {"name", "createdAt", "updatedAt", "state"}
    own = view(parent(client).info.run_id, Summary(folder.path))
    assert json.loads(shared["state"]) == own


def test_a_server_that_is_away_costs_a_line_without_its_password(
    folder: SweepFolder, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    finish(folder, folder.jobs[0])
    away = MLflow("http://lab:secret@127.0.0.1:9")
    with caplog.at_level(logging.WARNING, "xplain"):
        assert away.log(folder.path, folder.path.parents[1]) == []
    (said,) = (one.getMessage() for one in caplog.records if one.name.startswith("xplain"))
    assert f"xplain sync {folder.path}" in said
    assert "\n" not in said
    assert "secret" not in caplog.text
    assert without_passwords("to http://lab:secret@host/x?y") == "to http://***@host/x?y"


def test_a_deleted_experiment_and_what_is_no_database_are_one_line(
    client: MlflowClient, folder: SweepFolder
) -> None:
    finish(folder, folder.jobs[0])
    send(folder)
    client.delete_experiment(parent(client).info.experiment_id)
    with pytest.raises(InputError, match=r"tracking\.experiment='xplain': an experiment that"):
        send(folder)
    other = folder.path.parents[1] / "other.db"
    other.write_text("no database")
    with pytest.raises(XplainError, match=r"^tracking\.uri: MLflow did not store the results .*$"):
        sync([folder.path], folder.path.parents[1], MLflow(f"sqlite:///{other}"))
