"""Compares the processor time of the first run and of later runs with a bare script.

    python benchmarks/first_minutes.py [--quick]

The bare script does what any experiment does: it imports scikit-learn and MLflow and logs a run
into an existing SQLite store. It alternates with later runs, so that a machine with a varying speed
favours neither. Each later run has another seed: a run with the same seed only reads the result.
The table has user + system seconds of whole processes with their children, and the imports that
take most time. The first run finds no compiled kernels (with ``--quick`` the kernels of other
runs). Goals: a first run takes at most 5 times the seconds of the bare script, a later run at most
1.5 times.
"""

import os
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

RUN = ["-m", "xplain", "solver=pomcp", "domain=rescue", "lambda=1.5"]
SHORT = ["traces=1", "max_steps=3", "points=20", "labeler=tree", "tracking=none"]
BARE = """
import mlflow
from sklearn.tree import DecisionTreeClassifier

mlflow.set_tracking_uri("sqlite:///bare.db")
mlflow.set_experiment("bare")
with mlflow.start_run():
    mlflow.log_params({"solver": "none", "seed": 0})
    mlflow.log_metrics({"cost": 1.0, "regret": 0.5})
"""


def main() -> None:
    """Prints the table."""
    quick = "--quick" in sys.argv[1:]
    rounds = 0 if quick else 3
    run = [*RUN, *SHORT] if quick else RUN
    with tempfile.TemporaryDirectory() as folder:
        kernels = {} if quick else {"NUMBA_CACHE_DIR": str(Path(folder) / "kernels")}
        made = seconds(["-c", BARE], folder, {})  # makes the store
        # A smoke run measures nothing twice: its only run is the one that shows its imports.
        first = made if quick else seconds(run, folder, kernels)
        bare, warm = ([made], [first]) if quick else ([], [])
        for seed in range(1, rounds + 1):
            warm.append(seconds([*run, f"seed={seed}"], folder, kernels))
            bare.append(seconds(["-c", BARE], folder, {}))
        imported = imports(run, folder, kernels)
    ratios = [one / other for one, other in zip(warm, bare, strict=True)]
    print(f"user + system seconds, {rounds} later runs in turn with the bare script, median\n")
    print(f"bare script   {median(bare):6.1f}")
    print(f"first run     {first:6.1f}   {first / median(bare):.1f} times the bare script")
    print(f"later run     {median(warm):6.1f}   {median(ratios):.1f} times")
    print("\nimports of a later run: wall seconds in modules of each package")
    for name, spent in imported.items():
        print(f"{name:12}  {spent:6.2f}")


def seconds(arguments: list[str], folder: str, environment: dict[str, str]) -> float:
    """Measures the user + system seconds of a process of Python and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)} | environment,
        check=True,
        capture_output=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def imports(run: list[str], folder: str, environment: dict[str, str]) -> dict[str, float]:
    """Measures the wall seconds of imports by top-level package, the slowest first."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", *run],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)} | environment,
        check=True,
        capture_output=True,
        text=True,
    )
    spent: dict[str, float] = {}
    for own, name in re.findall(r"import time:\s+(\d+) \|\s+\d+ \|\s+([\w.]+)", done.stderr):
        package = name.split(".")[0]
        spent[package] = spent.get(package, 0.0) + int(own) / 1e6
    slowest = sorted(spent, key=lambda package: -spent[package])[:12]
    return {package: spent[package] for package in slowest}


if __name__ == "__main__":
    main()
