"""Compares the jobs of a sweep: one estimate for each combination of swept values, the lowest cost
on each problem, and the number of seeds that would decide an undecided difference.

A sweep's keys are its dimensions. Seeds are replicates, never a dimension. A key is averaged over
only if the sweep's file says so (``pool``).
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from typing import Any

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


def reference(summary: Summary, frame: pd.DataFrame, name: str) -> Estimate:
    """Estimates the cost of the oracle or the clairvoyant. This cost is the same in every job of a
    problem, so each trace and user counts once."""
    problem = [*summary.pool, "seed", "trace", "type"]
    return estimate(summary, frame.dropna(subset=[name]).drop_duplicates(problem), name)


def group_episodes(
    summary: Summary, keys: Sequence[str]
) -> list[tuple[dict[str, Value], pd.DataFrame]]:
    """Groups the episodes by these keys. Returns ({key: value}, episodes) for every combination
    of their values, in the order of :meth:`xplain.report.frame.Summary.values`."""
    if not keys:
        return [({}, summary.episodes)]
    order = {key: {value: i for i, value in enumerate(summary.values(key))} for key in keys}
    groups: list[tuple[dict[str, Any], pd.DataFrame]] = [
        (dict(zip(keys, values, strict=True)), frame)
        for values, frame in summary.episodes.groupby(list(keys), sort=False)
    ]
    return sorted(groups, key=lambda group: [order[key][group[0][key]] for key in keys])


def select_rows(frame: pd.DataFrame, values: Mapping[str, Value]) -> pd.DataFrame:
    """Selects the rows that have all these values, ``{column: value}``."""
    for key, value in values.items():
        frame = frame[frame[key] == value]
    return frame


def pair_episodes(
    frame: pd.DataFrame,
    by: Sequence[str],
    one: Sequence[Value],
    two: Sequence[Value],
    on: Sequence[str],
) -> pd.DataFrame:
    """Pairs the episodes of one way to solve a problem with the episodes of another way, on the
    same problem. Episodes without a partner are left out.

    Args:
        frame: episodes.
        by: columns whose values define a way to solve a problem, such as ``solver``.
        one, two: values of these columns for the first way and for the other way.
        on: columns that must be equal in both episodes of a pair, such as trace and user.

    Returns:
        A row for each pair. The columns of the second episode end in ``_other``, and ``difference``
        is the cost of the first episode minus the cost of the second.
    """
    left, right = (select_rows(frame, dict(zip(by, way, strict=True))) for way in (one, two))
    both = left.merge(right, on=[*on], suffixes=("", "_other"), validate="one_to_one")
    return both.assign(difference=both["cost"] - both["cost_other"])


def difference(
    summary: Summary, frame: pd.DataFrame, by: Sequence[str], one: Way, two: Way
) -> Estimate:
    """Estimates the cost of one way minus the cost of another way, on the same traces and users;
    NaN if the two ways have no trace and user in common."""
    both = pair_episodes(frame, by, one, two, [*summary.pool, "seed", "trace", "type"])
    if not len(both):
        return UNKNOWN
    return clustered_mean(both["difference"], both[summary.replicate])


@dataclass(frozen=True)
class RankedWay:
    """One way to solve a problem, ranked among all ways that the sweep compares.

    Attributes:
        way: values of the swept keys that define the way.
        name: readable name of the way.
        estimate: estimate of the measure that compares the sweep's jobs.
        cost: mean cost.
        behind: cost of this way minus the cost of the best way, on the same traces and users.
    """

    way: Way
    name: str
    estimate: Estimate
    cost: float
    behind: Estimate

    @property
    def is_decided(self) -> bool:
        """True if the interval of the difference to the best way excludes 0."""
        return self.behind.low > 0


def select_shared(summary: Summary, frame: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Selects the episodes on the traces and users for which all ways to solve the problem have an
    episode. If jobs are missing, means over all episodes would compare different traces and users.

    Args:
        summary: the sweep.
        frame: episodes.
        by: columns whose values define a way to solve a problem, such as ``solver``.
    """
    known = frame.dropna(subset=[summary.measure.name])
    ways = known.groupby([*by], sort=False).ngroup()
    problem = [known[key] for key in (*summary.pool, "seed", "trace", "type")]
    return known[ways.groupby(problem).transform("nunique") == ways.nunique()]


