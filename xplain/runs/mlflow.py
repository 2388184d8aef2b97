"""Sends results to MLflow: a run for each result, and for a sweep a parent whose children are its
jobs.

Everything is read from folders on disk when a run or sweep ends, so what MLflow missed can be sent
later, and what is sent twice is there once. This module imports MLflow, which takes a second.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.entities import Metric, Param, Run

from xplain.errors import InputError, XplainError, first_line
from xplain.experiment.results import RESULTS, Results, load_results
from xplain.report.claims import answer
from xplain.report.frame import (
    PROBLEM,
    SWEEP,
    Summary,
    is_in,
    load_sweep,
    warning_about_oracle,
)
from xplain.runs.folder import FAILURE, Disk, SweepFolder, runs_and_sweeps
from xplain.runs.terminal import without_passwords

log = logging.getLogger(__name__)

RESULT_TAG, SWEEP_TAG = "xplain.result", "xplain.sweep"
PARENT_TAG = "mlflow.parentRunId"

FIGURES = {
    "regret": "regret",
    "regret_to_clairvoyant": "regret_to_clairvoyant",
    "cost": "solver/cost",
    "messages": "solver/messages",
    "inexplicable_labels": "solver/inexplicable_labels",
    "questions": "solver/questions",
    "steps_until_sure": "solver/steps_until_sure",
}
"""Names in MLflow of the figures of a result that people compare. MLflow's comparison of runs
draws the first metric that was logged, so they are logged in the order of the alphabet."""

MEASURES = {"regret": "regret", "above_floor": "regret_to_clairvoyant", "cost": "solver/cost"}
"""Names in MLflow of what the jobs of a sweep are compared by."""

LEARNED = ("adjusted_rand_index", "labeler_accuracy")


@dataclass(frozen=True)
class MLflow(Disk):
    """Sends results to MLflow.

    Attributes:
        uri: of the tracking server or database; None is an SQLite file in the outputs folder.
        experiment: name of the MLflow experiment.
    """

    uri: str | None = None
    experiment: str = "xplain"

    def log(self, folder: Path, outputs: Path) -> list[str]:
        """Sends the results; a failure costs a warning that tells how to send them later."""
        try:
            return self.send(folder, outputs)
        except Exception as error:  # MLflow raises what SQLAlchemy, requests, the OS do
            log.warning(
                "MLflow did not take this (%s). The results are safe in %s; send them later "
                "with: python -m xplain sync %s",
                without_passwords(first_line(error))[:200],
                folder,
                folder,
            )
            log.debug("MLflow failed", exc_info=True)
            return []

    def send(self, folder: Path, outputs: Path) -> list[str]:
        """Brings MLflow to the state of a run's or sweep's folder.

        Returns:
            Lines for the terminal: where to look.

        Raises:
            InputError: the experiment was deleted in MLflow.
            OSError, SQLAlchemyError, MlflowException: the store cannot take it.
        """
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
        page = f"{uri.rstrip('/') if served else 'http://127.0.0.1:5000'}/#/experiments"
        if (folder / SWEEP).exists():
            shown = f"workflowType=machine_learning&viewStateShareKey={store.send_sweep(folder)}"
            lines = [f"MLflow: {page}/{experiment}/runs?{shown}"]
        else:
            run = store.send_result(folder, load_results(folder), {}, {"xplain.single": "yes"})
            lines = [f"MLflow: {page}/{experiment}/runs/{run}"]
        if not served:
            place = f"sqlite:///{os.path.relpath(own)}" if self.uri is None else self.uri
            lines.append(f"  once this runs: mlflow ui --backend-store-uri {place}")
        return [without_passwords(line) for line in lines]


def sync(folders: Sequence[Path], outputs: Path, tracking: MLflow) -> int:
    """Sends every run and sweep at or below the folders; returns how many results there are.

    Raises:
        InputError: a folder is not there, or holds no results.
        XplainError: MLflow cannot take them.
    """
    count = 0
    for one in [path for folder in folders for path in _sent(folder)]:
        sweep = SweepFolder(one) if (one / SWEEP).exists() else None
        try:
            with sweep.alone(f"{one.name}: it is running; waiting") if sweep else nullcontext():
                tracking.send(one, outputs)
        except XplainError:
            raise
        except Exception as error:  # MLflow raises what SQLAlchemy, requests, the OS do
            text = without_passwords(first_line(error))
            said = f"tracking.uri: MLflow does not take the results ({text})"
            raise XplainError(said) from error
        states = [sweep.state(job) for job in sweep.jobs()] if sweep else ["finished"]
        count += states.count("finished")
    return count


def _sent(folder: Path) -> list[Path]:
    """The runs and sweeps at or below a folder; says which sweep is damaged and left out."""
    found = list(runs_and_sweeps(folder))
    if not found:
        raise InputError("folder", str(folder), f"a folder with {RESULTS} in it or below")
    for one in [path for path in found if (path / SWEEP).exists()]:
        try:
            load_sweep(one)
        except InputError as error:
            log.warning("left out: %s", error)
            found.remove(one)
    return found


def _make_database(path: Path) -> None:
    """Makes MLflow's tables, all or none: a database that is cut short can never be used."""
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
        swept: Mapping[str, str],
        tags: Mapping[str, str],
        among: Sequence[Run] | None = None,
    ) -> str:
        """Sends a result unless its run is there; returns the id of the run.

        Args:
            folder, results: of the finished run.
            swept: keys of the sweep with this run's values.
            tags: that tell it from runs of the same result in other sweeps.
            among: runs that may be its; None looks for them.
        """
        times = (results.started, results.started + sum(results.seconds.values()))
        started, end = (int(1000 * seconds) for seconds in times)
        about = {
            "mlflow.source.git.commit": results.git.get("commit", ""),
            "xplain.rule": results.elbow.rule,
            "xplain.warning": warning_about_oracle(results.learning, results.regret or 0),
        }
        tags = {RESULT_TAG: results.fingerprint, **tags}
        run, new = self._run(results.name, "FINISHED", started, tags, about, among)
        if new:
            known = sorted(figures(results).items())
            metrics = [Metric(key, round(value, 4), end, 0) for key, value in known]
            params = [Param(key, value) for key, value in parameters(results, swept).items()]
            self.client.log_batch(run, metrics, params)
            self.client.log_artifacts(run, str(folder))
            self.client.set_terminated(run, "FINISHED", end)
        return run

    def send_sweep(self, path: Path) -> str:
        """Sends a sweep's jobs that ended, its report and a view of it; returns the view's key."""
        sweep, summary = SweepFolder(path), Summary(path)
        started = int(1000 * summary.about["started"])
        parent, _ = self._run(sweep.identity, "", started, {SWEEP_TAG: sweep.identity}, {})
        self.client.set_tag(parent, "mlflow.note.content", answer(summary))
        children = self._known({PARENT_TAG: parent})
        states = {job.fingerprint: sweep.state(job) for job in sweep.jobs()}
        for job in sweep.jobs():
            tags = {RESULT_TAG: job.fingerprint, PARENT_TAG: parent}
            if states[job.fingerprint] == "finished":
                own = replace(load_results(sweep.address(job)), name=job.label)
                self.send_result(sweep.address(job), own, job.values, tags, children)
            elif states[job.fingerprint] == "failed":
                at = int(1000 * (sweep.of(job) / FAILURE).stat().st_mtime)
                error = {"xplain.error": sweep.failure(job)["error"][:4000]}
                run, new = self._run(job.label, "FAILED", at, tags, error, children)
                if new:
                    self.client.log_artifacts(run, str(sweep.of(job)))
                    self.client.set_terminated(run, "FAILED", at)
        if (path / "report").is_dir():
            self.client.log_artifacts(parent, str(path / "report"), "report")
        every = set(states.values())
        ended = "FAILED" if "failed" in every else "KILLED" if "waiting" in every else "FINISHED"
        self.client.set_terminated(parent, ended)
        key, now = sweep.identity.rpartition("-")[2], int(1000 * time.time())
        # The form in which MLflow lists views itself, from 3.15 on.
        shared = {"name": sweep.identity, "createdAt": now, "updatedAt": now}
        text = json.dumps({**shared, "state": json.dumps(view(parent, summary))})
        self.client.set_experiment_tag(self.experiment, f"mlflow.sharedViewState.{key}", text)
        return key

    def _run(
        self,
        name: str,
        status: str,
        started: int,
        known_by: Mapping[str, str],
        tags: Mapping[str, str],
        among: Sequence[Run] | None = None,
    ) -> tuple[str, bool]:
        """The id of the run that is known by these tags, and whether it is new. Runs of another
        status or start are of earlier attempts, or their sender died: they are deleted.

        Args:
            name: of a new run.
            status: that it has to have; "" takes any.
            started: when, in milliseconds since 1970.
            known_by: tags that tell it from all others.
            tags: more of them, of a new run.
            among: runs that may be it; None looks for them.
        """
        found = self._known(known_by) if among is None else among
        kept = None
        for run in (one for one in found if known_by.items() <= one.data.tags.items()):
            same = (run.info.status, run.info.start_time) == (status or run.info.status, started)
            if same and kept is None:
                kept = run
            else:
                self.client.delete_run(run.info.run_id)
        source = {
            "mlflow.user": os.environ.get("USER", ""),
            "mlflow.source.name": "python -m xplain",
        }
        every = {**known_by, **tags, **source}
        made = kept or self.client.create_run(self.experiment, started, every, name)
        return str(made.info.run_id), kept is None

    def _known(self, tags: Mapping[str, str]) -> Sequence[Run]:
        """The runs with these tags, which are not deleted."""
        wanted = " and ".join(f"tags.`{key}` = '{value}'" for key, value in tags.items())
        return self.client.search_runs([self.experiment], wanted, max_results=50_000)


def figures(results: Results) -> dict[str, float]:
    """Figures that make one number each, by their names in MLflow."""
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
    """What was swept, the choices by group (``solver = pomcp``), and the experiment's own numbers
    and words; ``config.yaml`` among the artifacts has all keys."""
    own = {key: value for key, value in results.config.items() if not isinstance(value, Mapping)}
    every = {**{key: swept[key] for key in swept if "." in key}, **results.choices, **own}
    return {key: str(value)[:500] for key, value in every.items()}


def view(parent: str, summary: Summary) -> dict[str, Any]:
    """What MLflow's page of runs shows of a sweep: a row a job with the measure, its interval, the
    cost and what was swept. Problems stand in their order; the jobs of one problem, if one was
    swept, by the measure."""
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
