"""Sweeps from the command line with failing jobs, dying workers, and interruptions."""

import contextlib
import os
import re
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests import forked
from tests.runs import sweeps
from xplain.experiment.results import load_results
from xplain.runs.folder import Disk
from xplain.runs.sweep import finish

RESULT = "outputs/results/*/results.json"


def test_a_worker_that_dies_ends_the_sweep_with_a_line_and_its_report(tmp_path):
    sweeps.with_solver(tmp_path, "own.Dies")
    output = sweeps.output_of(
        tmp_path,
        "--config-dir=choices",
        *sweeps.TINY[:-2],
        "solver=mine,qmdp,qhr",  # the third job waits when the first kills its worker
        "lambda=1",
        "hydra.launcher.n_jobs=2",
        "tracking=none",
        code=1,
    )
    assert "the launcher failed (" in output
    assert "the same command runs the other jobs" in output
    assert "report: " in output
    assert "Traceback" not in output


def test_ctrl_c_leaves_no_run_open(folder):
    process = sweeps.start(folder, *sweeps.TINY[:-1], "lambda=range(0,8)", sweeps.SERIAL)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if [*folder.glob(RESULT)]:
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    code, output = sweeps.wait(folder, process)
    assert code == 130, output
    states = {name: status for name, status, _ in sweeps.runs(folder)}
    assert {s for name, s in states.items() if name.startswith("multirun")} == {"KILLED"}
    assert set(states.values()) <= {"FINISHED", "KILLED"}
    # If the signal arrives in a callback of Python's own, Python reports it.
    own = re.sub(r"Exception ignored in: .*?KeyboardInterrupt: ?\n", "", output, flags=re.DOTALL)
    assert "Traceback" not in own
    last = output.strip().splitlines()[-1]
    assert re.fullmatch(
        r"xplain: interrupted: \d+ of 16 jobs are finished; the same command runs the other jobs",
        last,
    )


def test_four_at_once_on_an_empty_folder(tmp_path, finished):
    """The four processes are two of one sweep, a sweep that shares a job with it, and a single
    run."""
    other = (*sweeps.QUICK[:-3], "solver=qhr,silent", *sweeps.QUICK[-2:])
    commands = [sweeps.QUICK, sweeps.QUICK, other, (*sweeps.SINGLE, "seed=2")]
    started = {
        own: forked.start(own, *arguments, f"outputs={tmp_path / 'outputs'}")
        for own, arguments in zip(map(tmp_path.joinpath, "0123"), commands, strict=True)
    }
    for own, process in started.items():
        code, output = forked.wait(own, process)
        assert code == 0, output
        assert "MLflow d" not in output  # it did take everything
    found = sweeps.runs(tmp_path)
    assert {status for _, status, _ in found} == {"FINISHED"}
    assert len(found) == (1 + 2) + (1 + 2) + 1
    made, alone = (
        {path.parent.name: load_results(path.parent).episodes for path in folder.glob(RESULT)}
        for folder in (tmp_path, finished.folder)
    )
    shared = made.keys() & alone.keys()
    assert (len(made), len(shared)) == (4, 2)
    assert {name: made[name] for name in shared} == {name: alone[name] for name in shared}


def test_a_sweep_that_two_processes_end_is_sent_by_one_at_a_time(tmp_path):
    """MLflow has no unique keys: two senders would both find a job missing, and send it twice."""
    folder, inside, most = sweeps.planned(tmp_path, 1), [], []

    class Slow(Disk):
        def log(self, folder, outputs):
            inside.append(folder)
            most.append(len(inside))
            time.sleep(0.3)
            inside.pop()
            return []

    with ThreadPoolExecutor(2) as pool:
        for _ in range(2):
            pool.submit(finish, folder, Slow(), tmp_path, 0.0, [].append, shown=False)
    assert most == [1, 1]


@pytest.mark.parametrize("importing", ["main", "workers"])
def test_ctrl_c_in_the_first_seconds_is_no_traceback(tmp_path, importing):
    """This holds from the first loaded modules on. The terminal also sends the signal to workers
    that import."""
    process = sweeps.start(tmp_path, *sweeps.TINY)

    loaded = ""
    while process.poll() is None and "numpy" not in loaded:
        time.sleep(0.02)
        for pid in [process.pid] if importing == "main" else sweeps.workers(process):
            with contextlib.suppress(OSError):  # it ended
                loaded = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
    _, output = sweeps.wait(tmp_path, process)
    assert "Traceback" not in output
