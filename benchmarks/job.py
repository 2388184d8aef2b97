"""Measures the time of a sweep's job beyond its method, on a worker that ran another job before.

    python benchmarks/job.py             CPU seconds per job, by stage; means of 8 jobs
    python benchmarks/job.py --quick     means of 2 jobs

The jobs differ in λ, so data, types and labelers come from the cache. Planning is done once for the
sweep. A worker begins a batch by composing Hydra's configuration. In a sweep of many jobs a batch
has several jobs (on two cores from 8 jobs on), so a job's share is smaller.
"""

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
from omegaconf import DictConfig

from xplain.experiment.config import CONF, register
from xplain.experiment.experiment import Experiment
from xplain.runs.job import run_batch, save_batch
from xplain.runs.plan import Plan, parse

MOST = 0.3
"""The maximum of CPU seconds that a job should cost beyond its method."""


def main() -> None:
    """Prints a table."""
    quick = "--quick" in sys.argv[1:]
    jobs, small = (2, ["traces=1", "points=20", "max_steps=4"]) if quick else (8, [])
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

    def run(trade_offs: list[float], outputs: Path) -> None:
        words = [f"lambda={','.join(map(str, trade_offs))}", "solver=qmdp", *small]
        with stage("plan of the sweep"):
            config = load([f"outputs='{outputs}'"])
            plan = Plan.of(config, parse(words), lambda own: load([f"outputs='{outputs}'", *own]))
            batches = plan.batches()
        (outputs / "batches").mkdir(exist_ok=True)
        for number, batch in enumerate(batches):
            save_batch(path := outputs / "batches" / f"{number}.json", batch)
            with stage("start of a batch"):
                compose("batch", ["batch=0"], return_hydra_config=True)
            with stage("all of it"):
                run_batch(path)
            assert all((job.address / "results.json").exists() for job in batch)

    def load(words: list[str]) -> DictConfig:
        return compose("config", words, return_hydra_config=True)

    prepare, explain = Experiment.prepare, Experiment.explain_cases
    with (
        tempfile.TemporaryDirectory() as folder,
        initialize_config_dir(str(CONF), version_base="1.3"),  # once for all jobs, as in a launcher
        patch.object(Experiment, "prepare", timed("data, types and labelers", prepare)),
        patch.object(Experiment, "explain_cases", timed("the method", explain)),
    ):
        register()
        run([0.75], Path(folder))
        spent.clear()
        run([1 + index / 8 for index in range(jobs)], Path(folder))
    means = {name: seconds / jobs for name, seconds in spent.items()}
    method, known = means["the method"], means["data, types and labelers"]
    means["fingerprint, components, results"] = means.pop("all of it") - method - known
    for name, seconds in means.items():
        print(f"{name:34}{seconds:7.3f}")
    beyond = sum(means.values()) - method
    print(f"{'beyond the method':34}{beyond:7.3f}   (goal: at most {MOST})")


if __name__ == "__main__":
    main()
