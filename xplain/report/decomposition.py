"""What a cost is made of: the floor, not knowing the type, and what was learned.

Every job explains each trace to each user four times: with what was learned, with the true types
and labels (only the type of the user is then unknown), as the oracle, and as the clairvoyant.
The differences, on the same traces and users, add up to the cost.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from xplain.interaction.statistics import Estimate, clustered_mean
from xplain.report.paper import title
from xplain.report.summary import Summary
from xplain.report.table import Cell, Table

PARTS = {
    "Clairvoyant's cost": ("clairvoyant", None),
    "+ type unknown": ("true labels", "clairvoyant"),
    "+ labels learned": ("cost", "true labels"),
    "= cost": ("cost", None),
    "Oracle − clairvoyant": ("oracle", "clairvoyant"),
}
"""(column of the episodes, less this one)."""


def parts(summary: Summary) -> Iterator[tuple[str, str, float, dict[str, Estimate]]]:
    """(domain, method, λ, PARTS with intervals), in the order of domains, methods and λ; methods
    that no job ran with true labels are left out."""
    frame = summary.episodes.dropna(subset=["oracle", "clairvoyant", "true labels"])
    groups: Any = frame.groupby(["domain", "method", "lambda"], sort=False)
    domains, methods = summary.domains.index, summary.methods.index
    order = sorted(groups, key=lambda one: (domains(one[0][0]), methods(one[0][1]), one[0][2]))
    for (domain, method, trade_off), own in order:
        estimates = {
            name: clustered_mean(own[one] - own[less] if less else own[one], summary.clusters(own))
            for name, (one, less) in PARTS.items()
        }
        yield domain, method, trade_off, estimates


def table(summary: Summary) -> Table:
    """The parts of each method's cost."""
    rows = tuple(
        (
            *map(Cell, (title(domain), title(method), f"{trade_off:g}")),
            *(Cell(estimate=estimate) for estimate in estimates.values()),
        )
        for domain, method, trade_off, estimates in parts(summary)
    )
    caption = (
        "What costs are made of: the clairvoyant's cost; what not knowing the user's type adds "
        "where types and labels are true; what learned labels and types add to that. Beside it, "
        "what learned labels add for the oracle, who knows the type. 95 % intervals over "
        f"{summary.unit} in brackets."
    )
    return Table(("Domain", "Method", "λ", *PARTS), rows, 3, caption)
