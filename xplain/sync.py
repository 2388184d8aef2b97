"""Sends results on disk to MLflow: ``python -m xplain.sync [FOLDER ...] [tracking.uri=URI]``.

Without folders, every result below ``outputs/``. What is in MLflow already is not sent again.
"""

from __future__ import annotations

import sys
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from xplain.command_line import CONF, prepare, report_errors
from xplain.errors import InputError
from xplain.storage import RESULTS
from xplain.tracking import MLflow, log_folder


def sync(folders: list[Path], outputs: Path, tracking: MLflow) -> int:
    """Sends every result at or below the folders; returns how many there are.

    Raises:
        InputError: a folder is not there, or holds no results.
        OSError, MlflowException: the store cannot be reached.
    """
    found: list[Path] = []
    for folder in folders:
        below = sorted(path.parent for path in folder.rglob(RESULTS))
        if not below:
            raise InputError("folder", str(folder), f"a folder with {RESULTS} in it or below")
        found += below
    with tracking.client(outputs) as (client, experiment_id):
        for folder in found:
            log_folder(client, experiment_id, folder)
    return len(found)


def main() -> None:
    """The command line."""
    prepare()
    with report_errors(), initialize_config_dir(str(CONF), version_base="1.3"):
        overrides = [word for word in sys.argv[1:] if "=" in word]
        cfg = compose("config", ["tracking=mlflow", *overrides])
        outputs = Path(cfg.outputs)
        folders = [Path(word) for word in sys.argv[1:] if "=" not in word] or [outputs]
        count = sync(folders, outputs, instantiate(cfg.tracking))
        print(f"{count} results in MLflow")


if __name__ == "__main__":
    main()
