"""Writes labels of simulated observers: ``xplain observe domain=rescue output=FILE``.

The table is what :mod:`xplain.cli.discover` reads. The observers' true types go to a file of their
own (columns ``observer``, ``type``, ``behaves_like``: the first type that labels everything alike).
The last line on standard output is one JSON object: ``output``, ``truth``, ``observers``,
``labels``, ``types``.
"""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Any

from hydra.utils import instantiate

from xplain.config import CONF, compose_for, report_errors
from xplain.errors import InputError


def observe(arguments: list[str]) -> dict[str, Any]:
    """Writes the files; returns what the command prints. ``arguments`` override
    conf/observe.yaml."""
    import pandas as pd

    from xplain.data.label_table import check_format, write_table
    from xplain.randomness import stream
    from xplain.users.setting import Setting

    cfg = compose_for("observe", arguments)
    if not isinstance(cfg.seed, int) or cfg.seed < 0:
        raise InputError("seed", cfg.seed, "a whole number ≥ 0")
    output = Path(cfg.output)
    check_format(output, "output")
    named = output.name.removesuffix(".gz").removesuffix(".csv").removesuffix(".parquet")
    beside = output.with_name(f"{named}.types.csv") if cfg.truth is None else Path(cfg.truth)
    if output.resolve() == beside.resolve():
        raise InputError("truth", cfg.truth, "another file than the output")
    domain = instantiate(cfg.domain)
    types = instantiate(cfg.users).types(domain, stream(cfg.seed, "users"))
    setting = Setting.build(domain, types)
    dataset, truth = instantiate(cfg.observers).collect(setting, cfg.seed)
    if truth is None:
        raise InputError("observers", cfg.hydra.runtime.choices.observers, "simulated")
    for path in (output, beside):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_table(dataset, output)
    known = pd.DataFrame(
        {
            "observer": dataset.observers,
            "type": [types[t].name for t in truth],
            "behaves_like": [types[t].name for t in setting.distinct[truth]],
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


def main() -> None:
    """The command."""
    if "--help" in sys.argv[1:]:
        print(__doc__)
        print((CONF / "observe.yaml").read_text(encoding="utf-8"))
        return
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    with report_errors():
        print(json.dumps(observe(sys.argv[1:])))


if __name__ == "__main__":
    main()
