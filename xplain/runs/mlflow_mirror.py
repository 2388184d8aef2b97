"""A sweep in MLflow: one parent, one child a job, brought in line with what is on disk.

One process writes, the one that runs the sweep (or the command ``sync``): workers never open
the store. Every step may be repeated: runs are found by their tags, filled in place, never
doubled. When MLflow cannot take something the sweep goes on, and one warning says how to send it
later.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.experiment.fingerprint import git_state
from xplain.experiment.results import load_results
from xplain.report.combinations import heading
from xplain.report.regret_table import markdown
from xplain.runs.folder import State, SweepFolder, result_id
from xplain.runs.mlflow import (
    RESULT_TAG,
    MLflow,
    all_runs,
    process_tag,
    retire,
    source_tags,
)
from xplain.runs.mlflow_run import fill, parent_parameters
from xplain.runs.mlflow_views import (
    SWEEP_TAG,
    MainKey,
    chart_view,
    curves,
    describe_experiment,
    every_combination,
    main_key,
    save_view,
    sweep_view,
    view_address,
)
from xplain.runs.plan import Job

if TYPE_CHECKING:
    from mlflow import MlflowClient

    from xplain.report.summary import Summary

log = logging.getLogger(__name__)


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

    def finish(self, status: str, summary: Summary | None, report: Path | None) -> None:
        """See :meth:`Mirror.finish`; here nothing is sent."""

    def links(self) -> list[tuple[str, str]]:
        """See :meth:`Mirror.links`; here there are none."""
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
    _started: int = 0
    _ended: int = 0
    _children: dict[str, tuple[str, str]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self) -> None:
        """Opens the store, ends what dead processes left open, finds or makes the parent."""
        self._try(self._start)

    def update(self, job: Job, state: State) -> None:
        """A job changed its state."""
        self._try(lambda: self._update(job, state))

    def finish(self, status: str, summary: Summary | None, report: Path | None) -> None:
        """Brings every child and the parent into their final state.

        Args:
            status: of the parent: FINISHED, FAILED or KILLED.
            summary: curves and table for the parent.
            report: folder of files for the parent.
        """
        self._try(lambda: self._finish(status, summary, report))

    def links(self) -> list[tuple[str, str]]:
        """(words, address) of the sweep's views: its jobs with what was swept and their regrets,
        and the chart; none where MLflow did not take it."""
        if self._client is None:
            return []
        pages = self.tracking.pages(self.outputs)
        found = [("MLflow", view_address(pages, self._experiment, self._view))]
        if self._main.key:
            chart = view_address(pages, self._experiment, f"{self._view}-chart", chart=True)
            found.append((f"  regret against {heading(self._main.key)}", chart))
        return found

    @cached_property
    def _main(self) -> MainKey:
        return main_key(self.jobs)

    @property
    def _view(self) -> str:
        return self.folder.identity.rpartition("-")[2]

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
            name = f"{identity} · {' × '.join(self._swept())}"
            run = client.create_run(self._experiment, int(1000 * time.time()), tags, name)
            self._parent, self._started = run.info.run_id, run.info.start_time
            return
        self._parent, self._started = found[0].info.run_id, found[0].info.start_time
        self._ended = found[0].info.end_time or 0
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

    def _swept(self) -> list[str]:
        keys = dict.fromkeys(key for job in self.jobs for key in job.values)
        return ["λ" if key == "lambda" else key for key in keys]

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
            started = self.folder.started(job)
            run_id = client.create_run(self._experiment, started, tags, job.label).info.run_id
        elif state == "running":
            for tag, value in process_tag().items():
                client.set_tag(run_id, tag, value)
            client.update_run(run_id, "RUNNING")
        if state == "finished":
            fill(
                client,
                run_id,
                folder,
                load_results(folder),
                job.values,
                self._main.step(job.values),
            )
        elif state == "failed":
            failure = self.folder.failure(job)
            client.set_tag(run_id, "xplain.error", failure["error"][:4000])
            client.set_tag(run_id, "mlflow.note.content", f"```\n{failure['traceback'][-6000:]}```")
            client.log_artifacts(run_id, str(folder))
            client.set_terminated(run_id, "FAILED")
        self._children[key] = (run_id, _STATUS[state])
        self._ended = int(1000 * time.time())

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
        client.set_terminated(self._parent, status, max(self._ended, self._started))

    def _show(self, client: MlflowClient, summary: Summary) -> None:
        """What opens on the answer: curves, table and parameters on the parent, and the view."""
        from mlflow.entities import Metric, Param

        metrics = [
            Metric(name, value, self._started, step)
            for name, step, value in curves(summary, self._main)
        ]
        regrets = [cell.estimates["regret"].mean for cell in every_combination(summary)]
        if regrets:
            metrics.append(Metric("best_regret", round(min(regrets), 4), self._started, 0))
        for first in range(0, len(metrics), 900):
            client.log_batch(self._parent, metrics[first : first + 900])
        params = [Param(key, value) for key, value in parent_parameters(self.jobs).items()]
        client.log_batch(self._parent, params=params)
        client.set_tag(self._parent, "mlflow.note.content", self._note(summary))
        table = sweep_view(self._parent, summary, self._main)
        save_view(client, self._experiment, self._view, table)
        if self._main.key:
            chart = chart_view(self._parent, summary, self._main)
            save_view(client, self._experiment, f"{self._view}-chart", chart)
        link = view_address("#", self._experiment, self._view)
        newest = f"**[Newest sweep: {self.folder.identity}]({link})**"
        describe_experiment(client, self._experiment, newest)

    def _note(self, summary: Summary) -> str:
        """The parent's description."""
        links = [f"[its jobs by regret]({view_address('#', self._experiment, self._view)})"]
        if self._main.key:
            chart = view_address("#", self._experiment, f"{self._view}-chart", chart=True)
            links.append(f"[regret against {heading(self._main.key)}]({chart})")
        return (
            f"{len(self.jobs)} jobs over {', '.join(summary.keys) or 'nothing'}: "
            f"{', '.join(links)}; the report is among the artifacts (`report/index.html`). "
            f"`{self.folder.load()['command']}`\n\n{markdown(summary)}"
        )


_STATUS = {"running": "RUNNING", "finished": "FINISHED", "failed": "FAILED", "waiting": ""}