def rank_ways(summary: Summary, frame: pd.DataFrame, by: Sequence[str]) -> list[RankedWay]:
    """Ranks the ways to solve a problem by the mean of the measure that compares the sweep's jobs,
    the lowest first.

    Args:
        summary: the sweep.
        frame: episodes of the problem.
        by: columns whose values define a way, such as ``solver``.

    Returns:
        The ranked ways; empty if no trace and user is shared by all ways.
    """
    frame = select_shared(summary, frame, by)
    groups: Any = frame.groupby([*by], sort=False)
    measure = summary.measure.name
    order = sorted(groups, key=lambda item: round(float(item[1][measure].mean()), 9))
    return [
        RankedWay(
            way,
            label(dict(zip(by, way, strict=True))),
            estimate(summary, own, measure),
            own["cost"].mean(),
            difference(summary, frame, by, way, order[0][0]),
        )
        for way, own in order
    ]


@lru_cache(maxsize=1)
def verdicts(summary: Summary) -> list[tuple[dict[str, Value], list[RankedWay]]]:
    """Ranks the ways to solve each problem of a sweep.

    Returns:
        For each problem with at least two ways: ({swept key: value} that define the problem, the
        ranked ways). Empty if no swept key chooses a way, or if the requested measure is not fair.
    """
    if not summary.results or not summary.ways or not summary.measure.fair:
        return []
    groups = group_episodes(summary, summary.posed)
    found = [(values, rank_ways(summary, frame, summary.ways)) for values, frame in groups]
    return [one for one in found if len(one[1]) > 1]


def layout(summary: Summary) -> tuple[list[str], list[str], list[str]]:
    """Chooses where the table shows each swept key. Rows are problems, and columns are ways to
    solve the problems. The key of :func:`main_key` is the last of the rows' keys, so it varies from
    row to row.

    Returns:
        The keys of the rows, the keys of the groups of columns, and the keys of the columns within
        a group.
    """
    groups, across = list[str](), list[str]()
    for key in sorted(summary.ways, key=lambda key: key != "solver"):
        if len(across) < 2 and prod(len(summary.values(k)) for k in (*across, key)) <= WIDEST:
            across.append(key)
    if summary.is_table1:
        groups = [key for key in summary.posed if key not in ("domain", "lambda")]
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

    Rows are problems. Columns are the costs of the oracle and the clairvoyant, then the ways to
    solve the problems, with the paper's values in parentheses. If the sweep varies only problems or
    only ways, each problem or way has a row, and its measures are the columns.
    """
    down, grouping, across = layout(summary)
    if not across or not (down or grouping):
        return _list_combinations(summary, down or across, bool(across))
    measure, rows = summary.measure.name, list[dict[tuple[str, str], str]]()
    known = [name for name in _list_references(summary) if summary.episodes[name].notna().any()]
    is_beside = is_beside_paper(summary)
    groups, ways = (
        [own for own, _ in group_episodes(summary, keys)] for keys in (grouping, across)
    )
    for values, frame in group_episodes(summary, down):
        row = {("", heading(key)): value_title(key, value) for key, value in values.items()}
        at = str(frame["domain"].iloc[0]), float(frame["lambda"].iloc[0])
        published = paper.table1().get(at, {}) if is_beside else {}
        for group in groups:
            own, title = select_rows(frame, group), paper.group_title(group, label(group))
            mark = NO_REFERENCE if is_unreliable(own) else ""
            for name in known:
                place = ("" if name == "clairvoyant" else title, TITLES[name])
                after = _join_marks(mark if name == "oracle" else "", published.get(name))
                row[place] = cell(reference(summary, own, name), after, "", bool(grouping))
            found = {one.way: one for one in rank_ways(summary, own, across)}
            best = next(iter(found.values()), None)
            for way in ways:
                one, solver = found.get(tuple(way.values())), str(way.get("solver"))
                alone = select_rows(own, way)
                shown = estimate(summary, alone, measure) if one is None else one.estimate
                cost = alone["cost"].mean() if one is None else one.cost
                below = "" if grouping or measure == "cost" else f"cost {number(cost)}"
                after = _join_marks(_choose_mark(summary, one, best), published.get(solver))
                row[title, label(way)] = cell(shown, after, below, bool(grouping))
        rows.append(row)
    about = f"{summary.measure.title}: {_list_common(summary)}"
    caption = _make_caption(summary, True) + " In parentheses the paper's values." * is_beside
    return table_of(rows, len(down), caption, about)


def _list_combinations(summary: Summary, keys: Sequence[str], compete: bool) -> Table:
    """Makes the table with a row for each combination of the keys' values, and a column for each
    measure. If ``compete`` is True, the combinations are different ways to explain: the best is in
    the first row, and marks show the lowest cost and the costs that cannot be distinguished from
    it."""
    questions = ["questions"] if summary.episodes["questions"].any() else []
    measures = [summary.measure.name, "cost", *_list_references(summary)]
    shown = dict.fromkeys([*measures, "messages", "inexplicable_labels", *questions])
    frame = summary.episodes
    order = rank_ways(summary, frame, keys) if compete else []
    frame = select_shared(summary, frame, keys) if order else frame
    found = {one.way: one for one in order}
    ways = dict.fromkeys(
        [*found, *(tuple(own.values()) for own, _ in group_episodes(summary, keys))]
    )
    rows = []
    for way in ways:
        values = dict(zip(keys, way, strict=True))
        own = select_rows(frame, values)
        mark = NO_REFERENCE if is_unreliable(own) else ""
        row = {heading(key): value_title(key, value) or "–" for key, value in values.items()}
        for name in shown:
            words = [mark] if name in ("regret", "oracle") else []
            if name == summary.measure.name and order:
                words.append(_choose_mark(summary, found.get(way), order[0]))
            row[TITLES[name]] = cell(estimate(summary, own, name), " ".join(filter(None, words)))
        rows.append(row)
    start = f"{summary.measure.title}: " if compete else ""
    return table_of(rows, len(keys), _make_caption(summary, compete), start + _list_common(summary))


def is_beside_paper(summary: Summary) -> bool:
    """True if the paper's values are shown; the paper has only regrets, for people without
    errors."""
    return summary.is_table1 and summary.measure.name == "regret"


def _list_references(summary: Summary) -> list[str]:
    """Lists the columns of the clairvoyant and, if regrets are shown, of the oracle. The
    clairvoyant is first because it costs least."""
    return ["clairvoyant", *(["oracle"] if summary.measure.name == "regret" else [])]


def _choose_mark(summary: Summary, one: RankedWay | None, best: RankedWay | None) -> str:
    if one is None or best is None or not summary.measure.fair:
        return ""
    if round(one.estimate.mean - best.estimate.mean, 9) == 0:
        return BEST
    return "" if one.is_decided else TIE


def _join_marks(mark: str, published: float | None) -> str:
    """Joins a mark and the paper's value, such as ``* (0.52)``; leaves out what is missing."""
    return " ".join(filter(None, [mark, "" if published is None else f"({published:.2f})"]))


