"""A sweep in MLflow: a parent, a child for each job that has ended, and views on them.

One process writes, the one that runs the sweep (or the command ``sync``): workers never open
the store. Every step may be repeated: runs are found by their tags, never doubled.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from xplain.experiment.fingerprint import git_state
from xplain.experiment.results import Results, load_results
from xplain.report.combinations import heading
from xplain.report.comparison import answer, main_table
from xplain.report.summary import Summary, load_sweep
from xplain.runs.folder import FAILURE, STARTED, SweepFolder
from xplain.runs.mlflow_run import (
    MOST_PARAMETERS,
    PARENT_TAG,
    RESULT_TAG,
    RunStore,
    ended,
    fill,
    source_tags,
)
from xplain.runs.mlflow_views import (
    ANSWER_TAG,
    SWEEP_TAG,
    bests,
    chart_view,
    curves,
    describe_experiment,
    main_key,
    save_view,
    sweep_view,
    swept_values,
    view_address,
)
from xplain.runs.plan import Job

if TYPE_CHECKING:
    from mlflow.entities import Run


class SweepRuns:
    """The runs of one sweep; its parent is found or made, and is RUNNING until :meth:`finish`.

    Args:
        store: where they are.
        folder: of the sweep.
    """

    def __init__(self, store: RunStore, folder: SweepFolder) -> None:
        from mlflow.entities import Param, RunTag

        self._store, self._folder = store, folder
        self._jobs, about = folder.jobs(), load_sweep(folder.path)
        self._main = main_key(self._jobs)
        self._numbers = {job.name: i for i, job in enumerate(self._jobs, 1)}
        self._view = folder.identity.rpartition("-")[2]
        self._started = int(1000 * about["started"])
        swept = swept_values(self._jobs)
        name = f"{folder.identity} · {' × '.join('λ' if k == 'lambda' else k for k in swept)}"
        found = next(store.tagged(SWEEP_TAG, folder.identity), None) or store.client.create_run(
            store.experiment, self._started, {SWEEP_TAG: folder.identity}, name
        )
        self._parent = str(found.info.run_id)
        tags = {
            "xplain.folder": str(folder.path),
            "xplain.jobs": str(len(self._jobs)),
            **source_tags(git_state()),
        }
        params = [(key, ", ".join(values)[:500]) for key, values in swept.items()]
        params = [*params[: MOST_PARAMETERS - 1], ("jobs", str(len(self._jobs)))]
        store.client.log_batch(
            self._parent,
            params=[Param(*p) for p in params],
            tags=[RunTag(*t) for t in tags.items()],
        )
        store.client.update_run(self._parent, "RUNNING")
        self._children: dict[str, list[Run]] = {}
        for run in store.tagged(PARENT_TAG, self._parent):
            self._children.setdefault(run.data.tags.get(RESULT_TAG, ""), []).append(run)

    def send(self, job: Job, results: Results | None = None) -> None:
        """Sends what a job left, and nothing where it has not ended; its results may be known."""
        sweep, store, folder = self._folder, self._store, self._folder.of(job)
        known = self._children.get(sweep.result_id(job), [])
        # Names begin with the job's number, for pages cut them.
        name, state = f"{self._numbers[job.name]} · {job.label}", sweep.state(job)
        tags = {RESULT_TAG: sweep.result_id(job), PARENT_TAG: self._parent}
        tags |= source_tags(git_state())
        if state == "finished":
            results = results or load_results(folder)
            started = int(1000 * results.started)
            run_id, new = store.once(known, name, "FINISHED", started, tags)
            if new:
                fill(store.client, run_id, folder, results, job.values, self._main.step(job.values))
        elif state == "failed":
            failure = sweep.failure(job)
            tags["xplain.error"] = failure["error"][:4000]
            tags["mlflow.note.content"] = f"```\n{failure['traceback'][-6000:]}```"
            files = [folder / name for name in (STARTED, FAILURE) if (folder / name).exists()]
            times = sorted(int(1000 * path.stat().st_mtime) for path in files)
            run_id, new = store.once(known, name, "FAILED", times[0], tags)
            if new:
                store.client.log_artifacts(run_id, str(folder))
                store.client.set_terminated(run_id, "FAILED", times[-1])

    def finish(self) -> list[str]:
        """Brings all runs and views to the state on disk; returns lines that tell where."""
        client = self._store.client
        summary = Summary(self._folder.path)
        known = {job["name"]: results for job, results in summary.results}
        for job in self._jobs:
            self.send(job, known.get(job.name))
        end = max([self._started, *(ended(results) for _, results in summary.results)])
        if summary.results:
            self._show(summary, end)
        if (self._folder.path / "report").is_dir():
            client.log_artifacts(self._parent, str(self._folder.path / "report"), "report")
        states = {self._folder.state(job) for job in self._jobs}
        status = "FAILED" if "failed" in states else "KILLED"
        status = "FINISHED" if states == {"finished"} else status
        client.set_terminated(self._parent, status, end)
        if not summary.results:  # nothing to compare
            pages, experiment = self._store.pages, self._store.experiment
            return [f"MLflow: {pages}/experiments/{experiment}/runs/{self._parent}"]
        table, *charts = self._addresses(self._store.pages)
        words = f"  {summary.measure.title} against {heading(self._main.key)}: "
        return [f"MLflow: {table}", *(words + chart for chart in charts)]

    def _show(self, summary: Summary, end: int) -> None:
        """What opens on the answer: curves, table and parameters on the parent, and the views."""
        from mlflow.entities import Metric

        client, experiment = self._store.client, self._store.experiment
        metrics = [
            Metric(name, value, self._started, step)
            for name, step, value in curves(summary, self._main)
        ]
        metrics += [Metric(name, round(best, 4), end, 0) for name, best in bests(summary).items()]
        for first in range(0, len(metrics), 900):
            client.log_batch(self._parent, metrics[first : first + 900])
        client.set_tag(self._parent, "mlflow.note.content", self._note(summary))
        client.set_tag(self._parent, ANSWER_TAG, answer(summary) or "nothing competes")
        save_view(client, experiment, self._view, sweep_view(self._parent, summary, self._main))
        if self._main.key:
            chart = chart_view(self._parent, summary, self._main)
            save_view(client, experiment, f"{self._view}-chart", chart)
        newest = f"**[Newest sweep: {self._folder.identity}]({self._addresses('#')[0]})**"
        describe_experiment(client, experiment, newest)

    def _addresses(self, pages: str) -> list[str]:
        """Of the views: the jobs with what was swept and their figures; the chart, if any."""
        experiment = self._store.experiment
        found = [view_address(pages, experiment, self._view)]
        if self._main.key:
            found.append(view_address(pages, experiment, f"{self._view}-chart", chart=True))
        return found

    def _note(self, summary: Summary) -> str:
        """The parent's description."""
        table, *charts = self._addresses("#")
        words = f"[{summary.measure.title} against {heading(self._main.key)}]"
        links = [f"[its jobs]({table})", *(f"{words}({chart})" for chart in charts)]
        swept = ", ".join(summary.keys) or "nothing"
        return (
            f"{answer(summary)}\n\n{len(self._jobs)} jobs over {swept}: "
            f"{', '.join(links)}; the report is among the artifacts (`report/index.html`). "
            f"`{summary.about['command']}`\n\n{main_table(summary).markdown()}"
        )
