"""Compares the jobs of a sweep: one estimate for each combination of swept values, the lowest cost
on each problem, and the number of seeds that would decide an undecided difference.

A sweep's keys are its dimensions. Seeds are replicates, never a dimension. A key is averaged over
only if the sweep's file says so (``pool``).
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from math import prod
from typing import Any

import numpy as np
import pandas as pd

from xplain.interaction.metrics import possible
from xplain.interaction.statistics import Estimate, clustered_mean, half_width
from xplain.report import paper
from xplain.report.frame import (
    NO_REFERENCE,
    TITLES,
    Summary,
    Value,
    is_unreliable,
    warning_about_oracle,
)
from xplain.report.table import BEST, TIE, Table, cell, count_things, number, table_of

Way = tuple[Value, ...]

UNKNOWN = Estimate(math.nan, math.nan, math.nan)
"""The estimate of a measure that no episode has."""

WIDEST = 8
"""Maximum number of columns in a table and of lines in a plot that can be read."""

FEW = 5
"""If there are fewer replicates than this, the report warns that intervals are wide."""

MOST_SEEDS = 1000
"""A difference that needs more seeds is too small to be decided."""


def estimate(summary: Summary, frame: pd.DataFrame, column: str) -> Estimate:
    """Estimates the mean of a column of episodes, with an interval over replicates. The interval
    is clipped to the range of possible means. The estimate is NaN if no episode has a value."""
    known = frame.dropna(subset=[column])
    if not len(known):
        return UNKNOWN
    return clustered_mean(known[column], known[summary.replicate], possible=possible(column))


def group_episodes(
    summary: Summary, keys: Sequence[str], frame: pd.DataFrame | None = None
) -> list[tuple[dict[str, Value], pd.DataFrame]]:
    """Groups episodes by these keys. Returns ({key: value}, episodes) for every combination of
    their values, in the order of :meth:`xplain.report.frame.Summary.values`.

    Args:
        summary: the sweep.
        keys: columns of the frame.
        frame: a part of the sweep's episodes; None takes all of them.
    """
    frame = summary.episodes if frame is None else frame
    if not keys:
        return [({}, frame)]
    order = {key: {value: i for i, value in enumerate(summary.values(key))} for key in keys}
    groups: list[tuple[dict[str, Any], pd.DataFrame]] = [
        (dict(zip(keys, values, strict=True)), own)
        for values, own in frame.groupby(list(keys), sort=False)
    ]
    return sorted(groups, key=lambda group: [order[key][group[0][key]] for key in keys])


def select_rows(frame: pd.DataFrame, values: Mapping[str, Value]) -> pd.DataFrame:
    """Selects the rows that have all these values, ``{column: value}``."""
    for key, value in values.items():
        frame = frame[frame[key] == value]
    return frame


def difference(summary: Summary, one: pd.DataFrame, other: pd.DataFrame) -> Estimate:
    """Estimates the cost of one way to solve a problem minus the cost of another way, on the same
    traces and users; NaN if the episodes of the two ways have no trace and user in common."""
    costs = [own.set_index(summary.problem)["cost"] for own in (one, other)]
    return estimate(summary, (costs[0] - costs[1]).rename("difference").reset_index(), "difference")


@dataclass(frozen=True)
class ComparedWay:
    """One way to solve a problem, compared with the best way of the sweep.

    Attributes:
        values: values of the swept keys that define the way.
        episodes: episodes of the way, on the traces and users that all ways have.
        behind: cost of this way minus the cost of the best way, on the same traces and users; NaN
            if there is one way, if no trace and user is shared by all ways, or if the measure is
            not fair.
    """

    values: Mapping[str, Value]
    episodes: pd.DataFrame
    behind: Estimate

    @property
    def name(self) -> str:
        """Readable name."""
        return label(self.values)

    @property
    def is_decided(self) -> bool:
        """True if the interval of the difference to the best way excludes 0."""
        return self.behind.low > 0

    @property
    def mark(self) -> str:
        """The mark of the lowest cost, or of a cost that is not distinguishable from it."""
        if round(self.behind.mean, 9) == 0:
            return BEST
        return "" if self.is_decided or math.isnan(self.behind.mean) else TIE


def compare_ways(summary: Summary, frame: pd.DataFrame, by: Sequence[str]) -> list[ComparedWay]:
    """Compares the ways to solve a problem with the way that has the lowest mean of the measure.

    Only traces and users for which all ways have an episode count. If jobs are missing, means over
    all episodes would compare different traces and users. If no trace and user is shared by all
    ways, the ways have all their episodes.

    Args:
        summary: the sweep.
        frame: episodes of the problem.
        by: columns whose values define a way, such as ``solver``.
    """
    measure = summary.measure.name
    known = frame.dropna(subset=[measure])
    ways = known.groupby([*by], sort=False).ngroup()
    problem = [known[key] for key in summary.problem]
    shared = known[ways.groupby(problem).transform("nunique") == ways.nunique()]
    found = group_episodes(summary, by, shared if len(shared) else frame)
    _, best = min(found, key=lambda way: round(float(way[1][measure].mean()), 9))
    is_known = len(shared) and summary.measure.fair and len(found) > 1
    return [
        ComparedWay(way, own, difference(summary, own, best) if is_known else UNKNOWN)
        for way, own in found
    ]


@lru_cache(maxsize=1)
def verdicts(summary: Summary) -> list[tuple[dict[str, Value], list[ComparedWay]]]:
    """Ranks the ways to solve each problem of a sweep.

    Returns:
        For each problem with at least two ways: ({swept key: value} that define the problem, the
        ranked ways). Empty if no swept key chooses a way, or if the requested measure is not fair.
    """
    if not summary.results or not summary.ways:
        return []
    groups = group_episodes(summary, summary.posed)
    found = [(values, compare_ways(summary, frame, summary.ways)) for values, frame in groups]
    return [
        (values, sorted(ways, key=lambda way: round(way.behind.mean, 9)))
        for values, ways in found
        if not math.isnan(ways[0].behind.mean)
    ]


def layout(summary: Summary) -> tuple[list[str], list[str], list[str]]:
    """Chooses where the table shows each swept key. Rows are problems, and columns are ways to
    solve the problems. The key of :func:`main_key` is the last of the rows' keys, so it varies from
    row to row.

    Returns:
        The keys of the rows, the keys of the groups of columns, and the keys of the columns within
        a group.
    """
    across = list[str]()
    for key in sorted(summary.ways, key=lambda key: key != "solver"):
        if len(across) < 2 and prod(len(summary.values(k)) for k in (*across, key)) <= WIDEST:
            across.append(key)
    apart = summary.posed if summary.is_table1 else []
    groups = [key for key in apart if key not in ("domain", "lambda")]
    down = [key for key in summary.shown if key not in across and key not in groups]
    main = main_key(summary, down)
    down.sort(key=lambda key: key == main)
    return down, groups, across


def main_key(summary: Summary, keys: Sequence[str]) -> str | None:
    """Returns the key whose values are numbers and which has most values; λ wins a tie. None if
    no key has at least two numbers."""
    numbers = [k for k in keys if sum(isinstance(v, float) for v in summary.values(k)) > 1]
    return max(numbers, key=lambda k: (len(summary.values(k)), k == "lambda"), default=None)


def table(summary: Summary) -> Table:
    """Makes the table of all combinations of swept values. Keys that the sweep averages over
    (``pool``) are left out.

    Rows are problems. Columns are the costs of the clairvoyant and the oracle, then the measure of
    each way to solve the problems, with the paper's values in parentheses.
    """
    down, grouping, across = layout(summary)
    rows = [
        {("", head): text for head, text in headings(values).items()}
        | _make_row(summary, frame, grouping, across or ["solver"])
        for values, frame in group_episodes(summary, down or ["domain"])
    ]
    caption = _make_caption(summary, bool(across))
    return table_of(
        rows, len(down) or 1, caption, f"{summary.measure.title}: {_list_common(summary)}"
    )


def _make_row(
    summary: Summary, frame: pd.DataFrame, grouping: Sequence[str], across: Sequence[str]
) -> dict[tuple[str, str], str]:
    """Makes the cells of a problem: in each group of columns, the costs of the references and the
    measure of each way."""
    row, measure, split = dict[tuple[str, str], str](), summary.measure.name, bool(grouping)
    names = ["clairvoyant", *(["oracle"] if measure == "regret" else [])]
    references = [name for name in names if summary.episodes[name].notna().any()]
    published = {name: f"({value:.2f})" for name, value in find_published(summary, frame).items()}
    for group, own in group_episodes(summary, grouping, frame):
        title, ways = paper.group_title(group, label(group)), compare_ways(summary, own, across)
        for name in references:
            found = estimate(summary, pd.concat(way.episodes for way in ways), name)
            mark = NO_REFERENCE if name == "oracle" and is_unreliable(own) else ""
            place = "" if name == "clairvoyant" else title, TITLES[name]
            row[place] = cell(found, f"{mark} {published.get(name, '')}", "", split)
        for way in ways:
            after = f"{way.mark} {published.get(str(way.values.get('solver')), '')}"
            cost = f"cost {number(way.episodes['cost'].mean())}"
            below = "" if grouping or measure == "cost" else cost
            found = estimate(summary, way.episodes, measure)
            row[title, way.name] = cell(found, after, below, split)
    return row


def tabulate(
    summary: Summary,
    keys: Sequence[str],
    frame: pd.DataFrame,
    cells: Callable[[pd.DataFrame], dict[str, str]],
    caption: str,
) -> Table:
    """Makes a table with a row for each combination of the keys' values.

    Args:
        summary: the sweep.
        keys: columns of the frame.
        frame: episodes or data sets.
        cells: makes the cells of a row, by heading, from the frame's rows of one combination.
        caption: explains how to read the table.
    """
    groups = group_episodes(summary, keys, frame)
    return table_of([headings(values) | cells(own) for values, own in groups], len(keys), caption)


def is_beside_paper(summary: Summary) -> bool:
    """True if the paper's values are shown; the paper has only regrets, for people without
    errors."""
    return summary.is_table1 and summary.measure.name == "regret"


def find_published(summary: Summary, frame: pd.DataFrame) -> dict[str, float]:
    """Returns the paper's values for the problem of these episodes: the oracle's cost, and the
    regret of each solver. Empty if the paper's values are not shown."""
    if not is_beside_paper(summary):
        return {}
    return paper.table1().get((frame["domain"].iloc[0], frame["lambda"].iloc[0]), {})


