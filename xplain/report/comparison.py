"""What was swept, compared: the table of a sweep, and in a sentence who costs least."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from xplain.interaction.statistics import Estimate, half_width
from xplain.report import paper_table
from xplain.report.combinations import (
    apart,
    grouped,
    heading,
    label,
    value_label,
    value_title,
    where,
)
from xplain.report.layout import shown_keys, table_layout
from xplain.report.measure import NEGATIVE, is_choice
from xplain.report.story import counted
from xplain.report.summary import Summary, Value
from xplain.report.table import BEST, TIE, Cell, Table, number

Way = tuple[Value, ...]

FEW = 5
"""Fewer replicates than this are said to be few: their intervals are wide, and rightly so."""

MOST_SEEDS = 1000
"""A difference that needs more is too small to be decided."""


@dataclass(frozen=True)
class Ranked:
    """One way to solve a problem among others.

    Attributes:
        way: its values.
        estimate: of the sweep's measure.
        behind: its cost less the best one's on the same traces and users; None for the best, or
            where they share none.
    """

    way: Way
    estimate: Estimate
    behind: Estimate | None

    @property
    def decided(self) -> bool:
        """Whether it can be told from the best: the interval leaves out 0."""
        return self.behind is not None and self.behind.low > 0


def shared(summary: Summary, frame: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """The episodes on traces and users that every way in the frame was tried on: where jobs are
    missing, means over all episodes would compare unlike problems."""
    known = frame.dropna(subset=[summary.measure.name])
    ways = known.groupby(list(by), sort=False).ngroup()
    problem = [known[key] for key in (*summary.pool, "seed", "trace", "type")]
    return known[ways.groupby(problem).transform("nunique") == ways.nunique()]


def ranked(summary: Summary, frame: pd.DataFrame, by: Sequence[str]) -> list[Ranked]:
    """Ways to solve the problem of these episodes, the one that costs least first; an order where
    the sweep's measure is fair. Order and differences are taken from the same episodes
    (:func:`shared`); no way is ranked where there are none."""
    measure, frame = summary.measure.name, shared(summary, frame, by)
    groups: Any = frame.groupby(list(by), sort=False)
    means = {way: summary.mean(own, measure) for way, own in groups}
    order = sorted(means, key=lambda way: round(means[way].mean, 9))
    return [
        Ranked(way, means[way], apart(summary, frame, by, way, order[0]) if i else None)
        for i, way in enumerate(order)
    ]


def main_table(summary: Summary) -> Table:
    """The sweep's table; Table 1 with the paper's values where its file asks for it."""
    if summary.report == "table1":
        return paper_table.table(summary, measure=summary.measure.name)
    return table(summary)


def table(summary: Summary) -> Table:
    """Every combination of swept values, but for the keys that the sweep pools: problems go down,
    ways to solve them across, the measure with the cost below it in each cell; where only problems
    or only ways were swept, a row each with its figures."""
    layout, measure = table_layout(summary), summary.measure
    if not layout.down or not layout.across:
        return _list(summary, layout.down or layout.across, bool(layout.across))
    columns = [tuple(values.values()) for values, _ in grouped(summary, layout.across)]
    known = measure.reference
    rows = []
    for values, frame in grouped(summary, layout.down):
        frame = _comparable(summary, frame, layout.across)
        own = _marked(summary, frame, layout.across)
        cells = [own.get(way, Cell()) for way in columns]
        if known:
            told = summary.reference(frame, known)
            cells.insert(0, Cell(estimate=summary.estimate(told, known)))
        rows.append((*_headings(values), *cells))
    heads = [*map(heading, layout.down), *([summary.title(known)] if known else [])]
    heads += [label(dict(zip(layout.across, way, strict=True))) for way in columns]
    return _table(summary, heads, rows, len(layout.down), marked=True)


def _list(summary: Summary, keys: tuple[str, ...], compete: bool) -> Table:
    """A row a combination with its measures; those that compete are marked, the best first."""
    measure = summary.measure
    names = dict.fromkeys((measure.name, "cost", measure.reference or "cost"))
    shown = [*names, *summary.counted]
    episodes = _comparable(summary, summary.episodes, keys) if compete else summary.episodes
    ways = [tuple(values.values()) for values, _ in grouped(summary, keys)]
    marks = _marked(summary, episodes, keys) if compete else {}
    rows = []
    for way in dict.fromkeys([*marks, *ways]):
        own = where(episodes, dict(zip(keys, way, strict=True)))
        cells = [Cell(estimate=summary.estimate(own, name)) for name in shown]
        if way in marks:
            cells[0] = Cell(estimate=marks[way].estimate, mark=marks[way].mark)
        rows.append((*_headings(dict(zip(keys, way, strict=True))), *cells))
    heads = [*map(heading, keys), *map(summary.title, shown)]
    return _table(summary, heads, rows, len(keys), compete)


def _comparable(summary: Summary, frame: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """What a row shows: episodes that can be compared, or all where none can."""
    found = shared(summary, frame, by)
    return found if len(found) else frame


def _headings(values: dict[str, Value]) -> list[Cell]:
    return [Cell(value_title(key, value) or "–") for key, value in values.items()]


def _marked(summary: Summary, frame: pd.DataFrame, by: Sequence[str]) -> dict[Way, Cell]:
    """One row's ways in their order, the best marked, and those that cannot be told from it."""
    cells: dict[Way, Cell] = {}
    order, fair = ranked(summary, frame, by), summary.measure.fair
    for one in order:
        mark = "" if one.decided or not fair else TIE
        if fair and round(one.estimate.mean - order[0].estimate.mean, 9) == 0:
            mark = BEST
        cost = where(frame, dict(zip(by, one.way, strict=True)))["cost"].mean()
        note = "" if summary.measure.name == "cost" else f"cost {number(cost)}"
        cells[one.way] = Cell(estimate=one.estimate, mark=mark, note=note)
    groups: Any = frame.groupby(list(by), sort=False)
    measure = summary.measure.name
    return cells or {way: Cell(estimate=summary.estimate(own, measure)) for way, own in groups}


