"""Of a sweep's learning stage: elbows, and how well types and labels were learned."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from xplain.report.measure import setting_of
from xplain.report.paper import title
from xplain.report.summary import Summary
from xplain.report.table import Cell, Table

FIGURES = {
    "true_types": "types",
    "types_found": "found",
    "adjusted_rand_index": "adjusted Rand index",
    "labeler_accuracy": "labelers right",
    "fresh_accuracy": "on fresh questions",
    "everyone_accuracy": "one labeler for all right",
}


def data_sets(summary: Summary) -> pd.DataFrame:
    """A row a data set, one a domain, setting and seed: these, the disagreements for each number of
    types (``curve``), the number found (``chosen``), and the figures of the learning stage by name,
    NaN where there is none."""
    rows = [
        {
            "domain": results.domain,
            "setting": setting_of(job["values"]),
            "seed": results.seed,
            "curve": results.elbow.disagreements,
            "chosen": len(results.types.found),
            "adjusted_rand_index": math.nan,
            **results.learning,
        }
        for job, results in summary.results
    ]
    return pd.DataFrame(rows).drop_duplicates(["domain", "setting", "seed"], keep="last")


def elbows(summary: Summary, domain: str) -> dict[str, tuple[NDArray[np.float64], Counter[int]]]:
    """``{setting: (mean curve over seeds, how often each k was chosen)}``."""
    found = data_sets(summary)
    own = found[(found["domain"] == domain) & (found["curve"].map(len) > 0)]
    curves: Any = own.groupby("setting", sort=False)
    means = {}
    for setting, part in curves:
        shortest = part["curve"].map(len).min()
        mean = np.mean([curve[:shortest] for curve in part["curve"]], axis=0)
        means[setting] = (mean, Counter(part["chosen"]))
    return means


def table(summary: Summary) -> Table:
    """How well types and labels were learned, a row a setting."""
    found = data_sets(summary)
    heads = [name for name in FIGURES if name in found and found[name].notna().any()]
    groups: Any = found.groupby(["domain", "setting"], sort=False)
    rows = []
    for (domain, setting), own in groups:
        means = own[heads].mean(skipna=False)
        name = " ".join(filter(None, [title(domain), setting]))
        rows.append((Cell(name), *(Cell(_text(key, means[key])) for key in heads)))
    caption = "Means over seeds. Labelers are scored on labels that were held out."
    return Table(("Setting", *(FIGURES[key] for key in heads)), tuple(rows), 1, caption)


def _text(key: str, value: float) -> str:
    if math.isnan(value):
        return ""
    if key.endswith("accuracy"):
        return f"{value:.1%}"
    return f"{value:g}" if float(value).is_integer() else f"{value:.2f}"
