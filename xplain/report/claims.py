"""The answer of a sweep: the solver with the lowest cost, or for Table 1 the verdicts on the
paper's claims.

A claim is about a *figure* (a number computed from the sweep) with a 95 % interval, and a *range*
that contains the figure if the claim is true. It *holds* if the whole interval is in the range,
*does not hold* if the whole interval is outside, and is *not decided* otherwise. Table 1 has
several groups of columns. In each group, types and labels are learned in another way, and each
claim is tested in each group and domain. Intervals are over seeds, and each seed has its own data,
types, labelers and traces. With one seed no claim is decided.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import pandas as pd

from xplain.interaction.statistics import (
    Estimate,
    Range,
    clustered_mean,
    clustered_ratio,
    clustered_share,
)
from xplain.report import compare
from xplain.report.frame import Summary
from xplain.report.paper import NAMES, group_title, title
from xplain.report.table import Table, cell, interval, number, table_of

ALIKE = 0.1
"""Costs are about equal if they differ by at most this share of QMDP's cost. An oracle's cost is
linear in λ if its distance to a straight line is at most this share of the cost. (In the paper's
four-rooms column the distance is 6 %.)"""

ORDER = (("qmdp", "qhr"), ("pomcp_paper", "qhr"), ("qhr", "baseline"))
"""Pairs of solvers: the first costs less than the second."""

SHORT = NAMES | {"pomcp_paper": "POMCP", "baseline": "the baseline"}

PARTS = {
    "Clairvoyant's cost": ("clairvoyant", None),
    "+ type unknown": ("true_labels", "clairvoyant"),
    "+ labels learned": ("cost", "true_labels"),
    "= cost": ("cost", None),
    "Oracle − clairvoyant": ("oracle", "clairvoyant"),
}
"""Parts of a cost: (column of the episodes, column to subtract)."""

ONE_DATA_SET = (
    "This is one data set: one draw of people, labels and traces. Its intervals cover only the "
    "differences between traces. Another draw may give another order of solvers, so no claim is "
    "decided. Ten seeds can decide claims: python -m xplain sweeps=table1."
)

Verdict = Literal["holds", "does not hold", "not decided"]


@dataclass(frozen=True)
class Claim:
    """One claim, tested on one domain, in one group of the table's columns.

    Attributes:
        group: name of the group: how types and labels are learned there.
        domain: the domain.
        text: the claim, with its λ if it is about one λ.
        figure: name of the figure that decides the claim.
        estimate: mean and interval of the figure over seeds.
        true_in: the open range that contains the figure if the claim is true.
        parts: words and numbers that explain the figure, such as the differences in messages and in
            inexplicable labels that sum to a difference of costs.
    """

    group: str
    domain: str
    text: str
    figure: str
    estimate: Estimate
    true_in: Range
    parts: str

    @property
    def verdict(self) -> Verdict:
        """The verdict that follows from the interval."""
        low, high = self.estimate.low, self.estimate.high  # NaN with one seed
        least, most = self.true_in
        if least < low and high < most:
            return "holds"
        return "does not hold" if high <= least or most <= low else "not decided"

    @property
    def gap(self) -> Estimate:
        """The figure minus the end of the range that is nearest to its mean, with the interval
        of this difference."""
        end = min(self.true_in, key=lambda end: abs(end - self.estimate.mean))
        return Estimate(*(value - end for value in vars(self.estimate).values()))


@lru_cache(maxsize=1)
def claims(summary: Summary) -> list[Claim]:
    """Tests every claim about the solvers of Table 1, in each group of the table's columns and each
    domain. Returns no claim for other sweeps."""
    _, grouping, _ = compare.layout(summary)
    found = []
    keys = [*grouping, "domain"]
    for values, own in compare.group_episodes(summary, keys) if summary.is_table1 else []:
        group = {key: values[key] for key in grouping}
        name, domain = group_title(group, compare.label(group)), str(values["domain"])
        known = {key: value for key, value in values.items() if key in summary.settings}
        data_sets = compare.select_rows(summary.data_sets, known)
        found += [Claim(name, domain, *one) for one in check_claims(own, data_sets, summary.pool)]
    return found


def check_claims(
    episodes: pd.DataFrame, data_sets: pd.DataFrame, pool: Sequence[str] = ()
) -> Iterator[Tested]:
    """Tests the claims on one domain, in one group of the table's columns. Yields the attributes of
    each claim, without its group and domain.

    Args:
        episodes: a row for each episode (:attr:`xplain.report.frame.Summary.episodes`).
        data_sets: a row for each data set (:attr:`xplain.report.frame.Summary.data_sets`).
        pool: the swept keys over whose values the costs are averaged.
    """
    yield from _test_orders(episodes, pool)
    yield from _test_linearity(episodes)
    yield from _test_types(data_sets)


Tested = tuple[str, str, Estimate, Range, str]


def _test_orders(episodes: pd.DataFrame, pool: Sequence[str]) -> Iterator[Tested]:
    """Tests the claims that one solver costs less than another, or about the same, at each λ."""
    on, parts = (
        [*pool, "seed", "trace", "type"],
        ["communication", "inexplicability", "true_labels"],
    )
    groups: Any = episodes.groupby("lambda")
    for trade_off, own in groups:
        costs = {name: one.set_index(on)[["cost", *parts]] for name, one in own.groupby("solver")}
        for less, more in (("qmdp", "pomcp_paper"), *ORDER):
            if not {less, more} <= costs.keys():
                continue
            apart = (costs[more] - costs[less]).dropna(subset=["cost"])
            if apart.empty:  # the two solvers have no trace and user in common
                continue
            names, limits = [SHORT[name] for name in (less, more)], (0.0, math.inf)
            text = f"{names[0]} costs less than {names[1]}"
            if (less, more) not in ORDER:
                margin = ALIKE * float(costs[less].loc[apart.index, "cost"].mean())
                text, limits = f"{names[0]} and {names[1]} cost about the same", (-margin, margin)
            found = clustered_mean(apart["cost"], apart.index.get_level_values("seed"))
            figure = f"{names[1]} − {names[0]}"
            about = _describe_parts(apart.mean(), trade_off)
            yield f"{text}, λ = {trade_off:g}", figure, found, limits, about


def _describe_parts(apart: pd.Series[float], trade_off: float) -> str:
    """Describes the parts of a difference of costs: first the cost of the messages (λ times the sum
    of their costs) and the number of inexplicable labels; then the difference with true types and
    labels, and the rest, which is due to learned types and labels."""
    text = (
        f"{trade_off * apart['communication']:+z.2f} messages, {apart['inexplicability']:+z.2f} "
        "inexplicable labels"
    )
    learned = apart["cost"] - apart["true_labels"]
    if math.isnan(learned) or abs(learned) < 1e-9:
        return f"{text}; types and labels are true"
    return (
        f"{text}; {apart['true_labels']:+z.2f} with true types and labels, {learned:+z.2f} learned"
    )


def _test_linearity(episodes: pd.DataFrame) -> Iterator[Tested]:
    """Tests the claim that the oracle's cost is linear in λ.

    The cost of a fixed plan of messages is linear in λ, and the optimal cost is the minimum over
    all plans. If another plan becomes optimal at a larger λ, the optimal cost is there below the
    line through the costs at the two smallest λ.
    """
    one = episodes[episodes["solver"] == episodes["solver"].iloc[0]]
    below = {name: _measure_distances(one, name) for name in ("oracle", "clairvoyant")}
    if len(below["oracle"]):
        last = one["lambda"].max()
        figure = f"distance below the line at λ = {last:g}, as a share of the oracle's cost"
        estimate = clustered_mean(below["oracle"], below["oracle"].index)
        parts = (
            f"for the clairvoyant, whose labels are right: {number(below['clairvoyant'].mean())}"
        )
        yield "the oracle's cost is linear in λ", figure, estimate, (-ALIKE, ALIKE), parts


def _measure_distances(episodes: pd.DataFrame, column: str) -> pd.Series[float]:
    """Returns for each seed the distance of a cost from a line, at the largest λ, divided by the
    mean cost at this λ. The line goes through the costs at the two smallest λ. The distance is
    positive if the cost is below the line."""
    known = episodes[np.isfinite(episodes[column])]
    costs = known.pivot_table(column, "seed", "lambda").dropna()
    if len(costs.columns) < 3 or not len(costs):
        return pd.Series(dtype=float)
    first, second, last = (costs.columns[i] for i in (0, 1, -1))
    slope = (costs[second] - costs[first]) / (second - first)
    return (costs[first] + slope * (last - first) - costs[last]) / costs[last].mean()


def _test_types(data_sets: pd.DataFrame) -> Iterator[Tested]:
    """Tests the claim that the types are found in most data sets. Data sets of one seed have the
    same people."""
    if "adjusted_rand_index" not in data_sets:
        return
    data_sets = data_sets.dropna(subset=["adjusted_rand_index"])
    if len(data_sets):
        exact = data_sets["adjusted_rand_index"] == 1.0
        figure = f"share of {len(exact)} data sets whose types are found exactly"
        share = clustered_share(exact, data_sets["seed"])
        means = data_sets.reindex(columns=["adjusted_rand_index", "fresh_accuracy"]).mean()
        parts = "adjusted Rand index {:.2f}; labelers right on {:.1%} of fresh labels".format(
            *means
        )
        yield "the types are found", figure, share, (0.5, math.inf), parts


def claims_table(summary: Summary) -> Table:
    """Makes a table with a row for each claim. It has a column for each group of Table 1's
    columns, with the figure and the verdict in this group. If the verdict is "does not hold",
    the cell also explains the figure."""
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for claim in claims(summary):
        heads = {"Domain": title(claim.domain), "Claim": claim.text, "Figure": claim.figure}
        row = rows.setdefault((claim.domain, claim.text), heads)
        words = [claim.verdict, f"{number(claim.estimate.mean)} {interval(claim.estimate)}".strip()]
        words += [f"({claim.parts})"] * (claim.verdict == "does not hold")
        row[claim.group or "Verdict"] = "\n".join(words)
    caption = "95 % intervals over seeds in brackets; differences are on the same traces and users."
    return table_of([*rows.values()], 3, caption)


def decomposition(summary: Summary) -> Table:
    """Makes a table of the parts of each solver's cost. Every job explains each trace to each user
    four times: with the learned types and labels, with the true types and labels, as the oracle,
    and as the clairvoyant."""
    known = summary.episodes.dropna(subset=["oracle", "clairvoyant", "true_labels"])
    keys = [key for key in ("domain", "solver", *summary.shown) if key != "lambda"]

    def cells(own: pd.DataFrame) -> dict[str, str]:
        costs = {name: own[one] - own.get(less, 0) for name, (one, less) in PARTS.items()}
        clusters = own[summary.replicate]
        return {name: cell(clustered_mean(cost, clusters)) for name, cost in costs.items()}

    caption = (
        "A cost is the sum of the clairvoyant's cost, the additional cost of an unknown type (with "
        "true types and labels), and the additional cost of learned types and labels. The last "
        "column is the additional cost of learned labels for the oracle, which knows the type. "
        "± half-width of the 95 % interval over "
        f"{summary.replicate}s."
    )
    return compare.tabulate(summary, [*dict.fromkeys([*keys, "lambda"])], known, cells, caption)


def compute_ratios(summary: Summary) -> Table:
    """Makes a table of ratios, with a row for each problem and a column for each way to explain;
    an empty table if the sweep has one kind of people or one way.

    A ratio is the cost of a way divided by the cost of the best other way in the sweep, for the
    same people. Above 1, the other way costs less.
    """
    if "explainee" not in summary.posed or not summary.ways:
        return table_of([], 1)

    def cells(own: pd.DataFrame) -> dict[str, str]:
        ways = compare.group_episodes(summary, summary.ways, own)
        costs = {compare.label(way): e.set_index(summary.problem)["cost"] for way, e in ways}
        shared = pd.DataFrame(costs).dropna()  # traces and users that all ways have
        clusters = shared.index.get_level_values(summary.replicate)
        found = {}
        for way in costs if len(shared) and len(costs) > 1 else ():
            others = shared.drop(columns=way)
            ratio = clustered_ratio(shared[way], others[others.mean().idxmin()], clusters)
            found[way] = f"{ratio.mean:.2f} ± {(ratio.high - ratio.low) / 2:.2f}"
        return found

    caption = (
        "Cost divided by the cost of the best other way for the same people, with its 95 % "
        "interval."
    )
    return compare.tabulate(summary, summary.posed, summary.episodes, cells, caption)


def answer(summary: Summary) -> str:
    """Returns sentences with the solver or setting that costs least, the difference to the next
    one, and whether the 95 % interval of this difference excludes 0. For Table 1, the sentences
    have the number of the paper's claims that are decided, and the number that hold. Returns "" if
    there is nothing to compare."""
    if not summary.results or not summary.is_table1:
        return compare.least_cost(summary)
    if summary.seeds == 1:
        return ONE_DATA_SET
    tested = claims(summary)
    parts = []
    for group in dict.fromkeys(claim.group for claim in tested):
        verdicts = Counter(claim.verdict for claim in tested if claim.group == group)
        decided = verdicts["holds"] + verdicts["does not hold"]
        words = f"{decided} of {verdicts.total()} claims are decided, {verdicts['holds']} hold"
        parts.append(f"{group}: {words}" if group else words)
    return f"{'; '.join(parts)}." if parts else ""


def list_undecided(summary: Summary) -> Table:
    """Makes a table of the undecided differences to the lowest cost, or of Table 1's undecided
    claims. Each row has the number of seeds that would decide the difference or claim, and the
    minutes to compute the additional seeds."""
    rows = []
    for heads, gap, shown in _find_undecided(summary):
        seeds, minutes = compare.effort(summary, gap)
        rows.append({**heads, "Difference": shown, "Seeds": seeds, "Minutes": minutes})
    words = [w for w in shlex.split(summary.about["command"]) if not w.startswith("seed=")]
    caption = (
        "With these seeds the 95 % interval decides in four of five sweeps, if the difference is "
        "as large and varies as much as here. Minutes are for the new seeds and one worker, "
        f"estimated from this sweep's jobs. The command: {shlex.join(words)} SEEDS"
    )
    return table_of(rows, max(1, len(rows[0]) - 3) if rows else 1, caption)


def _find_undecided(summary: Summary) -> Iterator[tuple[dict[str, str], Estimate, str]]:
    """Yields the headings of a row, a difference whose interval contains 0, and its text."""
    for claim in claims(summary):
        if claim.verdict == "not decided":
            heads = {"Types and labels": claim.group} if claim.group else {}
            heads |= {"Domain": title(claim.domain), "Claim": claim.text}
            yield heads, claim.gap, f"{claim.figure}: {cell(claim.estimate)}"
    for values, (best, *others) in [] if summary.is_table1 else compare.verdicts(summary):
        for other in others:
            if not other.is_decided:
                heads = compare.headings(values) | {"Cost of": f"{other.name} − {best.name}"}
                yield heads, other.behind, cell(other.behind)
