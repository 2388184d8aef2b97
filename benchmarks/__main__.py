"""Smoke runs of all benchmarks on all cores: ``python benchmarks --quick`` (``make bench-quick``).

Imports would take most of the time of a smoke run, so each run is forked from a process that has
imported everything.
"""

import multiprocessing
import os
import runpy
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

PROCESSES = multiprocessing.get_context("forkserver")
LONGEST = ("study_defaults", "first_minutes", "again")
"""These are first: none is left to one core at the end."""


def main() -> None:
    """Runs each file as ``python FILE`` would, with the arguments of this command.

    Raises:
        SystemExit: a run failed.
    """
    PROCESSES.set_forkserver_preload(
        ["xplain.runs.sweep", "xplain.runs.job", "xplain.people.web", "xplain.report.plots"]
    )
    files = sorted(
        Path(__file__).parent.glob("[a-z]*.py"),
        key=lambda file: (file.stem not in LONGEST, file.name),
    )
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        codes = pool.map(run, files)
        failed = [file.name for file, code in zip(files, codes, strict=True) if code]
    sys.exit(f"failed: {', '.join(failed)}" if failed else 0)


def run(file: Path) -> int | None:
    """Returns the exit code."""
    print(file.name, flush=True)
    process = PROCESSES.Process(
        target=runpy.run_path, args=(str(file),), kwargs={"run_name": "__main__"}
    )
    process.start()
    process.join()
    return process.exitcode


if __name__ == "__main__":
    main()
