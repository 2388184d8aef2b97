"""One self-contained HTML page of a sweep: tables, plots and pictures, nothing loaded from
elsewhere."""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from xplain.report import claims, comparison, decomposition, learning, paper_table
from xplain.report.combinations import heading
from xplain.report.layout import shown_keys
from xplain.report.paper import title
from xplain.report.summary import Summary


@dataclass(frozen=True)
class Picture:
    """An image file with its caption."""

    path: Path
    caption: str

    @property
    def address(self) -> str:
        """The image itself, as a ``data:`` address."""
        kind = {".svg": "image/svg+xml", ".png": "image/png"}[self.path.suffix]
        return f"data:{kind};base64,{base64.b64encode(self.path.read_bytes()).decode()}"


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

    source = files("xplain.report").joinpath("page.html").read_text(encoding="utf-8")
    about, git = summary.about, summary.about["git"]
    commit = git.get("commit", "")[:12] or "no commit"
    dirty = " with changes" if git.get("dirty") == "true" else ""
    is_table1 = summary.report == "table1"
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(source)
    return template.render(
        summary=summary,
        name=summary.folder.name,
        heading=_heading(summary),
        command=about["command"],
        code=f"{about['code']} (commit {commit}{dirty})",
        size=_size(summary),
        is_table1=is_table1,
        table=comparison.main_table(summary),
        claims=claims.table(claims.claims(summary.episodes, summary.data_sets)),
        parts=decomposition.table(summary),
        ranges=paper_table.ranges(summary),
        figures=pictures,
        learning=learning.table(summary),
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


def _size(summary: Summary) -> str:
    episodes = len(summary.episodes)
    return (
        f"{len(summary.results)} of {len(summary.jobs)} jobs, {episodes:,} episodes, "
        f"{summary.seeds} seed{'s' if summary.seeds != 1 else ''}"
    )
