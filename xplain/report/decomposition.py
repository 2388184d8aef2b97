"""What a cost is made of: the floor, not knowing the type, and what was learned.

Every job explains each trace to each user four times: with what was learned, with the true types
and labels (only the type of the user is then unknown), as the oracle, and as the clairvoyant.
The differences, on the same traces and users, add up to the cost.
"""

from __future__ import annotations

from collections.abc import Iterator

from xplain.interaction.statistics import Estimate, clustered_mean
from xplain.report.combinations import grouped, value_title
from xplain.report.summary import Summary, Value
from xplain.report.table import Cell, Table

PARTS = {
    "Clairvoyant's cost": ("clairvoyant", None),
    "+ type unknown": ("true labels", "clairvoyant"),
    "+ labels learned": ("cost", "true labels"),
    "= cost": ("cost", None),
    "Oracle − clairvoyant": ("oracle", "clairvoyant"),
}
"""(column of the episodes, less this one)."""


def parts(summary: Summary) -> Iterator[tuple[dict[str, Value], dict[str, Estimate]]]:
    """(values of domain, solver and λ; PARTS with intervals), in their order; solvers that no job
    ran with true labels are left out."""
    for values, frame in grouped(summary, ("domain", "solver", "lambda")):
        own = frame.dropna(subset=["oracle", "clairvoyant", "true labels"])
        if len(own):
            clusters = summary.clusters(own)
            estimates = {
                name: clustered_mean(own[one] - own[less] if less else own[one], clusters)
                for name, (one, less) in PARTS.items()
            }
            yield values, estimates


def table(summary: Summary) -> Table:
    """The parts of each solver's cost."""
    rows = tuple(
        (
            *(Cell(value_title(key, value)) for key, value in values.items()),
            *(Cell(estimate=estimate) for estimate in estimates.values()),
        )
        for values, estimates in parts(summary)
    )
    caption = (
        "What costs are made of: the clairvoyant's cost; what not knowing the user's type adds "
        "where types and labels are true; what learned labels and types add to that. Beside it, "
        "what learned labels add for the oracle, who knows the type. 95 % intervals over "
        f"{summary.unit} in brackets."
    )
    return Table(("Domain", "Method", "λ", *PARTS), rows, 3, caption)
