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
from contextlib import nullcontext
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
from xplain.runs.folder import Disk, alone, attempt, runs_and_sweeps, without_passwords

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

Texts = Mapping[str, str]
Ended = tuple[Path, str, tuple[int, int], str, Texts, Mapping[str, float], Texts]
"""An ended job: the folder with its files, its status, its start and end in milliseconds since
1970, its name, tags, metrics and parameters."""

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
        lines = list[str]()
        with attempt(
            f"results are safe, but not in MLflow (later: python -m xplain sync {folder})"
        ):
            lines = self.send(folder, outputs)
        return lines

    def send(self, folder: Path, outputs: Path) -> list[str]:
        """Updates MLflow to the state of a run's or sweep's folder.

        Returns:
            Lines for the terminal that say where the results are.

        Raises:
            XplainError: MLflow fails, or the experiment was deleted there.
        """
        own = outputs.resolve() / "mlflow.db"
        # SQLAlchemy ends a path at "?". A relative path lacks the names of the folders above.
        uri = self.uri or f"sqlite:///{os.path.relpath(own) if '?' in str(own) else own}"
        served = uri.startswith("http")
        try:
            with FileLock(outputs / "mlflow.lock"):  # makes the folder too
                if self.uri is None and not own.exists():
                    _make_database(own)
                client = MlflowClient(uri)
                found = client.get_experiment_by_name(self.experiment)
                if found is not None and found.lifecycle_stage == "deleted":
                    allowed = "an experiment that exists; restore it in MLflow or name another"
                    raise InputError("tracking.experiment", self.experiment, allowed)
                artifacts = None if served else (own.parent / "artifacts").as_uri()
                experiment = (
                    found.experiment_id
                    if found
                    else client.create_experiment(self.experiment, artifacts)
                )
            store = _Store(client, experiment)
            is_sweep = (folder / SWEEP).exists()
            shown = store.send_sweep(Summary(folder)) if is_sweep else store.send_single(folder)
        except XplainError:
            raise
        except Exception as error:  # MLflow passes on errors of SQLAlchemy, requests, the OS
            text = without_passwords(first_line(error))[:200]
            raise XplainError(f"tracking.uri: MLflow did not store the results ({text})") from error
        page = f"{uri.rstrip('/') if served else 'http://127.0.0.1:5000'}/#/experiments"
        lines = [f"MLflow: {page}/{experiment}/runs{shown}"]
        if not served:
            place = self.uri or f"sqlite:///{os.path.relpath(own)}"
            lines.append(f"  start its server first: mlflow ui --backend-store-uri {place}")
        return [without_passwords(line) for line in lines]


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
            sweep, is_sweep = SweepFolder(path), (path / SWEEP).exists()
            try:
                states = [sweep.state(job) for job in sweep.jobs] if is_sweep else ["finished"]
            except InputError as error:
                log.warning("left out: %s", error)
                continue
            waiting = "the sweep is running; waiting for its end"
            with alone(path, waiting) if is_sweep else nullcontext():
                tracking.send(path, outputs)
            count += states.count("finished")
    return count


