"""What a job of a sweep costs beyond its method, on a worker that has run another one before.

    python benchmarks/job.py             CPU seconds a job, stage by stage; means of 8 jobs
    python benchmarks/job.py --quick     of 2 jobs

The jobs differ in λ, so data, types and labelers come from the cache.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hydra import compose, initialize_config_dir

from xplain.experiment.config import CONF, register
from xplain.experiment.experiment import Experiment
from xplain.runs.job import Job
from xplain.runs.sweep import run_in_sweep

MOST = 0.3
"""CPU seconds that a job should cost beyond its method, at most."""


def main() -> None:
    """Prints a table."""
    jobs = 2 if "--quick" in sys.argv[1:] else 8
    spent: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        began = time.process_time()
        yield
        spent[name] += time.process_time() - began

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*given: Any) -> Any:
            with stage(name):
                return function(*given)

        return call

    def run(trade_off: float, outputs: Path) -> None:
        keys = (f"lambda={trade_off}", f"outputs='{outputs}'", "solver=qmdp")
        with stage("all of it"):
            with stage("configuration"):
                cfg = compose("config", [*keys], return_hydra_config=True)
                job = Job.of(cfg, cfg.hydra.runtime.choices)
            with stage("fingerprints"):
                expected, _ = job.fingerprint, job.source
            run_in_sweep(job, outputs / "jobs" / expected, expected)
        assert (job.address / "results.json").exists()

    prepared, explained = Experiment.prepared, Experiment.explained
    with (
        tempfile.TemporaryDirectory() as folder,
        initialize_config_dir(str(CONF), version_base="1.3"),  # as a launcher, once for all jobs
        patch.object(Experiment, "prepared", timed("data, types and labelers", prepared)),
        patch.object(Experiment, "explained", timed("the method", explained)),
    ):
        register()
        run(0.75, Path(folder))
        spent.clear()
        for index in range(jobs):
            run(1 + index / 8, Path(folder))
    means = {name: seconds / jobs for name, seconds in spent.items()}
    whole, method = means.pop("all of it"), means["the method"]
    means["results, written"] = whole - sum(means.values())
    for name, seconds in means.items():
        print(f"{name:26}{seconds:7.3f}")
    print(f"{'beyond the method':26}{whole - method:7.3f}   (goal: at most {MOST})")


if __name__ == "__main__":
    main()
