"""What a sweep tells MLflow, noted by a client that keeps runs in memory."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.runs.sweeps import planned, put
from xplain.runs.folder import FAILURE, STARTED, SweepFolder
from xplain.runs.mlflow import PROCESS_TAG, RESULT_TAG, MLflow, process_tag
from xplain.runs.mlflow_mirror import Mirror
from xplain.runs.mlflow_views import SWEEP_TAG

PARENT = "mlflow.parentRunId"


class Store:
    """Runs with tags and a status; the part of an MLflow client that a mirror uses."""

    def __init__(self) -> None:
        self.runs: dict[str, SimpleNamespace] = {}

    def tracking(self) -> MLflow:
        @contextmanager
        def client(_: Path) -> Iterator[tuple[Store, str]]:
            yield self, "1"

        return cast("MLflow", SimpleNamespace(client=client))

    def create_run(self, _: str, start: int, tags: dict[str, str], name: str) -> SimpleNamespace:
        info = SimpleNamespace(
            run_id=f"run{len(self.runs)}", status="RUNNING", start_time=start, end_time=None
        )
        data = SimpleNamespace(tags=dict(tags), name=name)
        self.runs[info.run_id] = SimpleNamespace(info=info, data=data, files=[])
        return self.runs[info.run_id]

    def search_runs(self, _: list[str], condition: str, **page: Any) -> Any:
        if condition == "attributes.status = 'RUNNING'":
            return Page(run for run in self.runs.values() if run.info.status == "RUNNING")
        asked = re.fullmatch(r"tags.`(.+)` = '(.+)'", condition)
        assert asked
        return Page(r for r in self.runs.values() if r.data.tags.get(asked[1]) == asked[2])

    def set_tag(self, run: str, key: str, value: str) -> None:
        self.runs[run].data.tags[key] = value

    def update_run(self, run: str, status: str) -> None:
        self.runs[run].info.status = status

    def set_terminated(self, run: str, status: str, end: int | None = None) -> None:
        self.runs[run].info.status, self.runs[run].info.end_time = status, end

    def delete_run(self, run: str) -> None:
        del self.runs[run]

    def log_artifacts(self, run: str, path: str, place: str = "") -> None:
        self.runs[run].files += os.listdir(path)

    def parent(self) -> SimpleNamespace:
        (parent,) = (run for run in self.runs.values() if PARENT not in run.data.tags)
        return parent

    def children(self) -> dict[str, str]:
        """{label: status}"""
        below = {PARENT: self.parent().info.run_id}.items()
        return {
            run.data.name: run.info.status
            for run in self.runs.values()
            if below <= run.data.tags.items()
        }


class Page(list[Any]):
    token = None


@pytest.fixture
def folder(tmp_path: Path) -> SweepFolder:
    return planned(tmp_path, 3)[1]


@pytest.fixture
def store() -> Store:
    return Store()


def mirror(store: Store, folder: SweepFolder, fresh: bool = False) -> Mirror:
    return Mirror(store.tracking(), folder.path.parent, folder, folder.jobs(), fresh)


def test_a_sweep_is_a_parent_with_a_child_for_each_job_begun(
    store: Store, folder: SweepFolder
) -> None:
    first, second, _ = folder.jobs()
    own = mirror(store, folder)
    own.start()
    parent = store.parent()
    assert parent.info.status == "RUNNING"
    assert parent.data.tags[SWEEP_TAG] == folder.identity
    assert parent.data.tags["xplain.folder"] == str(folder.path)
    assert parent.data.tags["xplain.jobs"] == "3"
    assert store.children() == {}
    for job in folder.jobs():
        own.update(job, folder.state(job))
    assert store.children() == {}  # all wait
    put(folder, first, STARTED, "here 1")
    own.update(first, folder.state(first))
    put(
        folder, folder.jobs()[1], FAILURE, json.dumps({"error": "no memory", "traceback": "line 1"})
    )
    for _ in range(2):  # told twice, it is one run all the same
        own.update(second, folder.state(second))
    assert store.children() == {first.label: "RUNNING", second.label: "FAILED"}
    failed = store.runs["run2"]
    assert failed.data.tags["xplain.error"] == "no memory"
    assert "line 1" in failed.data.tags["mlflow.note.content"]
    assert set(failed.files) == {FAILURE}
    own.finish("KILLED", None, None)
    assert store.children() == {first.label: "KILLED", second.label: "FAILED"}
    assert store.parent().info.status == "KILLED"
    assert store.parent().info.end_time >= store.parent().info.start_time


def test_a_sweep_that_goes_on_is_the_process_s_that_goes_on(
    store: Store, folder: SweepFolder
) -> None:
    job = folder.jobs()[0]
    put(folder, job, STARTED, "here 1")
    begun = mirror(store, folder)
    begun.start()
    begun.update(job, "running")
    begun.finish("KILLED", None, None)
    for run in store.runs.values():  # of a process that died, in a folder since moved
        run.data.tags |= {PROCESS_TAG: "elsewhere 1 1", "xplain.folder": "/moved"}
    own = mirror(store, folder)
    own.start()
    assert store.parent().info.status == "RUNNING"
    assert store.parent().data.tags.items() >= process_tag().items()
    assert store.parent().data.tags["xplain.folder"] == str(folder.path)
    assert store.children() == {job.label: "KILLED"}
    own.update(job, "running")
    assert store.children() == {job.label: "RUNNING"}
    assert all(run.data.tags.items() >= process_tag().items() for run in store.runs.values())


def test_what_a_dead_process_left_open_is_ended_first(store: Store, folder: SweepFolder) -> None:
    dead = {PROCESS_TAG: next(iter(process_tag().values())) + "0"}  # the number was used again
    store.create_run("1", 0, {**dead, RESULT_TAG: "another", PARENT: "gone"}, "left open")
    store.create_run("1", 0, {PROCESS_TAG: "elsewhere 1 1", PARENT: "far"}, "of another host")
    mirror(store, folder).start()
    states = {run.data.name: run.info.status for run in store.runs.values()}
    assert states.pop("left open") == "KILLED"
    assert set(states.values()) == {"RUNNING"}


def test_a_fresh_sweep_forgets_its_jobs_and_keeps_its_parent(
    store: Store, folder: SweepFolder
) -> None:
    put(folder, folder.jobs()[0], STARTED, "here 1")
    for fresh in (False, True):
        own = mirror(store, folder, fresh)
        own.start()
        assert store.children() == {}
        own.update(folder.jobs()[0], "running")
    assert len(store.runs) == 2