def _make_database(path: Path) -> None:
    """Creates MLflow's tables atomically: an incomplete database could never be used."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mlflow.") as folder:
        new = Path(folder) / path.name
        MlflowClient(f"sqlite:///{os.path.relpath(new)}").search_experiments(max_results=1)
        new.rename(path)


@dataclass(frozen=True)
class _Store:
    """An experiment in MLflow."""

    client: MlflowClient
    experiment: str

    def send_single(self, folder: Path) -> str:
        """Sends the run in a folder. Returns the end of its address in MLflow."""
        results = load_results(folder)
        mark = {"xplain.single": "yes", RESULT_TAG: results.fingerprint}
        (sent,) = self._replace(mark, [_ended(folder, results, results.name, {})])
        return f"/{sent}"

    def send_sweep(self, summary: Summary) -> str:
        """Sends the ended jobs and the report of a sweep, and its view (:func:`view`). Returns the
        end of the view's address in MLflow."""
        sweep, name = summary.folder, summary.folder.path.name
        began, now = int(1000 * summary.about["started"]), int(1000 * time.time())
        tags = {SWEEP_TAG: name, **SOURCE}
        own = self._find_runs({SWEEP_TAG: name})
        own = own or [self.client.create_run(self.experiment, began, tags, name)]
        parent = str(own[0].info.run_id)
        self.client.set_tag(parent, "mlflow.note.content", answer(summary))
        ended = [
            _ended(sweep.address(job), results, job.label, job.values)
            for job, results in summary.results
        ]
        failed = [job for job in sweep.jobs if sweep.state(job) == "failed"]
        for job in failed:
            at = int(1000 * (sweep.of(job) / FAILURE).stat().st_mtime)
            tags = {RESULT_TAG: job.fingerprint, "xplain.error": sweep.error(job)[:4000]}
            ended.append((sweep.of(job), "FAILED", (at, at), job.label, tags, {}, {}))
        self._replace({PARENT_TAG: parent}, ended)
        if (report := sweep.path / "report").is_dir():
            self.client.log_artifacts(parent, str(report), "report")
        whole = "FINISHED" if len(ended) == len(sweep.jobs) else "KILLED"
        self.client.set_terminated(parent, "FAILED" if failed else whole)
        # The form in which MLflow itself lists views, since 3.15.
        state = json.dumps(view(parent, summary))
        text = json.dumps({"name": name, "createdAt": now, "updatedAt": now, "state": state})
        key = name.rpartition("-")[2]
        self.client.set_experiment_tag(self.experiment, f"mlflow.sharedViewState.{key}", text)
        return f"?workflowType=machine_learning&viewStateShareKey={key}"

    def _replace(self, mark: Mapping[str, str], jobs: Sequence[Ended]) -> list[str]:
        """Makes these jobs the only runs of their results among the runs with the tags ``mark``.
        Returns their ids. A run with the status and the start of its job is kept; a run with others
        comes from an earlier attempt or an interrupted sender."""
        known, sent = self._find_runs(mark), list[str]()
        results = {job[4][RESULT_TAG] for job in jobs}
        ids = {(r.data.tags.get(RESULT_TAG), r.info.status, r.info.start_time): r for r in known}
        for folder, status, (began, ended), name, own, numbers, texts in jobs:
            run = ids.get((own[RESULT_TAG], status, began))
            if run is None:
                tags = {**own, **mark, **SOURCE}
                run = self.client.create_run(self.experiment, began, tags, name)
                metrics = [Metric(*one, ended, 0) for one in sorted(numbers.items())]
                params = [Param(*one) for one in texts.items()]
                self.client.log_batch(run.info.run_id, metrics, params)
                self.client.log_artifacts(run.info.run_id, str(folder))
                self.client.set_terminated(run.info.run_id, status, ended)
            sent.append(run.info.run_id)
        for run in known:
            if run.data.tags.get(RESULT_TAG) in results and run.info.run_id not in sent:
                self.client.delete_run(run.info.run_id)
        return sent

    def _find_runs(self, tags: Mapping[str, str]) -> Sequence[Run]:
        """Finds the runs with these tags, without deleted runs."""
        wanted = " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())
        return self.client.search_runs([self.experiment], wanted, max_results=50_000)


def _ended(folder: Path, results: Results, name: str, swept: Mapping[str, str]) -> Ended:
    """Describes a finished job; ``swept`` has the swept keys with the job's values."""
    began, end = results.started, results.started + sum(results.seconds.values())
    tags = {
        RESULT_TAG: results.fingerprint,
        "mlflow.source.git.commit": results.git.get("commit", ""),
        "xplain.warning": warning_about_oracle(results.learning, results.regret),
    }
    times = int(1000 * began), int(1000 * end)
    return folder, "FINISHED", times, name, tags, figures(results), parameters(results, swept)


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
    return {name: round(value, 4) for name, value in every.items() if value is not None}


def parameters(results: Results, swept: Mapping[str, str]) -> dict[str, str]:
    """Returns the swept values, the choices by group (``solver = pomcp``), and the keys at the top
    level of the configuration. The artifact ``results.json`` has all keys."""
    own = {key: value for key, value in results.config.items() if not isinstance(value, Mapping)}
    inner = {key: swept[key] for key in swept if "." in key}
    return {key: str(value)[:500] for key, value in {**inner, **results.choices, **own}.items()}


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
