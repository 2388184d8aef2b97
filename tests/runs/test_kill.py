"""After kill -9 at random moments of any process, the same command completes the sweep."""

import os
import random
import time
from pathlib import Path

from tests import processes
from tests.runs import sweeps

KILLS = int(os.environ.get("XPLAIN_KILLS", "1"))
"""Number of sweeps that are killed; XPLAIN_KILLS=20 takes ten minutes."""


def disturb(folder: Path, whom: str, moment: float) -> None:
    """Starts the sweep and kills the main process, one worker, or all of them."""
    process = sweeps.start(folder, *sweeps.TINY)
    deadline = time.monotonic() + moment
    if whom == "worker":
        while not sweeps.workers(process) and process.poll() is None:
            time.sleep(0.05)
        deadline = time.monotonic() + moment / 3
    while time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    if whom == "all":
        processes.kill(process)
        process.wait()
    elif whom == "main":
        # Its workers live on for a moment, and may end jobs while the rerun begins.
        process.kill()
        process.wait()
    else:
        for worker in sweeps.workers(process)[:1]:
            sweeps.kill(worker)
        code, output = sweeps.wait(folder, process)
        assert code in (0, 1), output


def check(folder: Path, undisturbed: Path) -> None:
    assert sweeps.tables(folder) == sweeps.tables(undisturbed)
    with sweeps.database(folder) as database:
        assert database.execute("pragma integrity_check").fetchone() == ("ok",)
    # One parent, one child a job: none doubled, none lost, all closed.
    assert sorted((n, s, p is None) for n, s, p in sweeps.runs(folder)) == sorted(
        (n, s, p is None) for n, s, p in sweeps.runs(undisturbed)
    )
    assert {status for _, status, _ in sweeps.runs(folder)} == {"FINISHED"}


def rounds(count: int, seed: int) -> list[tuple[str, float]]:
    """Lists (process, share of the undisturbed time), in turn for the main process alone, with all
    of its workers, and for a worker; the seed decides which is first."""
    rng = random.Random(seed)
    whom = rng.sample(("main", "all", "worker"), 3)
    return [(whom[i % 3], rng.uniform(0.1, 0.95)) for i in range(count)]


def test_a_sweep_that_was_killed_completes(tmp_path, finished):
    seed = time.time_ns()
    print(f"seed {seed}")  # the output of a failed test has it
    for index, (whom, share) in enumerate(rounds(KILLS, seed)):
        folder = tmp_path / f"{index}-{whom}"
        disturb(folder, whom, share * finished.seconds)
        sweeps.output_of(folder, *sweeps.TINY, sweeps.SERIAL)
        check(folder, finished.folder)
