"""Where results go besides the disk: nowhere, or to MLflow.

Both are told of folders on disk, so what was missed can be sent later as well. MLflow is imported
when it is used: it takes a second.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sqlite3
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from xplain.errors import first_line
from xplain.report.summary import SWEEP
from xplain.runs.folder import SweepFolder
from xplain.runs.mlflow_run import RunStore, send_run
from xplain.runs.mlflow_sweep import SweepRuns
from xplain.runs.mlflow_views import describe_experiment
from xplain.runs.plan import Job

log = logging.getLogger(__name__)


class Disk:
    """Hears of results that are on disk, and leaves them there; subclasses send them elsewhere. It
    never raises: they are safe."""

    def log(self, folder: Path, outputs: Path) -> list[str]:
        """A run or a sweep ended.

        Args:
            folder: of the run or sweep.
            outputs: the outputs folder.

        Returns:
            Lines for the terminal: where to look.
        """
        return []

    def follow(self, folder: Path, outputs: Path) -> Callable[[Job], None]:
        """What hears of each job that ends while a sweep runs; called from one thread."""
        return lambda job: None


@dataclass(frozen=True)
class MLflow(Disk):
    """Logs each run as one MLflow run, each sweep as a parent with a child a job.

    Attributes:
        uri: of the tracking server or database; None is an SQLite file in the outputs folder.
        experiment: name of the MLflow experiment.
    """

    uri: str | None = None
    experiment: str = "xplain"

    def tracking_uri(self, outputs: Path) -> str:
        """URI of the server or database to which runs are sent."""
        return self.uri or f"sqlite:///{outputs.resolve() / 'mlflow.db'}"

    def how_to_open(self, outputs: Path) -> str | None:
        """The command without which the links lead nowhere; None where a server runs already."""
        uri = self.tracking_uri(outputs)
        if uri.startswith("http"):
            return None
        if outputs.resolve() == Path.cwd() / "outputs" and self.uri is None:
            uri = "sqlite:///outputs/mlflow.db"
        return f"mlflow ui --backend-store-uri {uri}"

    def store(self, outputs: Path) -> RunStore:
        """The server or database with its experiment, which is made where it is missing; pages of
        an SQLite file are shown on this machine.

        Raises:
            OSError, sqlite3.Error, MlflowException: it cannot be reached.
        """
        uri = self.tracking_uri(outputs)
        pages = uri.rstrip("/") if uri.startswith("http") else "http://127.0.0.1:5000"
        refuse_unusable(uri)
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
        location = None if uri.startswith("http") else (outputs.resolve() / "artifacts").as_uri()
        # Two processes that create the database at once break it for good.
        with FileLock(outputs / "mlflow.lock"):
            _create_whole(uri)
            client = MlflowClient(tracking_uri=uri)
            if client.get_experiment_by_name(self.experiment) is None:
                # Another machine may be faster; the lock covers this one only.
                with contextlib.suppress(MlflowException):
                    client.create_experiment(self.experiment, location)
            found = client.get_experiment_by_name(self.experiment)
        if found is None:
            raise OSError(f"the experiment {self.experiment} can be neither found nor made")
        return RunStore(client, found.experiment_id, f"{pages}/#")

    def send(self, folder: Path, outputs: Path) -> list[str]:
        """Brings MLflow to the state of a run's or sweep's folder; sent twice, it changes nothing.

        Returns:
            Lines for the terminal: where to look.

        Raises:
            OSError, sqlite3.Error, MlflowException: the store cannot take it.
        """
        store = self.store(outputs)
        if (folder / SWEEP).exists():
            lines = SweepRuns(store, SweepFolder(folder)).finish()
        else:
            run_id = send_run(store, folder)
            describe_experiment(store.client, store.experiment)
            lines = [f"MLflow: {store.pages}/experiments/{store.experiment}/runs/{run_id}"]
        command = self.how_to_open(outputs)
        return lines if command is None else [*lines, f"  once this runs: {command}"]

    def log(self, folder: Path, outputs: Path) -> list[str]:
        """As :meth:`send`; a failure costs a warning that tells how to send it later."""
        try:
            return self.send(folder, outputs)
        except Exception as error:  # MLflow raises what SQLAlchemy, requests, the OS do
            log.warning(
                "MLflow did not take this (%s). The results are safe in %s; send them later "
                "with: python -m xplain sync %s",
                first_line(error)[:200],
                folder,
                folder,
            )
            log.debug("MLflow failed", exc_info=True)
            return []

    def follow(self, folder: Path, outputs: Path) -> Callable[[Job], None]:
        """Sends each job when it ends, until MLflow does not take one: :meth:`log` tries again."""
        runs: SweepRuns | None = None
        works = True

        def ended(job: Job) -> None:
            nonlocal runs, works
            try:
                if works:
                    runs = runs or SweepRuns(self.store(outputs), SweepFolder(folder))
                    runs.send(job)
            except Exception:
                log.debug("MLflow failed", exc_info=True)
                works = False

        return ended


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


def refuse_unusable(uri: str, patience: float = 10) -> None:
    """Raises within seconds, where MLflow would retry for long, when a server does not answer or
    another process holds the database.

    Raises:
        OSError, sqlite3.Error: it is so.
    """
    if uri.startswith(("http://", "https://")):
        try:
            urllib.request.urlopen(uri.rstrip("/") + "/health", timeout=5).close()
        except urllib.error.HTTPError:
            pass  # it answers; some proxies have no such page
        except (urllib.error.URLError, TimeoutError) as error:
            reason = getattr(error, "reason", error)
            raise OSError(f"{uri} is out of reach: {reason}") from error
    elif uri.startswith("sqlite:///") and Path(uri.removeprefix("sqlite:///")).exists():
        path = uri.removeprefix("sqlite:///")
        with contextlib.closing(
            sqlite3.connect(path, timeout=patience, isolation_level=None)
        ) as connection:
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("ROLLBACK")