def heading(key: str) -> str:
    """Returns the heading of a key's column or axis."""
    return {"lambda": "λ", "domain": "Domain", "solver": "Solver"}.get(key, key)


def plain_text(value: Value) -> str:
    """Formats a value as it is written on the command line."""
    return value if isinstance(value, str) else f"{value:.10g}"


def value_title(key: str, value: Value) -> str:
    """Returns a readable form of a value."""
    text = plain_text(value)
    return paper.title(text) if key in ("domain", "solver") else text


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
    text, is_marked = [measure.why], is_marked and measure.fair
    several = frame[summary.replicate].nunique() > 1
    text += [f"± half-width of the 95 % interval over {summary.replicate}s."] if several else []
    text += [] if several else ["One trace and one seed: no intervals."]
    if is_marked:
        text.append(
            f"{BEST} marks the lowest cost of a row. {TIE} marks costs that are not "
            "distinguishable from the lowest: the interval of the difference on the same traces "
            "and users contains 0."
        )
    if measure.name == "regret":
        keys = [*dict.fromkeys((*summary.shown, "solver"))]
        rows = frame.fillna({"fresh_accuracy": 1.0}).groupby(keys, dropna=False)
        least = rows[["fresh_accuracy", "regret"]].mean().min()
        shares = {"fresh_accuracy": float(least["fresh_accuracy"])}
        text.append(warning_about_oracle(shares, least["regret"]))
    if summary.pool:
        text.append(f"Means over {', '.join(summary.pool)}, as configured in the sweep's file.")
    if summary.missing:
        text.append(f"{summary.missing} of {len(summary.jobs)} jobs are missing.")
        text += ["Ways are compared on traces and users that all of them have."] * is_marked
    return " ".join(filter(None, text))