def heading(key: str) -> str:
    """Returns the heading of a key's column or axis."""
    return {"lambda": "λ", "domain": "Domain", "solver": "Solver"}.get(key, key)


def plain_text(value: Value) -> str:
    """Formats a value as it is written on the command line."""
    return value if isinstance(value, str) else f"{value:.10g}"


def value_title(key: str, value: Value) -> str:
    """Returns a readable form of a value."""
    text = plain_text(value) or "–"
    return paper.title(text) if key in ("domain", "solver") else text


def headings(values: Mapping[str, Value]) -> dict[str, str]:
    """Returns the headings of a row: readable forms of keys and their values."""
    return {heading(key): value_title(key, value) for key, value in values.items()}


def label(values: Mapping[str, Value]) -> str:
    """Formats values with their keys, such as ``λ = 0.5``; solvers and domains only by name, such
    as ``QMDP``. A job without any of the keys is called the default."""
    found = [
        value_title(key, value)
        if key in ("domain", "solver")
        else f"{heading(key)} = {plain_text(value)}"
        for key, value in values.items()
        if value != ""
    ]
    return ", ".join(found) or ("defaults" if values else "")


def _list_common(summary: Summary) -> str:
    """Lists the domain, solver and λ that all compared runs share, and the numbers of traces and
    seeds."""
    keys = [key for key in ("domain", "solver", "lambda") if key not in summary.shown]
    parts = [label({key: own[0]}) for key in keys if len(own := summary.values(key)) == 1]
    traces = int(summary.episodes.groupby("seed")["trace"].nunique().max())
    return ", ".join([*parts, count_things(traces, "trace"), count_things(summary.seeds, "seed")])


