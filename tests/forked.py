"""Commands in processes with everything imported already, for tests of a command's effects.

These processes draw no pictures. Properties of a process (signals, death, the places of modules)
are tested in processes that start as a user starts them.
"""

import logging
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import IO, Any

_PROCESSES = multiprocessing.get_context("forkserver")
_PROCESSES.set_forkserver_preload(
    [
        "xplain.cli.main",
        "xplain.runs.command",
        "xplain.runs.job",
        "xplain.runs.mlflow",
        "xplain.runs.sweep",
        "xplain.report.plots",
        "xplain.report.page",
        "mlflow.store.tracking.sqlalchemy_store",
        "alembic.command",
        "sqlalchemy.dialects.sqlite",
        "hydra._internal.core_plugins.basic_launcher",
        "hydra_plugins.xplain_sweeper",
        "pandas.io.formats.style",
        "pyarrow.pandas_compat",
        "sklearn.tree",
        "matplotlib.backends.backend_agg",
        "tests.frozen",
    ]
)
_SECONDS = 900
OUTPUT = "output.txt"
_WRITTEN = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def captured(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs ``xplain …``, or ``python script.py``, in this folder, with separate standard output and
    standard error.

    Raises:
        TimeoutError: the command has not ended by itself; it is then killed.
    """
    with tempfile.TemporaryDirectory() as own:
        out, error = Path(own, "out"), Path(own, "error")
        process = _start(folder, arguments, out, error)
        code, said = _wait(process, out)
        return subprocess.CompletedProcess(arguments, code, said, error.read_text())


def start(folder: Path, *arguments: str, output: str = OUTPUT) -> BaseProcess:
    """Starts ``xplain …`` in this folder, or ``python script.py``, for :func:`wait`."""
    folder.mkdir(parents=True, exist_ok=True)
    return _start(folder, arguments, folder / output, folder / output)


def _start(folder: Path, arguments: tuple[str, ...], out: Path, error: Path) -> BaseProcess:
    process = _PROCESSES.Process(target=_main, args=(folder, arguments, out, error))
    process.start()
    return process


def wait(folder: Path, process: BaseProcess) -> tuple[int, str]:
    """Waits until the process ends by itself; returns exit code and all output.

    Raises:
        TimeoutError: the process has not ended; it is then killed.
    """
    return _wait(process, folder / OUTPUT)


def _wait(process: BaseProcess, output: Path) -> tuple[int, str]:
    process.join(_SECONDS)
    if process.exitcode is None:
        process.kill()
        raise TimeoutError(output.read_text())
    return process.exitcode, output.read_text()


def leave_out_pictures(patch: Any = setattr) -> None:
    """Saves figures as files without content, because drawing takes most of the time of a small
    run."""
    from matplotlib.figure import Figure

    def save(figure: Figure, file: str | Path | IO[bytes], **_: object) -> None:
        if isinstance(file, str | Path):
            Path(file).touch()

    patch(Figure, "savefig", save)


def make_store(path: Path) -> None:
    """Makes an SQLite database with MLflow's empty tables, which takes four seconds."""
    process = _PROCESSES.Process(target=_make_store, args=(path,))
    process.start()
    process.join(_SECONDS)
    assert process.exitcode == 0


def _make_store(path: Path) -> None:
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    logging.getLogger("alembic").setLevel(logging.ERROR)
    SqlAlchemyStore(f"sqlite:///{path}", path.with_suffix(".artifacts").as_uri()).engine.dispose()


def _main(folder: Path, arguments: tuple[str, ...], out: Path, error: Path) -> None:
    os.chdir(folder)
    sys.path.insert(0, str(folder))  # as ``python -m`` does
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    os.environ["MLFLOW_HTTP_REQUEST_MAX_RETRIES"] = "0"  # a server that is away is asked once
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for path, there in ((out, 1), (error, 2)):
        os.dup2(os.open(path, _WRITTEN, 0o666), there)
    from xplain.cli.main import main

    leave_out_pictures()
    try:
        if arguments[0].endswith(".py"):
            sys.argv = [*arguments]
            runpy.run_path(arguments[0], run_name="__main__")
        else:
            sys.argv = ["xplain", *arguments]
            main()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
