"""One run, or a sweep of them: ``python -m xplain solver=pomcp domain=rescue lambda=1.5``.

Thin on purpose: joblib ships the decorated function to workers by value, and ``--help`` must not
wait for the heavy packages, which :mod:`xplain.runs.job` brings.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from xplain.config import CONF, prepare, report_errors


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _job(cfg: DictConfig) -> float | None:
    from xplain.runs.job import run_job

    return run_job(cfg)


def main() -> None:
    """The command ``xplain``; every error that a person can mend is one line, exit code 2."""
    prepare()
    with report_errors():
        _job()


if __name__ == "__main__":
    main()
