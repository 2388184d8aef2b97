"""Results on disk, which are the truth: MLflow and reports are made from them.

A run's folder holds ``results.json`` (figures, configuration, code version), ``episodes.jsonl``
(one line an episode, step by step), ``config.yaml`` (resolved) and pictures.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import subprocess
import tempfile
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import xplain
from xplain.evaluation.metrics import Record, by_step, summarise
from xplain.experiment.pipeline import Prepared
from xplain.message_sets import names_of

RESULTS = "results.json"
EPISODES = "episodes.jsonl"


@cache
def code_version() -> str:
    """A digest of the package's own sources: results of other code are other results."""
    digest = hashlib.sha256()
    root = Path(xplain.__file__).parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@cache
def git_state() -> dict[str, str]:
    """Commit and whether the checkout has changes; empty where the package is no checkout."""
    root = Path(xplain.__file__).parent.parent
    if not (root / ".git").exists():
        return {}
    try:
        commit = _git(root, "rev-parse", "HEAD")
        dirty = bool(_git(root, "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"commit": commit, "dirty": str(dirty).lower()}


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()


def write_atomically(path: Path, text: str) -> None:
    """The whole text or nothing, even when the process is killed or the disk is full.

    Raises:
        OSError: with the path.
    """
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())  # others of the group may read results
        os.replace(temporary, path)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise OSError(error.errno, error.strerror, str(path)) from error


@cache
def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def results_of(
    prepared: Prepared, records: list[Record], about: dict[str, Any], bounds: dict[str, float]
) -> dict[str, Any]:
    """The content of ``results.json``.

    Args:
        prepared, records: of the run.
        about: what was run: configuration, choices, versions, times.
        bounds: certified figures of the explanation problems, by name.
    """
    estimates = summarise(records)
    return {
        **about,
        "metrics": {
            name: {"mean": e.mean, "low": _finite(e.low), "high": _finite(e.high)}
            for name, e in estimates.items()
        },
        "bounds": bounds,
        "learning": {k: v for k, v in prepared.learning.items() if math.isfinite(v)},
        "elbow": {"rule": prepared.rule, "disagreements": prepared.curve.tolist()},
        "messages": dict(zip(prepared.messages, prepared.sentences, strict=True)),
        "scene": None if prepared.scene is None else asdict(prepared.scene),
        "types": {
            "true": list(prepared.types),
            "found": list(prepared.found),
            "behave_alike": prepared.distinct.tolist(),
            "stands_for": prepared.stands_for.tolist(),
        },
        "steps": {name: values.tolist() for name, values in by_step(records).items()},
        "episodes": [
            {
                "solver": record.solver,
                "trace": record.trace,
                "type": prepared.types[record.user_type],
                "cost": record.episode.cost,
                "communication": record.episode.communication,
                "inexplicability": record.episode.inexplicability,
                "messages": record.episode.n_messages,
                "inexplicable_labels": record.episode.n_inexplicable,
                "steps_until_sure": record.steps_until_sure,
            }
            for record in records
        ],
    }


def episode_lines(prepared: Prepared, records: list[Record]) -> str:
    """The content of ``episodes.jsonl``: what was said, answered and believed at each step."""
    lines = []
    for record in records:
        episode = record.episode
        steps = [
            {
                "messages": names_of(int(episode.messages[k]), prepared.messages),
                "labels": episode.labels[k, : k + 1].tolist(),
                "belief": [round(float(b), 12) for b in episode.beliefs[k + 1]],
            }
            for k in range(len(episode.messages))
        ]
        case = prepared.cases[record.trace]
        line = {
            "solver": record.solver,
            "trace": record.trace,
            "type": prepared.types[record.user_type],
            "cost": episode.cost,
            "transitions": list(case.phrases),
            "positions": [list(cell) for cell in case.positions],
            "prior": episode.beliefs[0].tolist(),
            "steps": steps,
        }
        lines.append(json.dumps(line))
    return "\n".join(lines) + "\n"


def save_results(folder: Path, results: dict[str, Any]) -> None:
    """Writes ``results.json``, last of all files of a run: where it is, the run is whole."""
    write_atomically(folder / RESULTS, json.dumps(results, indent=1, allow_nan=False) + "\n")


def load_results(folder: Path) -> dict[str, Any]:
    """Reads ``results.json``.

    Raises:
        OSError, ValueError: there is none, or it is no JSON.
    """
    results: dict[str, Any] = json.loads((folder / RESULTS).read_text(encoding="utf-8"))
    return results


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
