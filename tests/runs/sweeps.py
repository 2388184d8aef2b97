"""Sweeps that the tests start: tiny, in separate folders and process groups."""

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

from tests import forked, processes
from xplain.report.folder import ListedJob, SweepFolder
from xplain.runs.plan import label_jobs
from xplain.runs.sweep import save_sweep

ROOT = Path(__file__).parents[2]

SERIAL = "hydra/launcher=basic"
"""All jobs in the sweep's own process."""

IN_TURN = "hydra.launcher.n_jobs=1"
"""The default launcher with one job at a time, which needs no workers either."""

TINY = (
    "-m",
    "domain=four_rooms",
    "users.count=2",
    "traces=1",
    "max_steps=5",
    "certify.traces=0",
    "points=20",
    "labeler=tree",
    "clusterer=perfect",
    "solver=qmdp,qhr",
    "lambda=0.5,1",
)
"""Four jobs of less than a second; their results do not matter."""

QUICK = (*TINY[:-1], "lambda=1", SERIAL)
"""Two jobs in one process."""

SINGLE = (*(word for word in QUICK[1:-1] if word != "solver=qmdp,qhr"), "solver=qhr")
"""One of them, as a single run."""


def planned(outputs: Path, jobs: int) -> SweepFolder:
    """Makes the folder of a sweep with this number of jobs, none of which has begun."""
    rows = [ListedJob("", (f"seed={i}",), {"seed": str(i)}, f"f{i}") for i in range(jobs)]
    folder = SweepFolder(outputs / "sweeps" / "tiny-1")
    folder.path.mkdir(parents=True)
    about = {"name": "tiny", "command": "python -m xplain sweeps=tiny"}
    save_sweep(folder.path, label_jobs(rows), outputs, about)
    return folder


def environment() -> dict[str, str]:
    """Returns the environment of a new shell, without a tracking server."""
    paths = [str(ROOT), ".", os.environ.get("PYTHONPATH", "")]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    env.pop("MLFLOW_TRACKING_URI", None)
    return env


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """Starts ``python -m xplain …`` in this folder, as the leader of a process group."""
    folder.mkdir(parents=True, exist_ok=True)
    # A file, not a pipe: nobody waits for orphans that hold it open.
    with (folder / "output.txt").open("w") as output:
        return processes.start(
            [sys.executable, "-m", "xplain", *arguments],
            cwd=folder,
            env=environment(),
            stdout=output,
            stderr=subprocess.STDOUT,
        )


def run(folder: Path, *arguments: str) -> tuple[int, str]:
    """Runs ``xplain …``, flags before keys; returns exit code and all output. A new process starts
    only if the jobs need workers."""
    words = sorted(arguments, key=lambda word: not word.startswith("-"))
    if "-m" not in words or {SERIAL, IN_TURN} & {*words}:
        return forked.wait(folder, forked.start(folder, *words))
    return wait(folder, start(folder, *words))


def output_of(folder: Path, *arguments: str, code: int = 0) -> str:
    """Runs ``xplain …``, which must end with this exit code; returns all output."""
    found, output = run(folder, *arguments)
    assert found == code, output
    return output


SOLVERS = '''
import os
import signal
import sys
from dataclasses import dataclass

from xplain.solvers.simple import Silent


@dataclass(frozen=True)
class Frugal(Silent):
    """Needs no tables, and allows none."""

    memory_gib: float = 1e-9


@dataclass(frozen=True)
class Refuses:
    """A solver that cannot plan."""

    knows: str = "types"

    def plan(self, problem, seed=0):
        raise RuntimeError("the licence server said no")


@dataclass(frozen=True)
class Exits(Refuses):
    def plan(self, problem, seed=0):
        sys.exit(0)


@dataclass(frozen=True)
class Dies(Refuses):
    def plan(self, problem, seed=0):
        os._exit(9)


class Unknowing:
    def plan(self, problem, seed=0):
        return None
'''


def with_solver(folder: Path, target: str, name: str = "mine") -> None:
    """Writes ``solver=mine`` of this class for ``--config-dir=choices``, and the module own.py,
    into the folder."""
    choices = folder / "choices" / "solver"
    choices.mkdir(parents=True, exist_ok=True)
    (choices / f"{name}.yaml").write_text(f"_target_: {target}\n")
    (folder / "own.py").write_text(SOLVERS)


def wait(folder: Path, process: subprocess.Popen[str]) -> tuple[int, str]:
    """Waits until the process ends by itself; returns exit code and all output."""
    try:
        process.wait(timeout=300)
    except subprocess.TimeoutExpired:
        processes.kill(process)
        raise
    return process.returncode, (folder / "output.txt").read_text()


def workers(process: subprocess.Popen[str]) -> list[int]:
    """Lists the other processes of the group that run jobs."""
    others = processes.group_of(process.pid).items()
    return sorted(pid for pid, command in others if "popen_loky" in command)


def kill(pid: int) -> None:
    """Kills the process with -9, even if it has ended."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def sweep_folder(folder: Path) -> Path:
    """Returns the only sweep below this folder's outputs."""
    (found,) = (folder / "outputs" / "sweeps").iterdir()
    return found


def tables(folder: Path) -> dict[str, bytes]:
    """Reads the final tables as bytes."""
    report = sweep_folder(folder) / "report"
    names = ("table.md", "table.tex", "regret.csv", "differences.csv")
    return {name: (report / name).read_bytes() for name in names}


def database(folder: Path) -> contextlib.closing[sqlite3.Connection]:
    """Opens MLflow's database, read-only."""
    path = folder / "outputs" / "mlflow.db"
    return contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True))


def runs(folder: Path) -> list[tuple[str, str, str | None]]:
    """Lists (name, status, parent) of the runs that are not deleted."""
    with database(folder) as db:
        return db.execute(
            "select runs.name, runs.status, parent.value from runs left join tags as parent "
            "on parent.run_uuid = runs.run_uuid and parent.key = 'mlflow.parentRunId' "
            "where runs.lifecycle_stage = 'active' order by runs.name"
        ).fetchall()
