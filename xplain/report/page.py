"""One self-contained HTML page of a sweep: tables, plots and pictures, nothing loaded from
elsewhere."""

from __future__ import annotations

import base64
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from xplain.report import decomposition, tables
from xplain.report.claims import claims
from xplain.report.combinations import heading
from xplain.report.layout import shown_keys
from xplain.report.learning import learning
from xplain.report.paper import title
from xplain.report.regret_table import Cell, regret_table, table_caption
from xplain.report.summary import Summary
from xplain.report.tables import Entry, interval, number, signed

CLAIMS = (
    ("pomcp_paper", "qmdp", "POMCP minus QMDP: about the same", 0),
    ("pomcp", "qmdp", "POMCP (ours) minus QMDP", 0),
    ("qhr", "qmdp", "QHR minus QMDP: costs more", 1),
    ("qhr", "pomcp_paper", "QHR minus POMCP: costs more", 1),
    ("baseline", "qmdp", "Baseline minus QMDP: costs far more", 1),
    ("baseline", "pomcp_paper", "Baseline minus POMCP: costs far more", 1),
    ("baseline", "qhr", "Baseline minus QHR: costs far more", 1),
)
"""(method, minus this one, what the paper says, the sign that it says)."""

LEARNING = {
    "true_types": "types",
    "types_found": "found",
    "adjusted_rand_index": "adjusted Rand index",
    "labeler_accuracy": "labelers right",
    "fresh_accuracy": "on fresh questions",
    "everyone_accuracy": "one labeler for all right",
}


@dataclass(frozen=True)
class Picture:
    """An image file with its caption."""

    path: Path
    caption: str


@dataclass
class Pictures:
    """The pictures of the page, by section."""

    regret: list[Picture] = field(default_factory=list)
    diagnostics: list[Picture] = field(default_factory=list)
    types: list[Picture] = field(default_factory=list)
    traces: dict[str, list[Picture]] = field(default_factory=dict)


def page(summary: Summary, pictures: Pictures) -> str:
    """HTML of the whole page, with every picture inside it."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup, escape

    def show(picture: Picture) -> Markup:
        kind = {".svg": "image/svg+xml", ".png": "image/png"}[picture.path.suffix]
        data = base64.b64encode(picture.path.read_bytes()).decode()
        return Markup(
            '<figure><img alt="{0}" src="data:{1};base64,{2}"><figcaption>{0}</figcaption></figure>'
        ).format(escape(picture.caption), kind, data)

    source = files("xplain.report").joinpath("page.html").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.globals["show"] = show
    about = summary.about
    commit = about["git"].get("commit", "")[:12] or "no commit"
    dirty = " with changes" if about["git"].get("dirty") == "true" else ""
    return environment.from_string(source).render(
        name=summary.folder.name,
        heading=_heading(summary),
        command=about["command"],
        code=f"{about['code']} (commit {commit}{dirty})",
        size=_size(summary),
        jobs=len(summary.jobs),
        missing=summary.missing,
        failures=summary.failures,
        table=None if summary.report == "table1" else _own_table(summary),
        table1=_table1(summary) if summary.report == "table1" else None,
        figures=pictures,
        learning=_learning(summary),
        messages=[
            {
                "domain": title(domain),
                "sentences": sorted(
                    (name.replace("_", " "), text)
                    for name, text in summary.messages(domain).items()
                ),
                "figures": found,
            }
            for domain, found in pictures.traces.items()
        ],
    )


def _heading(summary: Summary) -> str:
    if summary.report == "table1":
        return "Personalized explanations: costs and regrets"
    swept = [heading(key).lower() for key in shown_keys(summary)]
    return f"Regret by {', '.join(swept)}" if swept else "Regret"


def _own_table(summary: Summary) -> dict[str, Any]:
    """The sweep's table: what was swept is what is shown."""
    table = regret_table(summary)
    return {
        "about": table.about,
        "heads": [
            *((heading(key), True) for key in table.down),
            *((h, False) for h in table.heads),
        ],
        "rows": [
            {"headings": table.headings(i), "cells": [_own_cell(cell) for cell in row.cells]}
            for i, row in enumerate(table.rows)
        ],
        "caption": table_caption(summary, table, brackets=True),
    }


def _own_cell(cell: Cell | None) -> dict[str, str] | None:
    if cell is None:
        return None
    return {
        "mean": number(cell.estimate.mean),
        "interval": interval(cell.estimate) if number(cell.estimate.low) else "",
        "mark": cell.mark,
    }


def _table1(summary: Summary) -> dict[str, Any]:
    """Table 1 beside the paper's, what it claims, and the range over pooled settings."""
    keys = tables.columns(summary)
    return {
        "columns": [title(key) for key in keys],
        "rows": list(_table(summary, keys)),
        "caption": tables.caption(summary),
        "claims": list(_claims(summary)),
        "verdicts": list(_verdicts(summary)),
        "parts": decomposition.rows(summary),
        "parts_heads": decomposition.HEADS,
        "parts_caption": decomposition.caption(summary),
        "ranges": list(_ranges(summary, keys)),
    }


