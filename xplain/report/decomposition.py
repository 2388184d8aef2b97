"""What a cost is made of: the floor, not knowing the type, and what was learned.

Every job explains each trace to each user four times: with what was learned, with the true types
and labels (only the type of the user is then unknown), as the oracle, and as the clairvoyant.
The differences, on the same traces and users, add up to the cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from xplain.evaluation.statistics import Estimate, clustered_mean
from xplain.report.paper import title
from xplain.report.summary import Summary
from xplain.report.tables import interval, number


class Parts(NamedTuple):
    """What one method's cost is made of, at one λ of a domain: means with intervals.

    Attributes:
        domain, method, trade_off: whose.
        floor: the clairvoyant's cost.
        type_unknown: the cost with true types and labels, less the floor: what not knowing the
            user's type costs with this solver.
        learned: the cost less that with true types and labels: what labelers, and types found,
            cost.
        cost: the sum of the three.
        oracle: the oracle's cost less the floor: what labelers cost who knows the type.
    """

    domain: str
    method: str
    trade_off: float
    floor: Estimate
    type_unknown: Estimate
    learned: Estimate
    cost: Estimate
    oracle: Estimate


HEADS = (
    "Domain",
    "Method",
    "λ",
    "Clairvoyant's cost",
    "+ type unknown",
    "+ labels learned",
    "= cost",
    "Oracle − clairvoyant",
)


def parts(summary: Summary) -> Iterator[Parts]:
    """By domain, method and λ; methods that no job ran with true labels are left out."""
    references = ["oracle", "clairvoyant", "true labels"]
    frame = summary.episodes.dropna(subset=references)
    groups: Any = frame.groupby(["domain", "method", "lambda"], sort=False)
    for (domain, method, trade_off), own in groups:
        clusters = summary.clusters(own)
        columns = (
            own["clairvoyant"],
            own["true labels"] - own["clairvoyant"],
            own["cost"] - own["true labels"],
            own["cost"],
            own["oracle"] - own["clairvoyant"],
        )
        estimates = (clustered_mean(column, clusters) for column in columns)
        yield Parts(domain, method, float(trade_off), *estimates)


def rows(summary: Summary) -> list[list[str]]:
    """The parts in words below :data:`HEADS`, in the order of domains, methods and λ."""
    found = sorted(
        parts(summary),
        key=lambda p: (
            summary.domains.index(p.domain),
            summary.methods.index(p.method),
            p.trade_off,
        ),
    )
    texts = []
    for one in found:
        numbers = (one.floor, one.type_unknown, one.learned, one.cost, one.oracle)
        words = [title(one.domain), title(one.method), f"{one.trade_off:g}"]
        texts.append([*words, *map(_text, numbers)])
    return texts


def caption(summary: Summary) -> str:
    """How to read the rows."""
    unit = "seeds" if summary.seeds > 1 else "traces"
    return (
        "What costs are made of: the clairvoyant's cost; what not knowing the user's type adds "
        "where types and labels are true; what learned labels and types add to that. Beside it, "
        "what learned labels add for the oracle, who knows the type. 95 % intervals over "
        f"{unit} in brackets."
    )


def markdown(summary: Summary) -> str:
    """A table of the parts, with its caption."""
    lines = ["| " + " | ".join(HEADS) + " |", "|" + "---|" * len(HEADS)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(summary)]
    return "\n".join([*lines, "", caption(summary), ""])


def _text(estimate: Estimate) -> str:
    known = number(estimate.low)
    return f"{number(estimate.mean)} {interval(estimate)}" if known else number(estimate.mean)