def _make_caption(summary: Summary, is_marked: bool) -> str:
    """Explains how to read the table."""
    frame, measure = summary.episodes, summary.measure
    is_marked = is_marked and measure.fair
    several = frame[summary.replicate].nunique() > 1
    keys = [*dict.fromkeys((*summary.shown, "solver"))]
    rows = frame.fillna({"fresh_accuracy": 1.0}).groupby(keys, dropna=False)
    least: Any = rows[["fresh_accuracy", "regret"]].mean().min()
    marks = (
        f"{BEST} marks the lowest cost of a row. {TIE} marks costs that are not distinguishable "
        "from the lowest: the interval of the difference on the same traces and users contains 0."
    )
    said = {
        measure.why: True,
        f"± half-width of the 95 % interval over {summary.replicate}s.": several,
        "One trace and one seed: no intervals.": not several,
        marks: is_marked,
        warning_about_oracle(least, least["regret"]): measure.name == "regret",
        f"Means over {', '.join(summary.pool)}, as configured in the sweep's file.": summary.pool,
        f"{summary.missing} of {len(summary.jobs)} jobs are missing.": summary.missing,
        "Ways are compared on traces and users that all of them have.": (
            summary.missing and is_marked
        ),
        "In parentheses the paper's values.": is_beside_paper(summary),
    }
    return " ".join(text for text, is_true in said.items() if text and is_true)


def least_cost(summary: Summary) -> str:
    """Returns one or two sentences with the solver or setting that costs least, the difference to
    the next one, and whether the 95 % interval of this difference excludes 0. Returns "" if there
    is nothing to compare."""
    found = verdicts(summary)
    if not found:
        return ""
    amount = int(summary.episodes[summary.replicate].nunique())
    counted = count_things(amount, summary.replicate)
    few = f" With only {counted}, only large differences can be decided." if amount < FEW else ""
    if len(found) > 1:
        won = Counter(order[0].name for _, order in found)
        decided = Counter(order[0].name for _, order in found if order[1].is_decided)
        parts = [
            f"{name} in {times} of {len(found)} problems ({decided[name]} decided)"
            for name, times in won.most_common()
        ]
        return f"Least cost: {'; '.join(parts)}.{few}"
    best, second = found[0][1][:2]
    gap, text = second.behind, f"{best.name} costs least"
    if gap.mean == 0:
        return f"{text}, as does {second.name}."
    if math.isnan(gap.low):
        return f"{text}. Not decided: one trace and one seed say nothing about others."
    return (
        f"{text}, {number(gap.mean)} less than {second.name}. "
        f"{'Decided' if second.is_decided else 'Not decided'}: 95 % interval of the difference "
        f"{number(gap.low)} … {number(gap.high)}.{few}"
    )


