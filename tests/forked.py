"""Commands in processes that have imported everything before: for tests of what a command does.

What is a process's own (signals, death, where Python finds its modules) is tested in processes
that are started as a user starts them.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path

_PROCESSES = multiprocessing.get_context("forkserver")
_PROCESSES.set_forkserver_preload(
    [
        "xplain.cli.main",
        "xplain.cli.run",
        "xplain.runs.job",
        "xplain.runs.sweep",
        "mlflow.store.tracking.sqlalchemy_store",
        "alembic.command",
        "sklearn.tree",
        "matplotlib.backends.backend_agg",
    ]
)
_SECONDS = 300


def run(folder: Path, *arguments: str) -> tuple[int, str]:
    """``xplain …`` in this folder: exit code and all output.

    Raises:
        TimeoutError: it has not ended by itself; then it is killed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    output = folder / "output.txt"
    process = _PROCESSES.Process(target=_main, args=(folder, output, arguments))
    process.start()
    process.join(_SECONDS)
    if process.exitcode is None:
        process.kill()
        raise TimeoutError(" ".join(arguments))
    return process.exitcode, output.read_text()


def _main(folder: Path, output: Path, arguments: tuple[str, ...]) -> None:
    os.chdir(folder)
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for here, there in ((nothing, 0), (file, 1), (file, 2)):
        os.dup2(here, there)
    from xplain.cli.main import main

    try:
        main(list(arguments))
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
