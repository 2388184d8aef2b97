"""Sends results on disk to MLflow: ``xplain sync [FOLDER ...] [tracking.uri=URI]``.

Without folders, every result below ``outputs/``. Sweeps arrive as a parent with its children.
What is in MLflow already is not sent again.
"""

from __future__ import annotations

from pathlib import Path

from hydra.utils import instantiate

from xplain.config import composed
from xplain.errors import InputError
from xplain.experiment.results import RESULTS
from xplain.runs.folder import SWEEP, SweepFolder
from xplain.runs.mlflow import MLflow, log_folder
from xplain.runs.mlflow_mirror import Mirror
from xplain.runs.mlflow_views import describe_experiment


def sync(folders: list[Path], outputs: Path, tracking: MLflow) -> int:
    """Sends every result at or below the folders; returns how many there are.

    Raises:
        InputError: a folder is not there, or holds no results.
        OSError, MlflowException: the store cannot be reached.
    """
    sweeps: dict[Path, int] = {}
    alone: list[Path] = []
    for folder in folders:
        below = sorted(path.parent for path in folder.rglob(RESULTS))
        if not below:
            raise InputError("folder", str(folder), f"a folder with {RESULTS} in it or below")
        for result in below:
            sweep = result.parents[1]
            if result.parent.name == "jobs" and (sweep / SWEEP).exists():
                sweeps[sweep] = sweeps.get(sweep, 0) + 1
            else:
                alone.append(result)
    with tracking.client(outputs) as (client, experiment_id):
        for result in alone:
            log_folder(client, experiment_id, result)
        describe_experiment(client, experiment_id)
    for path in sweeps:
        sweep_folder = SweepFolder(path)
        with sweep_folder.alone(f"{path.name}: it is running; waiting for its end"):
            Mirror(tracking, outputs, sweep_folder, sweep_folder.jobs()).send()
    return len(alone) + sum(sweeps.values())


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
