"""Writes labels of simulated observers: ``xplain observe domain=rescue output=FILE``.

The table is what :mod:`xplain.cli.discover` reads. The observers' true types go to a file of their
own (columns ``observer``, ``type``, ``behaves_like``: the first type that labels everything alike).
The last line on standard output is one JSON object: ``output``, ``truth``, ``observers``,
``labels``, ``types``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
from hydra.utils import instantiate

from xplain.errors import InputError
from xplain.experiment import pipeline
from xplain.experiment.config import composed
from xplain.learning.data.cells import check_format
from xplain.learning.data.label_file import write_table
from xplain.randomness import run_seed


def main(arguments: list[str]) -> dict[str, Any]:
    """Writes the files; returns what the command prints. ``arguments`` override
    conf/observe.yaml."""

    cfg = composed("observe", arguments, with_hydra=True)
    run_seed(cfg.seed)
    output = Path(cfg.output)
    check_format(output, "output")
    named = output.name.removesuffix(".gz").removesuffix(".csv").removesuffix(".parquet")
    beside = output.with_name(f"{named}.types.csv") if cfg.truth is None else Path(cfg.truth)
    if output.resolve() == beside.resolve():
        raise InputError("truth", cfg.truth, "another file than the output")
    observed = pipeline.observe(
        instantiate(cfg.domain),
        instantiate(cfg.users),
        instantiate(cfg.observers),
        instantiate(cfg.queries),
        cfg.seed,
    )
    dataset, truth, setting = observed.dataset, observed.truth, observed.setting
    if truth is None or setting is None:
        raise InputError("observers", cfg.hydra.runtime.choices.observers, "simulated")
    for path in (output, beside):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_table(dataset, output)
    known = pd.DataFrame(
        {
            "observer": dataset.observers,
            "type": [setting.types[t].name for t in truth],
            "behaves_like": [setting.types[t].name for t in setting.distinct[truth]],
        }
    )
    known.to_csv(beside, index=False)
    return {
        "output": str(output),
        "truth": str(beside),
        "observers": len(dataset.observers),
        "labels": len(dataset),
        "types": len(set(setting.distinct[truth].tolist())),
    }
