"""What was swept is what is shown: one combination of swept values, one estimate.

A sweep's keys are its dimensions. Seeds are replicates, never a dimension; a key is averaged over
only where the sweep's file says so (``pool``).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from xplain.interaction.statistics import Estimate, clustered_mean
from xplain.report.measure import is_choice
from xplain.report.paper import title
from xplain.report.summary import Summary, Value

MEASURES = (
    "regret",
    "above_floor",
    "cost",
    "messages",
    "inexplicable labels",
    "oracle",
    "clairvoyant",
)
"""Columns of the table of episodes that are estimated; ``oracle`` and ``clairvoyant`` are costs."""

_ALWAYS = ("domain", "lambda")

PROBLEM = ("lambda", "setting", "seed", "trace", "type")
"""What two methods share in a domain: the same trace, explained to the same user."""

UNKNOWN = Estimate(math.nan, math.nan, math.nan)


def grouped(summary: Summary, keys: Sequence[str]) -> list[tuple[dict[str, Value], pd.DataFrame]]:
    """(values, episodes) of every combination of these keys, in the order of the values."""
    if not keys:
        return [({}, summary.episodes)]
    order = {key: {value: i for i, value in enumerate(summary.values(key))} for key in keys}
    groups: list[tuple[dict[str, Any], pd.DataFrame]] = [
        (dict(zip(keys, values, strict=True)), frame)
        for values, frame in summary.episodes.groupby(list(keys), sort=False)
    ]
    return sorted(groups, key=lambda group: [order[key][group[0][key]] for key in keys])


def regret_csv(summary: Summary) -> str:
    """One row a combination of the swept values, never pooled; six decimals.

    Columns: ``solver``, ``lambda``, every other swept key by its full name; then of each measure
    (``questions`` too where some were asked) mean, low and high end of the 95 % interval, and n,
    how many seeds (with one seed: traces) it is over.
    """
    keys = ["solver", "lambda", *(k for k in summary.keys if k not in ("solver", "lambda"))]
    rows = []
    for values, frame in grouped(summary, keys):
        row: dict[str, object] = {key: plain_text(value) for key, value in values.items()}
        for measure in dict.fromkeys((*MEASURES, *summary.counted)):
            known, name = frame.dropna(subset=[measure]), measure.replace(" ", "_")
            row |= _ends(summary.estimate(known, measure) or UNKNOWN, f"{name}_")
            row[f"{name}_n"] = int(summary.clusters(known).nunique())
        rows.append(row)
    return csv_text(pd.DataFrame(rows))


def differences_csv(summary: Summary) -> str:
    """Cost of one way to solve a problem minus that of another, paired on the same traces and
    users: one row a problem and pair; six decimals. Where both have one oracle, so do regrets
    differ.

    Columns: ``domain``, ``lambda``, every other swept key that poses the problem; ``method`` and
    ``minus``, the two ways; mean, low and high end of the 95 % interval.
    """
    keys = [key for key in summary.keys if key not in summary.pool]
    conditions = ["domain", *(k for k in keys if not is_choice(k) and k not in _ALWAYS), "lambda"]
    by = [key for key in keys if is_choice(key)] or ["solver"]
    names = ways(summary, by)
    rows = []
    for values, frame in grouped(summary, conditions):
        for other, method in itertools.combinations(names, 2):
            difference = apart(summary, frame, by, method, other)
            if difference is not None:
                posed = {key: plain_text(value) for key, value in values.items()}
                rows.append(
                    {**posed, "method": names[method], "minus": names[other]} | _ends(difference)
                )
    columns = [*conditions, "method", "minus", "mean", "low", "high"]
    return csv_text(pd.DataFrame(rows, columns=columns))


def ways(summary: Summary, by: Sequence[str]) -> dict[tuple[Value, ...], str]:
    """``{values: name}`` of the ways to solve a problem: ``pomcp``, or
    ``pomcp solver.simulations=500``."""
    return {
        tuple(way.values()): " ".join(
            plain_text(value) if key == "solver" else f"{key}={plain_text(value)}"
            for key, value in way.items()
            if value != ""
        )
        for way, _ in grouped(summary, by)
    }


def csv_text(frame: pd.DataFrame) -> str:
    """Six decimals, never a negative zero; empty what is not known."""
    numbers = frame.select_dtypes("float").round(6) + 0.0
    plain = frame.assign(**{str(name): numbers[name] for name in numbers})
    return str(plain.to_csv(index=False, float_format="%.6f", lineterminator="\n"))


def _ends(estimate: Estimate, name: str = "") -> dict[str, float]:
    return {f"{name}{end}": getattr(estimate, end) for end in ("mean", "low", "high")}


def where(frame: pd.DataFrame, values: Mapping[str, Value]) -> pd.DataFrame:
    """The rows with these values."""
    return frame[(frame[list(values)] == list(values.values())).all(axis=1)]


def paired(
    frame: pd.DataFrame,
    by: Sequence[str],
    one: Sequence[Value],
    two: Sequence[Value],
    on: Sequence[str] = PROBLEM,
) -> pd.DataFrame:
    """Episodes of one way to solve a problem with ``difference``: their cost less that of another
    way, ``cost_other``, on the same problem; without those that have no partner.

    Args:
        frame: of episodes.
        by: columns that tell ways apart.
        one, two: their values in the two ways.
        on: columns that are the same in a pair.
    """
    left, right = (where(frame, dict(zip(by, way, strict=True))) for way in (one, two))
    key = [*on]
    both = left.merge(right[[*key, "cost"]], on=key, suffixes=("", "_other"), validate="one_to_one")
    return both.assign(difference=both["cost"] - both["cost_other"])


def apart(
    summary: Summary, frame: pd.DataFrame, by: Sequence[str], one: Any, two: Any
) -> Estimate | None:
    """Cost of one way minus that of another, on the same traces and users; None where they share
    none."""
    both = paired(frame, by, one, two, (*summary.pool, "seed", "trace", "type"))
    return clustered_mean(both["difference"], summary.clusters(both)) if len(both) else None


def plain_text(value: Value) -> str:
    """A value as it is written on the command line."""
    return value if isinstance(value, str) else f"{value:.10g}"


def heading(key: str) -> str:
    """A key over a column or beside an axis."""
    return {"lambda": "λ", "domain": "Domain", "solver": "Solver"}.get(key, key)


def value_title(key: str, value: Value) -> str:
    """A value for people."""
    text = plain_text(value)
    return title(text) if key in ("domain", "solver") else text


def value_label(key: str, value: Value) -> str:
    """A value with its key for people: ``λ = 0.5``, but ``QMDP`` and ``Four rooms``; "" of a key
    that the job lacks."""
    if key in ("domain", "solver") or value == "":
        return value_title(key, value)
    return f"{heading(key)} = {plain_text(value)}"


def label(values: Mapping[str, Value]) -> str:
    """Values with their keys, as :func:`value_label` has them; of a job that has none of the keys,
    that it has the defaults."""
    found = filter(None, itertools.starmap(value_label, values.items()))
    return ", ".join(found) or ("defaults" if values else "")
