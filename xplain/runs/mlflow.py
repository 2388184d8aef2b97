"""Where results go besides the disk: nowhere, or to MLflow.

MLflow gets a run for each result; a sweep is a parent whose children are its jobs. Everything is
read from folders on disk when a run or sweep ends, so what MLflow missed can be sent later, and
what is sent twice is there once.
"""

from __future__ import annotations

import json
import logging
import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.errors import InputError, first_line
from xplain.experiment.results import Results, load_results
from xplain.report.comparison import answer
from xplain.report.measure import is_problem, warning_about_oracle
from xplain.report.summary import SWEEP, Summary
from xplain.runs.folder import FAILURE, SweepFolder
from xplain.runs.terminal import without_passwords

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

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


class Disk:
    """Leaves results on disk; subclasses send them elsewhere."""

    def log(self, folder: Path, outputs: Path) -> list[str]:
        """Takes note of a run or a sweep that ended. Never raises: the results are on disk.

        Args:
            folder: of the run or sweep.
            outputs: the outputs folder.

        Returns:
            Lines for the terminal: where to look.
        """
        return []


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
        from mlflow import MlflowClient

        outputs.mkdir(parents=True, exist_ok=True)
        own = outputs.resolve() / "mlflow.db"
        uri = self.uri or f"sqlite:///{own}"
        served = uri.startswith("http")
        from filelock import FileLock

        with FileLock(outputs / "mlflow.lock"):
            if self.uri is None and not own.exists():
                _make_database(own)
            client = MlflowClient(tracking_uri=uri)
            found = client.get_experiment_by_name(self.experiment)
            if found is not None and found.lifecycle_stage == "deleted":
                allowed = "an experiment that was not deleted; restore it in MLflow or name another"
                raise InputError("tracking.experiment", self.experiment, allowed)
            artifacts = None if served else (outputs.resolve() / "artifacts").as_uri()
            experiment = found and found.experiment_id
            experiment = experiment or client.create_experiment(self.experiment, artifacts)
        page = (
            f"{uri.rstrip('/') if served else 'http://127.0.0.1:5000'}/#/experiments/{experiment}"
        )
        if (folder / SWEEP).exists():
            view = _send_sweep(client, experiment, SweepFolder(folder))
            link = f"{page}/runs?workflowType=machine_learning&viewStateShareKey={view}"
        else:
            link = f"{page}/runs/{_send_run(client, experiment, folder, load_results(folder))}"
        lines = [f"MLflow: {without_passwords(link)}"]
        if not served:
            uri = f"sqlite:///{os.path.relpath(own)}" if self.uri is None else self.uri
            lines.append(
                f"  once this runs: mlflow ui --backend-store-uri {without_passwords(uri)}"
            )
        return lines


def _make_database(path: Path) -> None:
    """Makes MLflow's tables, all or none: a database that is cut short can never be used."""
    from mlflow import MlflowClient

    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mlflow.") as folder:
        new = Path(folder) / path.name
        MlflowClient(tracking_uri=f"sqlite:///{new}").search_experiments(max_results=1)
        new.rename(path)


def _tagged(client: MlflowClient, experiment: str, tag: str, value: str) -> Iterator[Run]:
    token = None
    while True:
        condition = f"tags.`{tag}` = '{value}'"
        page = client.search_runs([experiment], condition, max_results=500, page_token=token)
        yield from page
        token = page.token
        if not token:
            return


def _send_run(
    client: MlflowClient,
    experiment: str,
    folder: Path,
    results: Results,
    swept: Mapping[str, str] | None = None,
    tags: Mapping[str, str] | None = None,
    known: list[Run] | None = None,
) -> str:
    """Sends a result unless its run is there; returns the id of the run.

    Args:
        client, experiment: where to.
        folder, results: of the finished run.
        swept: keys of the sweep with this run's values.
        tags: more of them.
        known: runs that may be this one's; None looks for them.
    """
    from mlflow.entities import Metric, Param

    started, end = (int(1000 * (results.started + s)) for s in (0, sum(results.seconds.values())))
    if known is None:
        known = list(_tagged(client, experiment, RESULT_TAG, results.id))
    run_id, new = _run_once(
        client,
        experiment,
        known,
        results.name,
        ("FINISHED", started),
        {
            RESULT_TAG: results.id,
            "mlflow.source.git.commit": results.git.get("commit", ""),
            "xplain.rule": results.elbow.rule,
            "xplain.warning": warning_about_oracle(results.learning),
            **(tags or {}),
        },
    )
    if new:
        curves = {
            "solver/belief_in_true_type": enumerate(results.steps.get("belief_in_true_type", ())),
            "types/disagreements": enumerate(results.elbow.disagreements, start=1),
        }
        points = [(name, 0, value) for name, value in sorted(figures(results).items())]
        points += [(name, k, value) for name, curve in curves.items() for k, value in curve]
        client.log_batch(
            run_id,
            [Metric(name, round(value, 4), end, step) for name, step, value in points],
            [Param(key, value) for key, value in parameters(results, swept or {}).items()],
        )
        client.log_artifacts(run_id, str(folder))
        client.set_terminated(run_id, "FINISHED", end)
    return run_id


