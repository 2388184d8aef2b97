"""Computes for each kind of people the cost of an explainer divided by the cost of the best other
explainer in the sweep."""

from collections import defaultdict

import numpy as np
import pandas as pd

from xplain.interaction.statistics import clustered_ratio
from xplain.report.compare import (
    group_episodes,
    heading,
    label,
    pair_episodes,
    plain_text,
    select_rows,
)
from xplain.report.frame import Summary
from xplain.report.table import Table


def compute_ratios(summary: Summary) -> Table:
    """Makes a table of ratios, with a row for each problem and a column for each way to explain.

    A ratio is the cost of a way divided by the cost of the best other way in the sweep, for the
    same people. Above 1, the other way costs less. The last rows are geometric means over the kinds
    of people.
    """
    by, posed = summary.ways or ["solver"], summary.posed
    names = {tuple(values.values()): label(values) for values, _ in group_episodes(summary, by)}
    rows = list[dict[str, str]]()
    logs: dict[tuple[str, ...], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for values, frame in group_episodes(summary, posed):
        words = {heading(key): plain_text(value) for key, value in values.items()}
        every = {way: select_rows(frame, dict(zip(by, way, strict=True)))["cost"] for way in names}
        means = {way: float(cost.mean()) for way, cost in every.items() if len(cost)}
        cells = dict.fromkeys(names.values(), "")
        rest = tuple(word for key, word in words.items() if not key.startswith("explainee"))
        for way in names:
            best = min((one for one in means if one != way), key=lambda one: means[one])
            both = pair_episodes(frame, by, way, best, [*summary.pool, "seed", "trace", "type"])
            if len(both) and means[best] > 0:
                cost, other = both["cost"], both["cost_other"]
                found = clustered_ratio(cost, other, both[summary.replicate])
                cells[names[way]] = f"{found.mean:.2f} ± {(found.high - found.low) / 2:.2f}"
                logs[rest][names[way]].append(float(np.log(max(found.mean, 1e-9))))
        rows.append({**words, **cells})
    heads = [heading(key) for key in posed]
    for rest, own in logs.items():
        named = iter(rest)
        words = {key: "all" if key.startswith("explainee") else next(named) for key in heads}
        rows.append({**words, **{way: f"{np.exp(np.mean(one)):.2f}" for way, one in own.items()}})
    caption = (
        "Cost divided by the cost of the best other way for the same people, with its 95 % "
        "interval."
    )
    return Table(pd.DataFrame(rows).fillna(""), len(heads), caption)
