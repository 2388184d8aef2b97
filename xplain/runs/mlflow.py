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
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.errors import InputError, XplainError, first_line
from xplain.experiment.results import RESULTS, Results, load_results
from xplain.report.comparison import answer
from xplain.report.measure import is_problem, warning_about_oracle
from xplain.report.summary import SWEEP, Summary, load_sweep
from xplain.runs.folder import FAILURE, SweepFolder, runs_and_sweeps
from xplain.runs.terminal import without_passwords

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

log = logging.getLogger(__name__)

RESULT_TAG, SWEEP_TAG = "xplain.result", "xplain.sweep"
PARENT_TAG = "mlflow.parentRunId"
SOURCE = "python -m xplain"

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
        from filelock import FileLock
        from mlflow import MlflowClient

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
        address = uri.rstrip("/") if served else "http://127.0.0.1:5000"
        if (folder / SWEEP).exists():
            shown = f"workflowType=machine_learning&viewStateShareKey={store.send_sweep(folder)}"
            link = f"{address}/#/experiments/{experiment}/runs?{shown}"
        else:
            run = store.send_result(folder, load_results(folder), {}, {})
            link = f"{address}/#/experiments/{experiment}/runs/{run}"
        lines = [f"MLflow: {without_passwords(link)}"]
        if not served:
            uri = f"sqlite:///{os.path.relpath(own)}" if self.uri is None else self.uri
            lines.append(
                f"  once this runs: mlflow ui --backend-store-uri {without_passwords(uri)}"
            )
        return lines


def sync(folders: Sequence[Path], outputs: Path, tracking: MLflow) -> int:
    """Sends every run and sweep at or below the folders; returns how many results there are.

    Raises:
        InputError: a folder is not there, or holds no results.
        XplainError: MLflow cannot take them.
    """
    count = 0
    for folder in folders:
        below = list(runs_and_sweeps(folder))
        if not below:
            raise InputError("folder", str(folder), f"a folder with {RESULTS} in it or below")
        for one in below:
            sweep = SweepFolder(one)
            held: AbstractContextManager[None] = nullcontext()
            if (one / SWEEP).exists():
                try:
                    load_sweep(one)
                except InputError as error:  # the others can be sent all the same
                    log.warning("left out: %s", error)
                    continue
                held = sweep.alone(f"{one.name}: it is running; waiting for its end")
                count += sum(sweep.state(job) == "finished" for job in sweep.jobs())
            else:
                count += 1
            try:
                with held:
                    tracking.send(one, outputs)
            except XplainError:
                raise
            except Exception as error:  # MLflow raises what SQLAlchemy, requests, the OS do
                text = without_passwords(first_line(error))
                allowed = f"tracking.uri: MLflow does not take the results ({text})"
                raise XplainError(allowed) from error
    return count


def _make_database(path: Path) -> None:
    """Makes MLflow's tables, all or none: a database that is cut short can never be used."""
    from mlflow import MlflowClient

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
        from mlflow.entities import Metric, Param

        times = (results.started, results.started + sum(results.seconds.values()))
        started, end = (int(1000 * seconds) for seconds in times)
        about = {
            "mlflow.source.git.commit": results.git.get("commit", ""),
            "xplain.rule": results.elbow.rule,
            "xplain.warning": warning_about_oracle(results.learning),
        }
        tags = {RESULT_TAG: results.fingerprint, **(tags or {"xplain.single": "yes"})}
        run, new = self._run(results.name, "FINISHED", started, tags, about, among)
        if new:
            known = figures(results)
            metrics = [Metric(key, round(v, 4), end, 0) for key, v in sorted(known.items())]
            params = [Param(key, value) for key, value in parameters(results, swept).items()]
            self.client.log_batch(run, metrics, params)
            self.client.log_artifacts(run, str(folder))
            self.client.set_terminated(run, "FINISHED", end)
        return run

    def send_sweep(self, path: Path) -> str:
        """Sends a sweep's jobs that ended, its report and a view of it; returns the view's key."""
        from mlflow.entities import Param

        sweep, summary = SweepFolder(path), Summary(path)
        jobs, started = sweep.jobs(), int(1000 * summary.about["started"])
        parent, _ = self._run(sweep.identity, "", started, {SWEEP_TAG: sweep.identity}, {})
        keys = dict.fromkeys(key for job in jobs for key in job.values)
        swept = {key: dict.fromkeys(job.values.get(key, "") for job in jobs) for key in keys}
        params = [Param(key, ", ".join(values)[:500]) for key, values in swept.items()]
        self.client.log_batch(parent, params=[*params, Param("jobs", str(len(jobs)))])
        self.client.set_tag(parent, "mlflow.note.content", answer(summary))
        children = self._known({PARENT_TAG: parent})
        for job in jobs:
            tags = {RESULT_TAG: job.fingerprint, PARENT_TAG: parent}
            if (state := sweep.state(job)) == "finished":
                own = replace(load_results(sweep.address(job)), name=job.label)
                self.send_result(sweep.address(job), own, job.values, tags, children)
            elif state == "failed":
                at = int(1000 * (sweep.of(job) / FAILURE).stat().st_mtime)
                error = {"xplain.error": sweep.failure(job)["error"][:4000]}
                run, new = self._run(job.label, "FAILED", at, tags, error, children)
                if new:
                    self.client.log_artifacts(run, str(sweep.of(job)))
                    self.client.set_terminated(run, "FAILED", at)
        if (path / "report").is_dir():
            self.client.log_artifacts(parent, str(path / "report"), "report")
        states = {sweep.state(job) for job in jobs}
        ended = (
            "FINISHED" if states == {"finished"} else "FAILED" if "failed" in states else "KILLED"
        )
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
        source = {"mlflow.user": os.environ.get("USER", ""), "mlflow.source.name": SOURCE}
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
