"""A sweep in MLflow: one parent, one child a job, brought in line with what is on disk.

One process writes, the one that runs the sweep (or the command ``sync``): workers never open
the store. Every step may be repeated: runs are found by their tags, filled in place, never
doubled. When MLflow cannot take something the sweep goes on, and one warning says how to send it
later.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from xplain.experiment.fingerprint import git_state
from xplain.experiment.results import load_results
from xplain.runs.folder import State, SweepFolder, result_id
from xplain.runs.mlflow import (
    RESULT_TAG,
    MLflow,
    all_runs,
    fill,
    process_tag,
    retire,
    source_tags,
)
from xplain.runs.plan import Job

if TYPE_CHECKING:
    from mlflow import MlflowClient

    from xplain.report.summary import Summary

log = logging.getLogger(__name__)

SWEEP_TAG = "xplain.sweep"
"""Tag of the parent: identity of the sweep. RESULT_TAG of a child: identity of its result."""

VIEW = "workflowType=machine_learning"
"""MLflow's page of runs opens in another mode without it."""

Links = list[tuple[str, str]]
"""(words, address)."""

COMPARABLE = 100
"""Runs whose comparison still fits into a link."""


def mirror_of(
    tracking: Any, outputs: Path, folder: SweepFolder, jobs: tuple[Job, ...], fresh: bool = False
) -> Mirror | NoMirror:
    """What shows the sweep where its tracking says."""
    if isinstance(tracking, MLflow):
        return Mirror(tracking, outputs, folder, jobs, fresh)
    return NoMirror()


class NoMirror:
    """The mirror of a sweep whose results stay on disk: nothing is sent."""

    def start(self) -> None:
        """See :meth:`Mirror.start`; here nothing is sent."""

    def update(self, job: Job, state: State) -> None:
        """See :meth:`Mirror.update`; here nothing is sent."""

    def finish(self, status: str, summary: Summary | None, report: Path | None) -> Links:
        """See :meth:`Mirror.finish`; here there are no links."""
        return []