def seeds_to_decide(gap: Estimate, seeds: int) -> int | None:
    """Returns the smallest number of seeds, at least ``seeds``, for which the interval would
    exclude 0 in four of five sweeps. The mean and the variance over seeds are assumed to be as in
    ``gap``. Returns None if the mean or variance is unknown, or if the number is above MOST_SEEDS.

    Args:
        gap: a difference with its 95 % interval over seeds.
        seeds: number of seeds in ``gap``.
    """
    from scipy.special import stdtrit

    width = (gap.high - gap.low) / 2
    if seeds < 2 or not gap.mean or not width >= 0:
        return None
    deviation = width * math.sqrt(seeds) / half_width(1.0, seeds - 1)
    counts = np.arange(seeds, MOST_SEEDS + 1)
    quantiles = stdtrit(counts - 1, 0.975) + stdtrit(counts - 1, 0.8)
    enough = counts[quantiles * deviation <= abs(gap.mean) * np.sqrt(counts)]
    return int(enough[0]) if len(enough) else None


def effort(summary: Summary, gap: Estimate) -> tuple[str, str]:
    """Returns how ``seed`` must be set on the command line so that a difference is decided (such
    as ``seed='range(20)'``), and the minutes that one worker needs for the additional seeds,
    estimated from this sweep's jobs."""
    seconds = sum(sum(own.seconds.values()) for _, own in summary.results)
    seeds = seeds_to_decide(gap, summary.seeds) or (FEW if summary.seeds < FEW else 0)
    if not seeds:
        return f"more than {MOST_SEEDS}", ""
    more = seeds - summary.seeds
    return f"seed='range({seeds})'", f"{more * seconds / summary.seeds / 60:.1f}"


def regret_csv(summary: Summary) -> str:
    """Makes a CSV text with one row for each combination of the swept values, never pooled.

    Columns: ``solver``, ``lambda``, every other swept key by its full name; then for each measure
    the mean, the low and high end of the 95 % interval, and n, the number of seeds (with one seed:
    traces).
    """
    unused = [] if summary.episodes["questions"].any() else ["questions"]
    rows = []
    keys = dict.fromkeys(["solver", "lambda", *summary.keys])
    for values, frame in group_episodes(summary, [*keys]):
        row: dict[str, object] = {key: plain_text(value) for key, value in values.items()}
        for name in (name for name in TITLES if name not in unused):
            count = frame.dropna(subset=[name])[summary.replicate].nunique()
            ends = vars(estimate(summary, frame, name)) | {"n": count}
            row |= {f"{name}_{end}": value for end, value in ends.items()}
        rows.append(row)
    return _format_csv(pd.DataFrame(rows))


def differences_csv(summary: Summary) -> str:
    """Makes a CSV text with the cost of one way to solve a problem minus the cost of another way,
    on the same traces and users. Each problem and pair of ways has a row.

    Columns: the swept keys of the problem; ``method`` and ``minus``, the two ways; mean, low and
    high end of the 95 % interval.
    """
    swept = [key for key in summary.keys if key not in summary.pool]
    by = [key for key in swept if summary.competes(key)] or ["solver"]
    posed = [*dict.fromkeys(["domain", *(k for k in swept if k not in by), "lambda"])]
    rows = []
    for values, frame in group_episodes(summary, posed):
        for (other, less), (method, more) in combinations(group_episodes(summary, by, frame), 2):
            found = difference(summary, more, less)
            if not math.isnan(found.mean):
                pair = {"method": _name_way(method), "minus": _name_way(other)}
                rows.append({k: plain_text(v) for k, v in values.items()} | pair | vars(found))
    columns = [*posed, "method", "minus", "mean", "low", "high"]
    return _format_csv(pd.DataFrame(rows, columns=columns))


def _name_way(way: Mapping[str, Value]) -> str:
    """Names a way as on the command line; solvers without their key."""
    return " ".join(
        plain_text(v) if k == "solver" else f"{k}={plain_text(v)}" for k, v in way.items() if v
    )


def _format_csv(frame: pd.DataFrame) -> str:
    """Formats numbers with six decimals, never a negative zero; NaN becomes empty."""
    return frame.to_csv(index=False, float_format="{:z.6f}".format, lineterminator="\n")