def least_cost(summary: Summary) -> str:
    """Returns one or two sentences with the solver or setting that costs least, the difference to
    the next one, and whether the 95 % interval of this difference excludes 0. Returns "" if there
    is nothing to compare."""
    found = verdicts(summary)
    if not found:
        return ""
    if len(found) == 1:
        best, second = found[0][1][:2]
        text = f"{best.name} costs least"
        if best.estimate.mean == second.estimate.mean:
            return f"{text}, as does {second.name}."
        gap = second.behind
        if math.isnan(gap.low):
            return f"{text}. Not decided: one trace and one seed say nothing about others."
        word = "Decided" if second.is_decided else "Not decided"
        return (
            f"{text}, {number(gap.mean)} less than {second.name}. {word}: 95 % interval of the "
            f"difference {number(gap.low)} … {number(gap.high)}.{_warn_if_few(summary)}"
        )
    won = Counter(order[0].name for _, order in found)
    decided = Counter(order[0].name for _, order in found if order[1].is_decided)
    parts = [
        f"{name} in {times} of {len(found)} problems ({decided[name]} decided)"
        for name, times in won.most_common()
    ]
    return f"Least cost: {'; '.join(parts)}.{_warn_if_few(summary)}"


def _warn_if_few(summary: Summary) -> str:
    amount = int(summary.episodes[summary.replicate].nunique())
    counted = count_things(amount, summary.replicate)
    few = f" With only {counted}, only large differences can be decided."
    return few if amount < FEW else ""


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
    for count in range(max(seeds, 2), MOST_SEEDS + 1):
        needed = half_width(1.0, count - 1) + float(stdtrit(count - 1, 0.8))
        if needed * deviation <= abs(gap.mean) * math.sqrt(count):
            return count
    return None


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


Undecided = tuple[dict[str, str], Estimate, str]
"""Row headings, a difference, and the difference in words."""


def find_undecided(summary: Summary) -> Iterator[Undecided]:
    """Finds the ways to solve a problem whose cost is not distinguishable from the lowest: the
    95 % interval of the difference contains 0."""
    for values, (best, *others) in verdicts(summary):
        heads = {heading(key): value_title(key, own) for key, own in values.items()}
        for other in others:
            if not other.is_decided:
                ways = {"Cost of": f"{other.name} − {best.name}"}
                yield heads | ways, other.behind, cell(other.behind)


def regret_csv(summary: Summary) -> str:
    """Makes a CSV text with one row for each combination of the swept values, never pooled.

    Columns: ``solver``, ``lambda``, every other swept key by its full name; then for each measure
    the mean, the low and high end of the 95 % interval, and n, the number of seeds (with one seed:
    traces).
    """
    keys = [*dict.fromkeys(["solver", "lambda", *summary.keys])]
    asks = summary.episodes["questions"].any()
    names, rows = [name for name in TITLES if name != "questions" or asks], []
    for values, frame in group_episodes(summary, keys):
        row: dict[str, object] = {key: plain_text(value) for key, value in values.items()}
        for name in names:
            ends = vars(estimate(summary, frame, name)).items()
            row |= {f"{name}_{end}": value for end, value in ends}
            row[f"{name}_n"] = int(frame.dropna(subset=[name])[summary.replicate].nunique())
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
    ways = {
        tuple(way.values()): " ".join(
            plain_text(v) if k == "solver" else f"{k}={plain_text(v)}" for k, v in way.items() if v
        )
        for way, _ in group_episodes(summary, by)
    }
    rows = []
    for values, frame in group_episodes(summary, posed):
        for other, method in itertools.combinations(ways, 2):
            found = difference(summary, frame, by, method, other)
            if not math.isnan(found.mean):
                pair = {"method": ways[method], "minus": ways[other]}
                rows.append({k: plain_text(v) for k, v in values.items()} | pair | vars(found))
    return _format_csv(
        pd.DataFrame(rows, columns=[*posed, "method", "minus", "mean", "low", "high"])
    )


def _format_csv(frame: pd.DataFrame) -> str:
    """Formats numbers with six decimals, never a negative zero; NaN becomes empty."""
    numbers = frame.select_dtypes("float").round(6) + 0.0
    plain = frame.assign(**{str(name): numbers[name] for name in numbers})
    return str(plain.to_csv(index=False, float_format="%.6f", lineterminator="\n"))
