"""Sends results on disk to MLflow: ``xplain sync [FOLDER ...] [tracking.uri=URI]``.

Without folders, every result below ``outputs/``. Sweeps arrive as a parent with its children.
What is in MLflow already is not sent again; what was left open or half-sent is mended.
"""

from __future__ import annotations

import logging
from pathlib import Path

from hydra.utils import instantiate

from xplain.errors import InputError, XplainError, first_line
from xplain.experiment.config import composed
from xplain.experiment.results import RESULTS
from xplain.report.summary import SWEEP, load_sweep
from xplain.runs.folder import SweepFolder, runs_and_sweeps
from xplain.runs.mlflow import MLflow
from xplain.runs.terminal import without_passwords

log = logging.getLogger(__name__)


def sync(folders: list[Path], outputs: Path, tracking: MLflow) -> int:
    """Sends every run and sweep at or below the folders; returns how many results there are.

    Raises:
        InputError: a folder is not there, or holds no results.
        XplainError: MLflow cannot take them.
    """
    count = 0
    for folder in folders:
        below = list(runs_and_sweeps(folder))
        if not below:
            raise InputError("folder", str(folder), f"a folder with {RESULTS} in it or below")
        for one in below:
            if not (one / SWEEP).exists():
                _send(tracking, one, outputs)
                count += 1
                continue
            sweep = SweepFolder(one)
            try:
                load_sweep(one)
            except InputError as error:  # the others can be sent all the same
                log.warning("left out: %s", error)
                continue
            with sweep.alone(f"{one.name}: it is running; waiting for its end"):
                _send(tracking, one, outputs)
            count += sum(sweep.state(job) == "finished" for job in sweep.jobs())
    return count


def _send(tracking: MLflow, folder: Path, outputs: Path) -> None:
    try:
        tracking.send(folder, outputs)
    except XplainError:
        raise
    except Exception as error:  # MLflow raises what SQLAlchemy, requests, the OS do
        text = without_passwords(first_line(error))
        raise XplainError(f"tracking.uri: MLflow does not take the results ({text})") from error


def main(arguments: list[str]) -> None:
    """Sends the results and prints how many there are."""
    # Names of jobs' folders have an equals sign as well.
    named = [word for word in arguments if Path(word).exists() or "=" not in word]
    keys = [word for word in arguments if word not in named]
    cfg = composed("config", ["tracking=mlflow", *keys])
    outputs = Path(cfg.outputs)
    folders = [Path(word) for word in named] or [outputs]
    count = sync(folders, outputs, instantiate(cfg.tracking))
    print(f"{count} results in MLflow")