def _table(
    summary: Summary, heads: list[str], rows: list[tuple[Cell, ...]], left: int, marked: bool
) -> Table:
    title = summary.measure.title
    about = f"{title[0].upper()}{title[1:]}: {_common(summary)}" if marked else _common(summary)
    caption = _caption(summary, [cell for row in rows for cell in row], marked)
    return Table(tuple(heads), tuple(rows), left, caption, about, halves=True)


def _common(summary: Summary) -> str:
    """What was not swept, as far as a reader wants to know it."""
    fixed = [key for key in ("domain", "solver", "lambda") if key not in shown_keys(summary)]
    values = {key: summary.values(key) for key in fixed}
    parts = [value_label(key, own[0]) for key, own in values.items() if len(own) == 1]
    traces = summary.episodes.groupby("seed")["trace"].nunique().max()
    return ", ".join([*parts, counted(int(traces), "trace"), counted(summary.seeds, "seed")])


def _caption(summary: Summary, cells: Sequence[Cell], marked: bool) -> str:
    """How to read the table."""
    text = [summary.measure.why]
    marked = marked and summary.measure.fair
    if any(cell.ends for cell in cells):
        text.append(f"± half-width of the 95 % interval over {summary.unit}.")
        if marked:
            text.append(
                f"{BEST} costs least in its row; {TIE} not told apart from it: the interval of the "
                "difference on the same traces and users holds 0."
            )
    else:
        text.append("One trace and one seed: no intervals.")
        if marked:
            text.append(f"{BEST} costs least in its row.")
    if summary.measure.name == "regret":
        if any(cell.estimate and cell.estimate.mean < 0 for cell in cells):
            text.append(NEGATIVE)
        text.append(summary.warning)
    if summary.pool:
        text.append(f"Means over {', '.join(summary.pool)}, as the sweep's file asks.")
    if marked and summary.missing:
        text.append("Ways are compared on the traces and users for which all of them have results.")
    return " ".join(filter(None, text)) + summary.told_missing


@dataclass(frozen=True)
class Verdict:
    """Who costs least on one problem.

    Attributes:
        problem: values of the keys that pose it; empty where one problem was swept.
        order: of the ways, the best first.
    """

    problem: dict[str, Value]
    order: tuple[Ranked, ...]

    @property
    def decided(self) -> bool:
        """Whether the best can be told from the next."""
        return len(self.order) > 1 and self.order[1].decided


def verdicts(summary: Summary) -> list[Verdict]:
    """Who costs least, problem by problem; none where nothing that was swept competes, or the
    measure that was asked for is not fair."""
    by = [key for key in shown_keys(summary) if is_choice(key)]
    if not by or not summary.measure.fair:
        return []
    posed = [key for key in shown_keys(summary) if not is_choice(key)]
    found = [
        Verdict(values, tuple(ranked(summary, frame, by)))
        for values, frame in grouped(summary, posed)
    ]
    return [one for one in found if len(one.order) > 1]


