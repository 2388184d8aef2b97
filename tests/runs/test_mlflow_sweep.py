"""What a sweep tells MLflow, noted by a client that keeps runs in memory."""

from __future__ import annotations

import itertools
import json
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.report import handmade
from tests.runs.sweeps import planned, put
from xplain.cli.sync import sync
from xplain.experiment.results import save_results
from xplain.runs import mlflow_sweep
from xplain.runs.folder import FAILURE, STARTED, SweepFolder
from xplain.runs.mlflow import MLflow
from xplain.runs.mlflow_run import RunStore
from xplain.runs.mlflow_views import SWEEP_TAG
from xplain.runs.plan import Job

PARENT = "mlflow.parentRunId"


def label_of(run: SimpleNamespace) -> str:
    """Of a child: its name begins with the job's number."""
    number, _, label = str(run.data.name).partition(" · ")
    assert number.isdigit()
    return label


class Page(list[Any]):
    token: str | None = None


class Client:
    """Runs with tags and a status; the part of an MLflow client that sweeps use."""

    def __init__(self) -> None:
        self.runs: dict[str, SimpleNamespace] = {}
        self.numbers = itertools.count()

    def create_run(self, _: str, start: int, tags: dict[str, str], name: str) -> SimpleNamespace:
        info = SimpleNamespace(
            run_id=f"run{next(self.numbers)}", status="RUNNING", start_time=start, end_time=None
        )
        data = SimpleNamespace(tags=dict(tags), name=name, params={})
        self.runs[info.run_id] = SimpleNamespace(info=info, data=data, files=[], points=[])
        return self.runs[info.run_id]

    def search_runs(
        self, _: list[str], condition: str, max_results: int = 100, page_token: str | None = None
    ) -> Page:
        """A page of those that a server would find; the token is where the next one begins."""
        asked = re.fullmatch(r"tags.`(.+)` = '(.+)'", condition)
        assert asked
        found = [run for run in self.runs.values() if run.data.tags.get(asked[1]) == asked[2]]
        first = int(page_token or 0)
        page = Page(found[first : first + max_results])
        page.token = str(first + max_results) if first + max_results < len(found) else None
        return page

    def set_tag(self, run: str, key: str, value: str) -> None:
        self.runs[run].data.tags[key] = value

    def update_run(self, run: str, status: str) -> None:
        self.runs[run].info.status = status

    def set_terminated(self, run: str, status: str, end: int) -> None:
        self.runs[run].info.status, self.runs[run].info.end_time = status, end

    def delete_run(self, run: str) -> None:
        del self.runs[run]

    def log_batch(self, run: str, metrics: Any = (), params: Any = (), tags: Any = ()) -> None:
        assert len(metrics) <= 1000  # more a request is refused by a server
        self.runs[run].points += [(point.key, point.step, point.value) for point in metrics]
        self.runs[run].data.tags |= {tag.key: tag.value for tag in tags}
        self.runs[run].data.params |= {param.key: param.value for param in params}

    def log_artifact(self, *_: Any) -> None:
        """What finished runs hold is noted elsewhere (test_mlflow.py)."""

    set_experiment_tag = log_artifact

    def get_experiment(self, _: str) -> SimpleNamespace:
        return SimpleNamespace(tags={})

    def log_artifacts(self, run: str, path: str, place: str = "") -> None:
        self.runs[run].files += os.listdir(path)

    def parent(self) -> SimpleNamespace:
        (parent,) = (run for run in self.runs.values() if PARENT not in run.data.tags)
        return parent

    def children(self) -> dict[str, str]:
        """{label: status}"""
        below = {PARENT: self.parent().info.run_id}.items()
        return {
            label_of(run): run.info.status
            for run in self.runs.values()
            if below <= run.data.tags.items()
        }


@dataclass(frozen=True)
class Noted(MLflow):
    """MLflow with that client; what is no client is raised."""

    client: Any = None

    def store(self, outputs: Path) -> RunStore:
        if isinstance(self.client, Exception):
            raise self.client
        return RunStore(self.client, "1")


@pytest.fixture
def folder(tmp_path: Path) -> SweepFolder:
    return planned(tmp_path, 3)[1]


@pytest.fixture
def client() -> Client:
    return Client()


def fail(folder: SweepFolder, job: Job) -> None:
    put(folder, job, FAILURE, json.dumps({"error": "no memory", "traceback": "line 1"}))


def finish(folder: SweepFolder, job: Job, started: float = 1e9) -> None:
    folder.of(job).mkdir(parents=True, exist_ok=True)
    episodes = tuple(handmade.episode(name, 0, "A", 1.0) for name in ("oracle", "solver"))
    results = handmade.results(job.label, {}, episodes)
    save_results(folder.of(job), replace(results, started=started))


def send(folder: SweepFolder, client: Client) -> None:
    sync([folder.path], folder.path.parent, Noted(client=client))


