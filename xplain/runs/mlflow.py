"""Sends results to MLflow: a run for each result; for a sweep, a parent run with its jobs as
children.

Everything is read from folders on disk when a run or sweep ends. So results that MLflow missed can
be sent later, and a result that is sent twice has only one run. This module imports MLflow, which
takes a second.
"""

import json
import logging
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.entities import Metric, Param, Run

from xplain.errors import InputError, XplainError, first_line
from xplain.experiment.results import RESULTS, Results, load_results
from xplain.report.claims import answer
from xplain.report.folder import FAILURE, SWEEP, SweepFolder
from xplain.report.frame import PROBLEM, Summary, is_in, warning_about_oracle
from xplain.runs.folder import Disk, alone, runs_and_sweeps, without_passwords

log = logging.getLogger(__name__)

RESULT_TAG, SWEEP_TAG = "xplain.result", "xplain.sweep"
PARENT_TAG = "mlflow.parentRunId"
SOURCE = {"mlflow.user": os.environ.get("USER", ""), "mlflow.source.name": "python -m xplain"}
"""Tags of every run that MLflow's own client does not set."""

FIGURES = {
    "regret": "regret",
    "regret_to_clairvoyant": "regret_to_clairvoyant",
    "cost": "solver/cost",
    "messages": "solver/messages",
    "inexplicable_labels": "solver/inexplicable_labels",
    "questions": "solver/questions",
    "steps_until_sure": "solver/steps_until_sure",
}
"""MLflow's names of the figures that people compare. MLflow's comparison of runs draws the first
logged metric, so they are logged in alphabetical order."""

MEASURES = {"regret": "regret", "above_floor": "regret_to_clairvoyant", "cost": "solver/cost"}
"""MLflow's names of the measures that compare the jobs of a sweep."""

LEARNED = ("adjusted_rand_index", "labeler_accuracy")


@dataclass(frozen=True)
class MLflow(Disk):
    """Sends results to MLflow.

    Attributes:
        uri: address of the tracking server or database; None is an SQLite file in the outputs
            folder.
        experiment: name of the MLflow experiment.
    """

    uri: str | None = None
    experiment: str = "xplain"

    def log(self, folder: Path, outputs: Path) -> list[str]:
        """Sends the results. After a failure, a warning says how to send them later."""
        try:
            return self.send(folder, outputs)
        except XplainError as error:
            said = "%s. The results are safe; send them later with: python -m xplain sync %s"
            log.warning(said, error, folder)
            return []

    def send(self, folder: Path, outputs: Path) -> list[str]:
        """Updates MLflow to the state of a run's or sweep's folder.

        Returns:
            Lines for the terminal that say where the results are.

        Raises:
            XplainError: MLflow fails, or the experiment was deleted there.
        """
        try:
            return [without_passwords(line) for line in self._send_folder(folder, outputs)]
        except XplainError:
            raise
        except Exception as error:  # MLflow passes on errors of SQLAlchemy, requests, the OS
            text = without_passwords(first_line(error))[:200]
            raise XplainError(f"tracking.uri: MLflow did not store the results ({text})") from error

    def _send_folder(self, folder: Path, outputs: Path) -> list[str]:
        outputs.mkdir(parents=True, exist_ok=True)
        own = outputs.resolve() / "mlflow.db"
        uri = self.uri or f"sqlite:///{own}"
        served = uri.startswith("http")
        with FileLock(outputs / "mlflow.lock"):
            if self.uri is None and not own.exists():
                _make_database(own)
            client = MlflowClient(tracking_uri=uri)
            found = client.get_experiment_by_name(self.experiment)
            if found is not None and found.lifecycle_stage == "deleted":
                allowed = "an experiment that was not deleted; restore it in MLflow or name another"
                raise InputError("tracking.experiment", self.experiment, allowed)
            artifacts = None if served else (outputs.resolve() / "artifacts").as_uri()
            experiment = found.experiment_id if found else None
            experiment = experiment or client.create_experiment(self.experiment, artifacts)
        store = _Store(client, experiment)
        if (folder / SWEEP).exists():
            key = store.send_sweep(SweepFolder(folder))
            shown = f"?workflowType=machine_learning&viewStateShareKey={key}"
        else:
            known = {"xplain.single": "yes"}
            shown = "/" + store.send_result(folder, load_results(folder), "", {}, known)
        page = f"{uri.rstrip('/') if served else 'http://127.0.0.1:5000'}/#/experiments"
        lines = [f"MLflow: {page}/{experiment}/runs{shown}"]
        if not served:
            place = f"sqlite:///{os.path.relpath(own)}" if self.uri is None else self.uri
            lines.append(f"  start its server first: mlflow ui --backend-store-uri {place}")
        return lines


