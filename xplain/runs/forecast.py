"""``dry_run=true``: which jobs there are, which are done already, and how long the rest takes."""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from xplain.experiment.fingerprint import fingerprint
from xplain.experiment.from_config import check
from xplain.experiment.results import load_results
from xplain.runs.plan import Plan
from xplain.runs.progress import duration
from xplain.runs.reuse import Todo, finished_below, finished_elsewhere

Experience = tuple[str, str, float]
"""How long a finished job took: the class of its domain, its solver with all its settings (ten
times the simulations are another solver), seconds a trace."""


def experience(config: Mapping[str, Any], seconds: float) -> Experience:
    """Of a job with this resolved configuration, which took so long."""
    solver = json.dumps(config["solver"], sort_keys=True)
    return str(config["domain"]["_target_"]), solver, seconds / int(config["traces"])


def experiences(outputs: Path) -> list[Experience]:
    """Of every finished job below the outputs folder."""
    found = []
    for _, folder in finished_below(outputs):
        with suppress(OSError, ValueError):
            results = load_results(folder)
            found.append(experience(results.config, sum(results.seconds.values())))
    return found


def expected_seconds(known: Sequence[Experience], config: Mapping[str, Any]) -> float | None:
    """Median of the jobs most like this one, a trace, times its traces; None where none had its
    solver."""
    domain, solver, _ = experience(config, 0.0)
    same = [(other, seconds) for other, of, seconds in known if of == solver]
    alike = [seconds for other, seconds in same if other == domain] or [own for _, own in same]
    return int(config["traces"]) * statistics.median(alike) if alike else None


def print_dry_run(
    plan: Plan,
    todo: Todo,
    outputs: Path,
    config: DictConfig,
    configurations: Mapping[str, Mapping[str, Any]],
) -> None:
    """The jobs, those already done, and the time to expect, on standard output.

    Args:
        plan, todo, outputs: of the sweep.
        config: as composed for the whole sweep; its launcher says how many workers there are.
        configurations: of each job, by fingerprint.
    """
    done = {*todo.finished, *todo.copied}
    for job in plan.jobs:
        if job.fingerprint not in {*done, *todo.run}:
            continue  # resume=failed leaves it
        source = todo.copied.get(job.fingerprint)
        at = f"  ({os.path.relpath(source)})" if source else ""
        print(f"{'done' if job.fingerprint in done else 'to run':8}{job.label}{at}")
    print(
        f"{len(plan.jobs)} jobs: {len(todo.finished)} done, {len(todo.copied)} done elsewhere (to "
        f"be copied), {len(todo.run)} to run"
    )
    if todo.run:
        known = experiences(outputs)
        expected = [expected_seconds(known, configurations[key]) for key in todo.run]
        print(_time(expected, _workers(config, len(todo.run)), len(known)))


def print_dry_job(config: Mapping[str, Any], outputs: Path) -> None:
    """The same for a run on its own, which is run again even where it is done already."""
    check([config])
    key = fingerprint(config)
    done = finished_elsewhere(outputs, {key}).get(key)
    print("1 job" + (f", done already ({os.path.relpath(done)})" if done else ""))
    known = experiences(outputs)
    print(_time([expected_seconds(known, config)], 1, len(known)))


def _time(expected: list[float | None], workers: int, known: int) -> str:
    seconds = [value for value in expected if value is not None]
    if not seconds:
        return "time to expect: unknown, no job like these has finished yet"
    unknown = len(expected) - len(seconds)
    on = f"{workers} worker{'s' if workers > 1 else ''}"
    on += f", and {unknown} jobs unlike all that have finished" if unknown else ""
    return (
        f"time to expect: about {duration(sum(seconds) / workers)} on {on}, judged by {known} "
        f"finished job{'s' if known > 1 else ''}"
    )


def _workers(config: DictConfig, jobs: int) -> int:
    """What joblib would start; one where a cluster decides."""
    wanted = config.hydra.launcher.get("n_jobs", 1)
    count = (os.cpu_count() or 1) if wanted in (-1, None) else int(wanted)
    return max(1, min(count, jobs))