def _verdicts(summary: Summary) -> Iterator[dict[str, str]]:
    """Every claim of the paper that the sweep's methods allow to test."""
    for claim in claims(summary.episodes, summary.types_found()):
        yield {
            "domain": title(claim.domain),
            "text": claim.text,
            "figure": claim.figure,
            "mean": number(claim.estimate.mean),
            "interval": interval(claim.estimate) if number(claim.estimate.low) else "",
            "verdict": claim.verdict,
            "look": {"holds": "yes", "does not hold": "no"}.get(claim.verdict, ""),
        }


def _size(summary: Summary) -> str:
    episodes = len(summary.episodes)
    return (
        f"{len(summary.results)} of {len(summary.jobs)} jobs, {episodes:,} episodes, "
        f"{summary.seeds} seed{'s' if summary.seeds != 1 else ''}"
    )


def _table(summary: Summary, keys: list[str]) -> Iterator[dict[str, Any]]:
    last = ""
    for domain, _, trade_off, numbers in tables.grid(summary):
        own = {entry.column: entry for entry in numbers}
        yield {
            "domain": title(domain) if domain != last else "",
            "trade_off": f"{trade_off:g}",
            "cells": [_cell(own.get(key)) for key in keys],
        }
        last = domain


def _cell(entry: Entry | None) -> dict[str, str] | None:
    if entry is None:
        return None
    known = number(entry.estimate.low)
    return {
        "mean": number(entry.estimate.mean),
        "interval": interval(entry.estimate) if known else "",
        "paper": "" if entry.paper is None else f"{entry.paper:.2f}",
        "difference": signed(entry.difference),
    }


def _claims(summary: Summary) -> Iterator[dict[str, Any]]:
    differences = {
        (domain, trade_off, method, other): estimate
        for domain, trade_off, method, other, estimate in summary.differences()
    }
    for domain in summary.domains:
        rows = []
        for method, other, words, sign in CLAIMS:
            cells = []
            for trade_off in summary.trade_offs:
                estimate = differences.get((domain, trade_off, method, other))
                if estimate is None:
                    estimate = differences.get((domain, trade_off, other, method))
                    if estimate is None:
                        break
                    estimate = estimate.negated()
                sure = 1 if estimate.low > 0 else -1 if estimate.high < 0 else 0
                look = "yes" if sign and sure == sign else "no" if sure else ""
                cells.append(
                    {
                        "mean": signed(estimate.mean),
                        "interval": interval(estimate) if number(estimate.low) else "",
                        "look": look,
                        "star": " *" if _apart(summary, domain, trade_off, method, other) else "",
                    }
                )
            if len(cells) == len(summary.trade_offs):
                rows.append({"words": words, "cells": cells})
        if rows:
            trade_offs = [f"{trade_off:g}" for trade_off in summary.trade_offs]
            yield {"domain": title(domain), "trade_offs": trade_offs, "rows": rows}


def _apart(summary: Summary, domain: str, trade_off: float, method: str, other: str) -> bool:
    """Whether the intervals of two regrets do not overlap."""
    one = summary.estimate("regret", domain, trade_off, method)
    two = summary.estimate("regret", domain, trade_off, other)
    if one is None or two is None:
        return False
    return one.estimate.low > two.estimate.high or two.estimate.low > one.estimate.high


def _ranges(summary: Summary, keys: list[str]) -> Iterator[dict[str, Any]]:
    """Least, median and greatest over a domain's settings, where it has several."""
    entries = list(tables.entries(summary, by_setting=True))
    for domain in summary.domains:
        settings = summary.settings(domain)
        if len(settings) < 2:
            continue
        rows = []
        for trade_off in summary.trade_offs:
            cells = []
            for key in keys:
                own = [
                    e
                    for e in entries
                    if (e.domain, e.trade_off, e.column) == (domain, trade_off, key)
                ]
                means = [e.estimate.mean for e in own] or [float("nan")]
                low, high = min(means), max(means)
                paper = own[0].paper if own else None
                cells.append(
                    {
                        "words": f"{number(low)} … {number(statistics.median(means))} … "
                        f"{number(high)}",
                        "paper": "" if paper is None else f"{paper:.2f}",
                        "where": "" if paper is None else _where(paper, low, high),
                    }
                )
            rows.append({"trade_off": f"{trade_off:g}", "cells": cells})
        yield {
            "domain": title(domain),
            "count": len(settings),
            "settings": "; ".join(settings) if len(settings) <= 6 else "",
            "rows": rows,
        }


def _where(paper: float, low: float, high: float) -> str:
    if paper < low:
        return ", below"
    return ", above" if paper > high else ", inside"


def _learning(summary: Summary) -> dict[str, Any] | None:
    figures = learning(summary)
    heads = [key for key in LEARNING if any(key in own for own in figures.values())]
    rows = []
    for (domain, setting), own in figures.items():
        name = " ".join(filter(None, [title(domain), setting]))
        rows.append({"name": name, "cells": [_figure(key, own.get(key)) for key in heads]})
    return {"heads": [LEARNING[key] for key in heads], "rows": rows} if rows else None


def _figure(key: str, value: float | None) -> str:
    if value is None:
        return ""
    if key.endswith("accuracy"):
        return f"{value:.1%}"
    return f"{value:g}" if float(value).is_integer() else f"{value:.2f}"