def sync(folders: Sequence[Path], outputs: Path, tracking: MLflow) -> int:
    """Sends every run and sweep at or below the folders. Returns the number of results. A damaged
    sweep is left out with a warning.

    Raises:
        InputError: a folder does not exist, or has no results.
        XplainError: MLflow fails.
    """
    count = 0
    for folder in folders:
        found = list(runs_and_sweeps(folder))
        if not found:
            raise InputError("folder", str(folder), f"a folder with {RESULTS} in it or below")
        for path in found:
            if not (path / SWEEP).exists():
                tracking.send(path, outputs)
                count += 1
                continue
            sweep = SweepFolder(path)
            try:
                count += [sweep.state(job) for job in sweep.jobs].count("finished")
            except InputError as error:
                log.warning("left out: %s", error)
                continue
            with alone(path, "the sweep is running; waiting for its end"):
                tracking.send(path, outputs)
    return count


def _make_database(path: Path) -> None:
    """Creates MLflow's tables atomically: an incomplete database could never be used."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mlflow.") as folder:
        new = Path(folder) / path.name
        MlflowClient(tracking_uri=f"sqlite:///{new}").search_experiments(max_results=1)
        new.rename(path)


@dataclass(frozen=True)
class _Store:
    """An experiment in MLflow."""

    client: MlflowClient
    experiment: str

    def send_result(
        self,
        folder: Path,
        results: Results,
        label: str,
        swept: Mapping[str, str],
        known_by: Mapping[str, str],
        among: Sequence[Run] | None = None,
    ) -> str:
        """Sends a result unless its run exists. Returns the id of the run.

        Args:
            folder, results: the finished run's folder and results.
            label: label of the job in a sweep; "" for a single run.
            swept: swept keys with this run's values.
            known_by: tags that distinguish the run from other runs of the same result.
            among: runs in MLflow that may be this run already; None searches for them.
        """
        end = results.started + sum(results.seconds.values())
        times = int(1000 * results.started), int(1000 * end)
        about = {
            "mlflow.source.git.commit": results.git.get("commit", ""),
            "xplain.rule": results.elbow.rule,
            "xplain.warning": warning_about_oracle(results.learning, results.regret or 0),
        }
        found = sorted(figures(results).items())
        metrics = [Metric(key, round(value, 4), times[1], 0) for key, value in found]
        params = [Param(key, value) for key, value in parameters(results, swept).items()]
        known_by = {RESULT_TAG: results.fingerprint, **known_by}
        among = self._find_runs(known_by) if among is None else among
        name, figured = label or results.name, (metrics, params)
        return self._write_run(folder, name, "FINISHED", times, known_by, about, among, *figured)

    def send_sweep(self, sweep: SweepFolder) -> str:
        """Sends the ended jobs and the report of a sweep, and its view (:func:`view`). Returns the
        key under which MLflow stores the view."""
        summary, name = Summary(sweep.path), sweep.path.name
        began, now = int(1000 * summary.about["started"]), int(1000 * time.time())
        tags = {SWEEP_TAG: name, **SOURCE}
        found = self._find_runs({SWEEP_TAG: name})
        own = found[0] if found else self.client.create_run(self.experiment, began, tags, name)
        parent = str(own.info.run_id)
        self.client.set_tag(parent, "mlflow.note.content", answer(summary))
        children, states = (
            self._find_runs({PARENT_TAG: parent}),
            [sweep.state(j) for j in sweep.jobs],
        )
        for job, state in zip(sweep.jobs, states, strict=True):
            known_by = {RESULT_TAG: job.fingerprint, PARENT_TAG: parent}
            if state == "finished":
                results = load_results(address := sweep.address(job))
                self.send_result(address, results, job.label, job.values, known_by, children)
            elif state == "failed":
                at = int(1000 * ((folder := sweep.of(job)) / FAILURE).stat().st_mtime)
                error = {"xplain.error": sweep.error(job)[:4000]}
                self._write_run(folder, job.label, "FAILED", (at, at), known_by, error, children)
        if (report := sweep.path / "report").is_dir():
            self.client.log_artifacts(parent, str(report), "report")
        ended = "FAILED" if "failed" in states else "KILLED" if "waiting" in states else "FINISHED"
        self.client.set_terminated(parent, ended)
        # The form in which MLflow itself lists views, since 3.15.
        shared = {"name": name, "createdAt": now, "updatedAt": now}
        text = json.dumps({**shared, "state": json.dumps(view(parent, summary))})
        key = name.rpartition("-")[2]
        self.client.set_experiment_tag(self.experiment, f"mlflow.sharedViewState.{key}", text)
        return key

    def _write_run(
        self,
        folder: Path,
        name: str,
        status: str,
        times: tuple[int, int],
        known_by: Mapping[str, str],
        tags: Mapping[str, str],
        among: Sequence[Run],
        metrics: Sequence[Metric] = (),
        params: Sequence[Param] = (),
    ) -> str:
        """Writes an ended run unless it exists. Returns its id. Existing runs that have the tags
        ``known_by`` but another status or start come from earlier attempts or from interrupted
        senders, and are deleted.

        Args:
            folder: folder whose files become the run's artifacts.
            name, status: the run's name and status.
            times: start and end of the run, in milliseconds since 1970.
            known_by: tags that distinguish the run from all other runs.
            tags: further tags.
            among: runs in MLflow that may be this run already.
            metrics, params: the run's metrics and parameters.
        """
        kept = None
        for run in among:
            if known_by.items() <= run.data.tags.items():
                if kept is None and (run.info.status, run.info.start_time) == (status, times[0]):
                    kept = str(run.info.run_id)
                else:
                    self.client.delete_run(run.info.run_id)
        if kept is not None:
            return kept
        every = {**known_by, **tags, **SOURCE}
        made = self.client.create_run(self.experiment, times[0], every, name)
        self.client.log_batch(made.info.run_id, metrics, params)
        self.client.log_artifacts(made.info.run_id, str(folder))
        self.client.set_terminated(made.info.run_id, status, times[1])
        return str(made.info.run_id)

    def _find_runs(self, tags: Mapping[str, str]) -> Sequence[Run]:
        """Finds the runs with these tags, without deleted runs."""
        wanted = " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())
        return self.client.search_runs([self.experiment], wanted, max_results=50_000)


def figures(results: Results) -> dict[str, float]:
    """Returns ``{name in MLflow: number}`` for the means of the metrics, the ends of their
    confidence intervals, the figures of the learned types, and the seconds."""
    known = {FIGURES[key]: own for key, own in results.metrics.items() if key in FIGURES}
    compared = [name for name in known if name in MEASURES.values()]
    every = {
        **{name: own.mean for name, own in known.items()},
        **{f"{name}_low": known[name].low for name in compared},
        **{f"{name}_high": known[name].high for name in compared},
        **{f"types/{name}": results.learning.get(name) for name in LEARNED},
        "solver/seconds": sum(results.seconds.values()),
    }
    return {name: value for name, value in every.items() if value is not None}


def parameters(results: Results, swept: Mapping[str, str]) -> dict[str, str]:
    """Returns the swept values, the choices by group (``solver = pomcp``), and the keys at the top
    level of the configuration. The artifact ``results.json`` has all keys."""
    own = {key: value for key, value in results.config.items() if not isinstance(value, Mapping)}
    every = {**{key: swept[key] for key in swept if "." in key}, **results.choices, **own}
    return {key: str(value)[:500] for key, value in every.items()}


def view(parent: str, summary: Summary) -> dict[str, Any]:
    """Makes the view of a sweep on MLflow's page of runs: a row for each job with the measure, its
    interval, the cost and the swept values. Rows are sorted by λ or another swept key of the
    problem, or by the measure if the problem was not swept."""
    measure = MEASURES[summary.measure.name] if summary.results else "regret"
    keys = [key for key in summary.keys if len(summary.values(key)) > 1]
    figures = dict.fromkeys((measure, "solver/cost", f"{measure}_low", f"{measure}_high"))
    columns = [f"metrics.`{measure}`", *(f"params.`{key}`" for key in (*keys, "seed"))]
    columns += [f"metrics.`{name}`" for name in figures if name != measure]
    posed = sorted((key for key in keys if is_in(key, PROBLEM)), key=lambda key: key != "lambda")
    return {
        "searchFilter": f"tags.`{PARENT_TAG}` = '{parent}'",
        "orderByKey": f"params.`{posed[0]}`" if posed else columns[0],
        "orderByAsc": True,
        "selectedColumns": columns,
        "columnOrder": columns,
        "columnWidths": {column: max(80, 8 * len(column) - 56) for column in columns},
        "runsHiddenMode": "SHOW_ALL",
    }