@dataclass
class Mirror:
    """Keeps MLflow in line with a sweep's folder.

    Attributes:
        tracking, outputs: where the runs go.
        folder, jobs: of the sweep.
        fresh: forget the children of an earlier run of this sweep.
    """

    tracking: MLflow
    outputs: Path
    folder: SweepFolder
    jobs: tuple[Job, ...]
    fresh: bool = False
    _client: MlflowClient | None = None
    _experiment: str = ""
    _parent: str = ""
    _children: dict[str, tuple[str, str]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self) -> None:
        """Opens the store, ends what dead processes left open, finds or makes the parent."""
        self._try(self._start)

    def update(self, job: Job, state: State) -> None:
        """A job changed its state."""
        self._try(lambda: self._update(job, state))

    def finish(
        self, status: str, summary: Summary | None, report: Path | None
    ) -> list[tuple[str, str]]:
        """Brings every child and the parent into their final state.

        Args:
            status: of the parent: FINISHED, FAILED or KILLED.
            summary: curves and table for the parent.
            report: folder of files for the parent.

        Returns:
            (words, address): where to look.
        """
        self._try(lambda: self._finish(status, summary, report))
        return self._links() if self._client is not None else []

    def send(self) -> None:
        """Brings MLflow to the state on disk, in one go, raising what goes wrong.

        Raises:
            OSError, MlflowException: the store cannot take it.
        """
        from xplain.report.summary import Summary

        self._start()
        states = {self.folder.state(job) for job in self.jobs}
        status = "KILLED"
        if states == {"finished"}:
            status = "FINISHED"
        elif "failed" in states:
            status = "FAILED"
        report = self.folder.path / "report"
        self._finish(status, Summary(self.folder.path), report if report.is_dir() else None)

    def _try(self, step: Any) -> None:
        with self._lock:
            if self._client is None and self._parent:
                return  # it failed before, and said so
            try:
                step()
            except Exception as error:  # MLflow raises what SQLAlchemy, requests, the OS do
                reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
                log.warning(
                    "MLflow does not take this sweep (%s). The results are safe in %s; send them "
                    "later with: python -m xplain sync %s",
                    reason[:200],
                    self.folder.path,
                    self.folder.path,
                )
                log.debug("MLflow failed", exc_info=True)
                self._client, self._parent = None, "out of reach"

    def _start(self) -> None:
        with self.tracking.client(self.outputs) as (client, self._experiment):
            self._client = client
        retire(client, self._experiment)
        identity = self.folder.identity
        found = list(all_runs(client, self._experiment, f"tags.`{SWEEP_TAG}` = '{identity}'"))
        tags = {
            SWEEP_TAG: identity,
            "xplain.folder": str(self.folder.path),
            "xplain.jobs": str(len(self.jobs)),
            **source_tags(git_state()),
            **process_tag(),
        }
        if not found:
            run = client.create_run(self._experiment, None, tags, identity)
            self._parent = run.info.run_id
            return
        self._parent = found[0].info.run_id
        for key, value in tags.items():
            client.set_tag(self._parent, key, value)
        client.update_run(self._parent, "RUNNING")
        for run in all_runs(
            client, self._experiment, f"tags.`mlflow.parentRunId` = '{self._parent}'"
        ):
            if self.fresh:
                client.delete_run(run.info.run_id)
            else:
                key = run.data.tags.get(RESULT_TAG, "")
                self._children[key] = (run.info.run_id, run.info.status)

    def _update(self, job: Job, state: State) -> None:
        client, key = self._client, result_id(self.folder.identity, job)
        assert client is not None
        run_id, status = self._children.get(key, ("", ""))
        if state == "waiting" or status == "FINISHED" or status == _STATUS[state] == "RUNNING":
            return
        folder = self.folder.of(job)
        if not run_id:
            tags = {
                RESULT_TAG: key,
                "mlflow.parentRunId": self._parent,
                **source_tags(git_state()),
                **process_tag(),
            }
            started = int(1000 * time.time())
            if state == "finished":
                started = int(1000 * load_results(folder).started)
            run_id = client.create_run(self._experiment, started, tags, job.label).info.run_id
        elif state == "running":
            for tag, value in process_tag().items():
                client.set_tag(run_id, tag, value)
            client.update_run(run_id, "RUNNING")
        if state == "finished":
            fill(client, run_id, folder, load_results(folder))
        elif state == "failed":
            failure = self.folder.failure(job)
            client.set_tag(run_id, "xplain.error", failure["error"][:4000])
            client.set_tag(run_id, "mlflow.note.content", f"```\n{failure['traceback'][-6000:]}```")
            client.log_artifacts(run_id, str(folder))
            client.set_terminated(run_id, "FAILED")
        self._children[key] = (run_id, _STATUS[state])

    def _finish(self, status: str, summary: Summary | None, report: Path | None) -> None:
        client = self._client
        assert client is not None
        for job in self.jobs:
            state = self.folder.state(job)
            if state in ("finished", "failed"):
                self._update(job, state)
        for key, (run_id, child) in self._children.items():
            if child == "RUNNING":
                client.set_terminated(run_id, "KILLED")
                self._children[key] = (run_id, "KILLED")
        if summary is not None:
            self._show(client, summary)
        if report is not None:
            client.log_artifacts(self._parent, str(report), "report")
        client.set_terminated(self._parent, status)

    def _show(self, client: MlflowClient, summary: Summary) -> None:
        """Curves and table on the parent: without any its page is empty."""
        from mlflow.entities import Metric

        from xplain.report.tables import markdown

        when = int(1000 * self.folder.load()["started"])
        metrics = [
            Metric(name, value, when, round(100 * trade_off))
            for name, trade_off, value in summary.curves()
        ]
        for first in range(0, len(metrics), 900):
            client.log_batch(self._parent, metrics[first : first + 900])
        client.set_tag(self._parent, "mlflow.note.content", markdown(summary))

    def _links(self) -> Links:
        uri = self.tracking.tracking_uri(self.outputs)
        base, links = uri.rstrip("/"), []
        if not uri.startswith("http"):
            base = "http://127.0.0.1:5000"
            log.info("see it in MLflow with: mlflow ui --backend-store-uri %s", uri)
        page = f"{base}/#/experiments/{self._experiment}/runs"
        filtered = quote(f"tags.`mlflow.parentRunId` = '{self._parent}'")
        links = [
            ("the sweep, its curves and table", f"{page}/{self._parent}"),
            ("its runs as a table", f"{page}?searchFilter={filtered}&{VIEW}"),
        ]
        ids = [run_id for run_id, status in self._children.values() if status == "FINISHED"]
        if 1 < len(ids) <= COMPARABLE:
            runs, experiments = quote(_json(ids)), quote(_json([self._experiment]))
            address = f"{base}/#/compare-runs?runs={runs}&experiments={experiments}"
            links.append(("its runs compared", address))
        return links


_STATUS = {"running": "RUNNING", "finished": "FINISHED", "failed": "FAILED", "waiting": ""}


def _json(values: list[str]) -> str:
    return json.dumps(values, separators=(",", ":"))
