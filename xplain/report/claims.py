"""What the paper reads from its Table 1, each claim tested on a sweep's episodes.

A claim is about a *figure* with a 95 % interval, and a *range* that the figure lies in where the
claim is true. It *holds* where the whole interval lies in the range, *does not hold* where it all
lies outside, and is *not decided* otherwise. Intervals are over seeds, each with data,
types, labelers and traces of its own; one seed decides nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from xplain.interaction.statistics import Estimate, Range, clustered_mean, clustered_share
from xplain.report.combinations import paired
from xplain.report.paper import title
from xplain.report.table import Cell, Table, interval, number

ALIKE = 0.1
"""Costs that differ by no more than this share of QMDP's are about the same, and an oracle's cost
that leaves a straight line by no more than this share of itself is linear in λ. (The paper's own
four-rooms column leaves it by 6 %.)"""

ORDER = (("qmdp", "qhr"), ("pomcp_paper", "qhr"), ("qhr", "baseline"))
"""(costs less, than this one)."""

Verdict = Literal["holds", "does not hold", "not decided"]


@dataclass(frozen=True)
class Claim:
    """One claim on one domain.

    Attributes:
        domain: where it is tested.
        text: the claim, with its λ where it is about one.
        figure: what the estimate is, in words.
        estimate: mean and interval over seeds.
        true_in: where the figure lies if the claim is true; open at both ends.
    """

    domain: str
    text: str
    figure: str
    estimate: Estimate
    true_in: Range

    @property
    def verdict(self) -> Verdict:
        """Whether the interval settles it."""
        low, high = self.estimate.low, self.estimate.high
        least, most = self.true_in
        if math.isnan(low):
            return "not decided"
        if least < low and high < most:
            return "holds"
        return "does not hold" if high <= least or most <= low else "not decided"


def claims(episodes: pd.DataFrame, found: pd.DataFrame | None = None) -> list[Claim]:
    """Tests every claim that a sweep's solvers allow, domain by domain.

    Args:
        episodes: a row an episode, with domain, setting, solver, lambda, seed, trace, type, cost
            and oracle (:attr:`xplain.report.summary.Summary.episodes`).
        found: a row a data set that types were sought in, with domain, seed and
            adjusted_rand_index (:func:`xplain.report.learning.data_sets`).
    """
    tested: list[Claim] = []
    groups: Any = episodes.groupby("domain", sort=False)
    for domain, own in groups:
        tested += [*_orders(domain, own), *_linear(domain, own)]
        if found is not None and len(found):
            tested += _types(domain, found[found["domain"] == domain])
    return tested


def _orders(domain: str, episodes: pd.DataFrame) -> Iterator[Claim]:
    """The claims about pairs of solvers, at each λ."""
    for trade_off, own in episodes.groupby("lambda"):
        at = f"λ = {trade_off:g}"
        both = paired(own, ["solver"], ["pomcp_paper"], ["qmdp"])
        if len(both):
            margin = ALIKE * float(both["cost_other"].mean())
            estimate = clustered_mean(both["difference"], both["seed"])
            text = f"QMDP and POMCP cost about the same, {at}"
            yield Claim(domain, text, "POMCP − QMDP", estimate, (-margin, margin))
        for less, more in ORDER:
            both = paired(own, ["solver"], [more], [less])
            if len(both):
                estimate = clustered_mean(both["difference"], both["seed"])
                names = [_NAMES[name] for name in (less, more)]
                text = f"{names[0]} costs less than {names[1]}, {at}"
                figure = f"{names[1]} − {names[0]}"
                yield Claim(domain, text, figure, estimate, (0.0, math.inf))


_NAMES = {"qmdp": "QMDP", "pomcp_paper": "POMCP", "qhr": "QHR", "baseline": "the baseline"}


def _linear(domain: str, episodes: pd.DataFrame) -> Iterator[Claim]:
    """The oracle's cost is linear in λ. Its optimum is a lower envelope of lines in λ, one for each
    plan: where other plans become better it bends down, below the line through its values at the
    two smallest λ."""
    one = episodes[episodes["solver"] == episodes["solver"].iloc[0]]
    costs = one[np.isfinite(one["oracle"])].pivot_table("oracle", "seed", "lambda").dropna()
    if len(costs.columns) < 3 or not len(costs):
        return
    first, second, last = (costs.columns[i] for i in (0, 1, -1))
    slope = (costs[second] - costs[first]) / (second - first)
    line = costs[first] + slope * (last - first)
    below = (line - costs[last]) / costs[last].mean()
    figure = f"share of the oracle's cost at λ = {last:g} by which it is below the line"
    estimate = clustered_mean(below, below.index)
    yield Claim(domain, "the oracle's cost is linear in λ", figure, estimate, (-ALIKE, ALIKE))


def _types(domain: str, data_sets: pd.DataFrame) -> Iterator[Claim]:
    """The types are found, in most data sets. Those of one seed share their people."""
    data_sets = data_sets.dropna(subset=["adjusted_rand_index"])
    if len(data_sets):
        exact = data_sets["adjusted_rand_index"] == 1.0
        figure = f"share of {len(exact)} data sets whose types are found exactly"
        share = clustered_share(exact, data_sets["seed"])
        yield Claim(domain, "the types are found", figure, share, (0.5, math.inf))


def table(tested: Iterable[Claim]) -> Table:
    """Claims with their figures and verdicts."""
    rows = tuple(
        (
            Cell(title(claim.domain)),
            Cell(claim.text),
            Cell(f"{claim.figure}: {number(claim.estimate.mean)}"),
            Cell(interval(claim.estimate)),
            Cell(claim.verdict, look=_LOOKS.get(claim.verdict, "")),
        )
        for claim in tested
    )
    return Table(("Domain", "Claim", "Figure", "95 % interval", "Verdict"), rows, 5)


_LOOKS = {"holds": "yes", "does not hold": "no"}