def _run_once(
    client: MlflowClient,
    experiment: str,
    known: list[Run],
    name: str,
    state: tuple[str, int],
    tags: dict[str, str],
) -> tuple[str, bool]:
    """The id of a known run of this status and start, else of a new one; and whether it is new.
    Other known ones are deleted: a sender died meanwhile, or they are of an earlier attempt."""
    kept = [run for run in known if (run.info.status, run.info.start_time) == state][:1]
    for run in known:
        if run not in kept:
            client.delete_run(run.info.run_id)
    tags |= {"mlflow.user": os.environ.get("USER", ""), "mlflow.source.name": "python -m xplain"}
    found = kept or [client.create_run(experiment, state[1], tags, name)]
    return str(found[0].info.run_id), not kept


def figures(results: Results) -> dict[str, float]:
    """Figures that make one number each, by their names in MLflow."""
    known = {FIGURES[key]: own for key, own in results.metrics.items() if key in FIGURES}
    flat = {name: own.mean for name, own in known.items()}
    for name in set(MEASURES.values()) & known.keys():
        ends = {f"{name}_low": known[name].low, f"{name}_high": known[name].high}
        flat |= {end: value for end, value in ends.items() if value is not None}
    flat |= {
        f"types/{name}": results.learning[name] for name in LEARNED if name in results.learning
    }
    return flat | {"solver/seconds": sum(results.seconds.values())}


def parameters(results: Results, swept: Mapping[str, str]) -> dict[str, str]:
    """What was swept, the choices by group (``solver = pomcp``), and the experiment's own numbers
    and words; ``config.yaml`` among the artifacts has all keys."""
    own = {key: value for key, value in results.config.items() if not isinstance(value, Mapping)}
    every = {**{key: swept[key] for key in swept if "." in key}, **results.choices, **own}
    return {key: str(value)[:500] for key, value in every.items()}


def _send_sweep(client: MlflowClient, experiment: str, sweep: SweepFolder) -> str:
    """Sends a sweep's jobs that ended, its report and the view of it; returns the view's key."""
    from mlflow.entities import Param

    summary, jobs = Summary(sweep.path), sweep.jobs()
    started = int(1000 * summary.about["started"])
    tags = {SWEEP_TAG: sweep.identity}
    found = next(_tagged(client, experiment, SWEEP_TAG, sweep.identity), None)
    found = found or client.create_run(experiment, started, tags, sweep.identity)
    parent = str(found.info.run_id)
    keys = dict.fromkeys(key for job in jobs for key in job.values)
    swept = {key: dict.fromkeys(job.values.get(key, "") for job in jobs) for key in keys}
    params = [Param(key, ", ".join(values)[:500]) for key, values in swept.items()]
    client.log_batch(parent, params=[*params, Param("jobs", str(len(jobs)))])
    client.set_tag(parent, "mlflow.note.content", answer(summary))
    children: dict[str, list[Run]] = {}
    for run in _tagged(client, experiment, PARENT_TAG, parent):
        children.setdefault(run.data.tags.get(RESULT_TAG, ""), []).append(run)
    results = {job["name"]: own for job, own in summary.results}
    end = started
    for job in jobs:
        folder, known = sweep.of(job), children.get(sweep.result_id(job), [])
        if own := results.get(job.name):
            tags = {PARENT_TAG: parent}
            _send_run(client, experiment, folder, own, job.values, tags, known)
            end = max(end, int(1000 * (own.started + sum(own.seconds.values()))))
        elif (folder / FAILURE).exists():
            at = int(1000 * (folder / FAILURE).stat().st_mtime)
            tags = {RESULT_TAG: sweep.result_id(job), PARENT_TAG: parent}
            tags["xplain.error"] = sweep.failure(job)["error"][:4000]
            run_id, new = _run_once(client, experiment, known, job.label, ("FAILED", at), tags)
            if new:
                client.log_artifacts(run_id, str(folder))
                client.set_terminated(run_id, "FAILED", at)
    if (sweep.path / "report").is_dir():
        client.log_artifacts(parent, str(sweep.path / "report"), "report")
    states = {sweep.state(job) for job in jobs}
    status = "FINISHED" if states == {"finished"} else "FAILED" if "failed" in states else "KILLED"
    client.set_terminated(parent, status, end)
    key = sweep.identity.rpartition("-")[2]
    name, state = f"mlflow.sharedViewState.{key}", view(parent, summary)
    now = int(1000 * time.time())
    shared = {
        "name": sweep.identity,
        "createdAt": now,
        "updatedAt": now,
        "state": json.dumps(state),
    }
    client.set_experiment_tag(experiment, name, json.dumps(shared))
    return key


def view(parent: str, summary: Summary) -> dict[str, Any]:
    """What MLflow's page of runs shows of a sweep: a row a job with the measure, its interval, the
    cost and what was swept. Problems stand in their order; the jobs of one problem, if one was
    swept, by the measure."""
    measure = MEASURES[summary.measure.name] if summary.results else "regret"
    keys = [key for key in summary.keys if len(summary.values(key)) > 1]
    figures = dict.fromkeys((measure, "solver/cost", f"{measure}_low", f"{measure}_high"))
    columns = [f"metrics.`{measure}`", *(f"params.`{key}`" for key in (*keys, "seed"))]
    columns += [f"metrics.`{name}`" for name in figures if name != measure]
    posed = sorted((key for key in keys if is_problem(key)), key=lambda key: key != "lambda")
    return {
        "searchFilter": f"tags.`{PARENT_TAG}` = '{parent}'",
        "orderByKey": f"params.`{posed[0]}`" if posed else columns[0],
        "orderByAsc": True,
        "selectedColumns": columns,
        "columnOrder": columns,
        "columnWidths": {column: max(80, 8 * len(column) - 56) for column in columns},
        "runsHiddenMode": "SHOW_ALL",
    }