@pytest.mark.parametrize("count", [1, 899, 900, 901, 2000])
def test_every_point_of_the_curves_is_sent_once(
    client: Client, folder: SweepFolder, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = [("regret against λ/qmdp", step, step / 7) for step in range(count)]
    monkeypatch.setattr(mlflow_sweep, "curves", lambda summary, main: points)
    monkeypatch.setattr(mlflow_sweep, "bests", lambda summary: {})
    finish(folder, folder.jobs()[0])
    send(folder, client)
    assert sorted(client.parent().points) == points


def test_a_sweep_is_a_parent_with_a_child_for_each_job_that_ended(
    client: Client, folder: SweepFolder
) -> None:
    first, second, third = folder.jobs()
    ended = Noted(client=client).follow(folder.path, folder.path.parent)
    assert not client.runs  # nothing has happened
    put(folder, first, STARTED, "here 1")
    fail(folder, second)
    for job in (first, second):
        ended(job)
    parent = client.parent()
    assert parent.info.status == "RUNNING"
    assert parent.data.tags[SWEEP_TAG] == folder.identity
    assert parent.data.tags["xplain.folder"] == str(folder.path)
    assert parent.data.tags["xplain.jobs"] == "3"
    assert parent.data.params == {"seed": "0, 1, 2", "jobs": "3"}
    assert client.children() == {second.label: "FAILED"}
    (failed,) = (run for run in client.runs.values() if second.label in run.data.name)
    assert failed.data.tags["xplain.error"] == "no memory"
    assert "line 1" in failed.data.tags["mlflow.note.content"]
    assert set(failed.files) == {FAILURE}
    finish(folder, third)
    for _ in range(2):  # sent twice, it is one run all the same
        send(folder, client)
        assert client.children() == {second.label: "FAILED", third.label: "FINISHED"}
        assert client.parent().info.status == "FAILED"
        assert client.parent().info.end_time >= client.parent().info.start_time


def test_a_sweep_that_goes_on_keeps_its_parent_and_what_was_sent(
    client: Client, folder: SweepFolder
) -> None:
    first, *others = folder.jobs()
    finish(folder, first)
    send(folder, client)
    assert client.parent().info.status == "KILLED"
    before = set(client.runs)
    client.parent().data.tags["xplain.folder"] = "/moved/since"
    for job in others:
        finish(folder, job)
    send(folder, client)
    assert before < set(client.runs)
    assert client.parent().info.status == "FINISHED"
    assert client.parent().data.tags["xplain.folder"] == str(folder.path)
    assert client.children() == {job.label: "FINISHED" for job in folder.jobs()}


def test_what_a_dead_sender_left_open_is_ended_or_sent_anew(
    client: Client, folder: SweepFolder
) -> None:
    for job in folder.jobs():
        finish(folder, job)
    Noted(client=client).follow(folder.path, folder.path.parent)(folder.jobs()[0])
    (child,) = (run for run in client.runs.values() if PARENT in run.data.tags)
    child.info.status = "RUNNING"
    assert client.parent().info.status == "RUNNING"
    send(folder, client)
    assert child.info.run_id not in client.runs
    assert {run.info.status for run in client.runs.values()} == {"FINISHED"}
    assert len(client.children()) == 3


def test_a_sweep_of_which_nothing_is_finished_is_shown_as_well(
    client: Client, folder: SweepFolder
) -> None:
    send(folder, client)
    assert client.parent().info.status == "KILLED"
    assert client.children() == {}
    for job in folder.jobs():
        fail(folder, job)
    send(folder, client)
    assert client.parent().info.status == "FAILED"
    assert set(client.children().values()) == {"FAILED"}


def test_what_ran_anew_takes_the_place_of_what_was_sent(
    client: Client, folder: SweepFolder
) -> None:
    first, second, _ = folder.jobs()
    finish(folder, first)
    fail(folder, second)
    send(folder, client)
    before = set(client.runs)
    finish(folder, first, started=2e9)
    folder.clear(second)
    finish(folder, second)
    send(folder, client)
    assert client.children() == {first.label: "FINISHED", second.label: "FINISHED"}
    assert before & set(client.runs) == {client.parent().info.run_id}
    assert "no memory" not in str(client.runs)


def test_jobs_that_mlflow_did_not_take_are_sent_at_the_end(
    client: Client, folder: SweepFolder, caplog: pytest.LogCaptureFixture
) -> None:
    away = Noted(client=OSError("nobody at home"))
    ended = away.follow(folder.path, folder.path.parent)
    for job in folder.jobs():
        finish(folder, job)
        ended(job)
    assert caplog.messages == []
    assert away.log(folder.path, folder.path.parent) == []
    (said,) = caplog.messages
    assert "nobody at home" in said
    assert f"xplain sync {folder.path}" in said
    assert Noted(client=client).log(folder.path, folder.path.parent)
    assert set(client.children().values()) == {"FINISHED"}


def test_runs_beyond_the_first_page_are_known(client: Client, tmp_path: Path) -> None:
    folder = planned(tmp_path, 1200)[1]
    for job in folder.jobs()[:-1]:
        fail(folder, job)
    finish(folder, folder.jobs()[-1])
    for _ in range(2):
        send(folder, client)
        assert len(client.children()) == 1200
        assert len(client.runs) == 1 + 1200
