"""Runs in MLflow: made from a run's folder on disk, so they can be sent later as well.

MLflow is imported when it is used: it takes a second.
"""

from __future__ import annotations

import contextlib
import getpass
import logging
import os
import shutil
import socket
import sqlite3
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xplain.experiment.results import load_results
from xplain.runs.mlflow_run import fill
from xplain.runs.mlflow_views import describe_experiment

if TYPE_CHECKING:
    from mlflow import MlflowClient

log = logging.getLogger(__name__)

PROCESS_TAG = "xplain.process"
"""Tag that holds the process which keeps a run: host, pid, its start."""

RESULT_TAG = "xplain.result"
"""Tag that holds a result's identity; a result is in MLflow once, however often it is sent."""


@dataclass(frozen=True)
class Disk:
    """Tracks nothing: results stay on disk."""

    def log(self, folder: Path, outputs: Path) -> str | None:
        """Sends nothing and returns None: there is no run in MLflow."""
        return None


@dataclass(frozen=True)
class MLflow:
    """Logs each job as one MLflow run.

    Attributes:
        uri: of the tracking server or database; None is an SQLite file in the outputs folder.
        experiment: name of the MLflow experiment.
    """

    uri: str | None = None
    experiment: str = "xplain"

    def tracking_uri(self, outputs: Path) -> str:
        """URI of the server or database to which runs are sent."""
        return self.uri or f"sqlite:///{outputs.resolve() / 'mlflow.db'}"

    def pages(self, outputs: Path) -> str:
        """Where the user interface shows things; an SQLite file's is on this machine."""
        uri = self.tracking_uri(outputs)
        return f"{uri.rstrip('/')}/#" if uri.startswith("http") else "http://127.0.0.1:5000/#"

    def how_to_open(self, outputs: Path) -> str | None:
        """The command without which the links lead nowhere; None where a server runs already."""
        uri = self.tracking_uri(outputs)
        if uri.startswith("http"):
            return None
        if outputs.resolve() == Path.cwd() / "outputs" and self.uri is None:
            uri = "sqlite:///outputs/mlflow.db"
        return f"mlflow ui --backend-store-uri {uri}"

    def log(self, folder: Path, outputs: Path) -> str | None:
        """Sends the results in ``folder``; a result that is there already is not sent again.

        A failure costs nothing but a warning: the results are on disk.

        Args:
            folder: of a finished run.
            outputs: where the database is.

        Returns:
            The address of the run's page; None when MLflow could not take it.
        """
        try:
            with self.client(outputs) as (client, experiment_id):
                run_id = log_folder(client, experiment_id, folder)
                describe_experiment(client, experiment_id)
                return f"{self.pages(outputs)}/experiments/{experiment_id}/runs/{run_id}"
        except Exception as error:  # MLflow raises what SQLAlchemy, requests, the OS do
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            log.warning(
                "MLflow did not take this run (%s). The results are safe in %s; send them later "
                "with: python -m xplain sync %s",
                reason[:200],
                folder,
                folder,
            )
            log.debug("MLflow failed", exc_info=True)
            return None

    @contextlib.contextmanager
    def client(self, outputs: Path) -> Iterator[tuple[MlflowClient, str]]:
        """A client, and the id of the experiment (made when missing).

        Raises:
            OSError, MlflowException: the store cannot be reached.
        """
        uri = self.tracking_uri(outputs)
        _refuse_unusable(uri)
        # A person waits for this; the defaults would retry for minutes.
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "2")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
        from filelock import FileLock
        from mlflow import MlflowClient
        from mlflow.exceptions import MlflowException

        # After the import, which configures these loggers.
        logging.getLogger("mlflow").setLevel(logging.CRITICAL)
        logging.getLogger("alembic").setLevel(logging.ERROR)
        outputs.mkdir(parents=True, exist_ok=True)
        # Two processes that create the database at once break it for good.
        with FileLock(outputs / "mlflow.lock"):
            _create_whole(uri)
            client = MlflowClient(tracking_uri=uri)
            found = client.get_experiment_by_name(self.experiment)
            if found is None:
                artifacts = (outputs.resolve() / "artifacts").as_uri()
                location = None if uri.startswith("http") else artifacts
                try:
                    experiment_id = client.create_experiment(self.experiment, location)
                except MlflowException:
                    # Another machine was faster; the lock covers this one only.
                    found = client.get_experiment_by_name(self.experiment)
                    if found is None:
                        raise
                    experiment_id = found.experiment_id
            else:
                experiment_id = found.experiment_id
        yield client, experiment_id