def answer(summary: Summary) -> str:
    """What won, by how much, and whether that is decided, in a sentence or two; "" where nothing
    competes."""
    found = verdicts(summary)
    if not found:
        return ""
    by = [key for key in shown_keys(summary) if is_choice(key)]
    names = {tuple(way.values()): label(way) for way, _ in grouped(summary, by)}
    if len(found) == 1:
        best, second = found[0].order[:2]
        text = f"{names[best.way]} costs least"
        if best.estimate.mean == second.estimate.mean:
            return f"{text}, as does {names[second.way]}."
        gap = second.behind
        less = "" if gap is None else f", {number(gap.mean)} less than {names[second.way]}"
        return f"{text}{less}. {_how_sure(summary, second)}"
    first: dict[Way, list[Verdict]] = {}
    for one in found:
        first.setdefault(one.order[0].way, []).append(one)
    parts = [
        f"{names[way]} in {len(won)} of {len(found)} problems "
        f"({sum(one.decided for one in won)} decided)"
        for way, won in sorted(first.items(), key=lambda item: -len(item[1]))
    ]
    return f"Least cost: {'; '.join(parts)}.{_few(summary)}"


def seeds_to_decide(difference: Estimate, seeds: int) -> int | None:
    """The least number of seeds with which an interval leaves out 0 in four of five sweeps, if the
    difference is as large and varies as much as these seeds say; None where they say neither.

    Args:
        difference: with its 95 % interval over seeds.
        seeds: that it is known from.
    """
    from scipy.special import stdtrit

    half = (difference.high - difference.low) / 2
    if seeds < 2 or not difference.mean or not half >= 0:
        return None
    deviation = half * math.sqrt(seeds) / half_width(1.0, seeds - 1)
    for count in range(max(seeds, 2), MOST_SEEDS + 1):
        needed = half_width(1.0, count - 1) + float(stdtrit(count - 1, 0.8))
        if needed * deviation <= abs(difference.mean) * math.sqrt(count):
            return count
    return None


def undecided(summary: Summary) -> Table:
    """The differences to the best way that are not decided: how many seeds would decide each, how
    long they would take, and by which command."""
    by = [key for key in shown_keys(summary) if is_choice(key)]
    names = {tuple(way.values()): label(way) for way, _ in grouped(summary, by)}
    seconds = [sum(results.seconds.values()) for _, results in summary.results]
    of_a_seed = sum(seconds) / max(summary.seeds, 1)
    found = verdicts(summary)
    rows = []
    for one in found:
        best, *others = one.order
        for other in others:
            if other.decided or other.behind is None:
                continue
            seeds = seeds_to_decide(other.behind, summary.seeds)
            wanted = seeds or (FEW if summary.seeds < FEW else None)
            more = max(0, (wanted or 0) - summary.seeds) * of_a_seed / 60
            rows.append(
                (
                    *_headings(one.problem),
                    Cell(f"{names[other.way]} − {names[best.way]}"),
                    Cell(estimate=other.behind),
                    Cell(str(seeds) if seeds else f"{wanted} tell more" if wanted else "too many"),
                    Cell(f"{more:.1f}" if wanted else ""),
                )
            )
    posed = map(heading, found[0].problem) if found else ()
    heads = (*posed, "Difference", "Cost", "Seeds that would decide it", "Minutes of one core")
    words = [w for w in shlex.split(summary.about["command"]) if not w.startswith("seed=")]
    caption = (
        "Seeds with which the 95 % interval leaves out 0 in four of five sweeps, if the difference "
        "is as large and varies as much as here. Minutes are those of this sweep's own jobs, for "
        f"the seeds that are new. Command, with N seeds: {shlex.join(words)} 'seed=range(N)'"
    )
    return Table(heads, tuple(rows), len(heads) - 3, caption)


def _how_sure(summary: Summary, second: Ranked) -> str:
    gap = second.behind
    if gap is None or gap.low != gap.low:
        return "Not decided: one trace and one seed tell nothing of others."
    ends = f"95 % interval of the difference {number(gap.low)} … {number(gap.high)}"
    word = "Decided" if second.decided else "Not decided"
    return f"{word}: {ends}.{_few(summary)}"


def _few(summary: Summary) -> str:
    replicates = int(summary.clusters(summary.episodes).nunique())
    unit = summary.unit if replicates > 1 else summary.unit[:-1]
    few = f" Only {replicates} {unit}: too few to decide all but large differences."
    return few if replicates < FEW else ""