def tell_links(tracking: Disk | MLflow, outputs: Path, links: list[tuple[str, str]]) -> None:
    """The last lines of a run or a sweep: where it is in MLflow, and how to look there."""
    if not links or not isinstance(tracking, MLflow):
        return
    for words, address in links:
        log.info("%s: %s", words, address)
    command = tracking.how_to_open(outputs)
    if command is not None:
        log.info("  once this runs: %s", command)


def _create_whole(uri: str) -> None:
    """Creates an SQLite database that is not there, all of it or nothing: one whose creation
    was cut short can be neither used nor completed."""
    path = Path(uri.removeprefix("sqlite:///"))
    if not uri.startswith("sqlite:///") or path.exists():
        return
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    for left in path.parent.glob(".mlflow.*"):
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".mlflow.") as folder:
        new = Path(folder) / path.name
        artifacts = (path.parent.resolve() / "artifacts").as_uri()
        SqlAlchemyStore(f"sqlite:///{new}", artifacts).engine.dispose()
        os.replace(new, path)


def log_folder(client: MlflowClient, experiment_id: str, folder: Path) -> str:
    """Logs the results in a folder as one finished run; returns its id."""
    results = load_results(folder)
    for run in client.search_runs(
        [experiment_id], f"tags.`{RESULT_TAG}` = '{results.id}'", max_results=10
    ):
        if run.info.status == "FINISHED":
            return str(run.info.run_id)
        client.delete_run(run.info.run_id)  # a sender died half-way
    tags = {RESULT_TAG: results.id, **source_tags(results.git), **process_tag()}
    start = int(1000 * results.started)
    run_id = str(client.create_run(experiment_id, start, tags, results.name).info.run_id)
    fill(client, run_id, folder, results)
    return run_id


def source_tags(git: Mapping[str, str]) -> dict[str, str]:
    """Tags that tell who ran what; the client sets none of these by itself."""
    tags = {
        "mlflow.user": _user(),
        "mlflow.source.name": "python -m xplain",
        "mlflow.source.type": "LOCAL",
    }
    if git:
        tags |= {"mlflow.source.git.commit": git["commit"], "git.dirty": git["dirty"]}
    return tags


def process_tag() -> dict[str, str]:
    """Which process keeps a run; :func:`retire` ends the runs of processes that died."""
    return {PROCESS_TAG: f"{socket.gethostname()} {os.getpid()} {_birth(os.getpid())}"}


def retire(client: MlflowClient, experiment_id: str) -> int:
    """Marks the running runs of this host's dead processes as killed; returns how many."""
    killed = 0
    for run in all_runs(client, experiment_id, "attributes.status = 'RUNNING'"):
        host, pid, birth = [*run.data.tags.get(PROCESS_TAG, "").split(" "), "", "", ""][:3]
        if host == socket.gethostname() and pid.isdigit() and _birth(int(pid)) != birth:
            client.set_terminated(run.info.run_id, "KILLED")
            killed += 1
    return killed


def all_runs(client: MlflowClient, experiment_id: str, condition: str) -> Iterator[Any]:
    """Every run of a search, page after page."""
    token = None
    while True:
        page = client.search_runs([experiment_id], condition, max_results=500, page_token=token)
        yield from page
        token = page.token
        if not token:
            return


def _birth(pid: int) -> str:
    """When a process began, so that its number used again is not taken for it; "" if it is
    gone, "0" where the system does not tell."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
        state, birth = after_name.split()[0], after_name.split()[19]
        return "" if state == "Z" else birth
    except OSError:
        pass
    if Path("/proc/self/stat").exists():
        return ""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return ""
    except OSError:
        pass
    return "0"


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "unknown"


def _refuse_unusable(uri: str, patience: float = 10) -> None:
    """Raises within seconds, where MLflow would retry for long, when a server does not answer or
    another process holds the database."""
    if uri.startswith(("http://", "https://")):
        try:
            urllib.request.urlopen(uri.rstrip("/") + "/health", timeout=5).close()
        except urllib.error.HTTPError:
            pass  # it answers; some proxies have no such page
        except (urllib.error.URLError, TimeoutError) as error:
            reason = getattr(error, "reason", error)
            raise OSError(f"{uri} is out of reach: {reason}") from error
    elif uri.startswith("sqlite:///") and Path(uri.removeprefix("sqlite:///")).exists():
        connection = sqlite3.connect(
            uri.removeprefix("sqlite:///"), timeout=patience, isolation_level=None
        )
        with contextlib.closing(connection):
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("ROLLBACK")
