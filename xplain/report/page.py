"""One self-contained HTML page of a sweep: tables, plots and pictures, nothing loaded from
elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from xplain.report import claims, comparison, decomposition, learning
from xplain.report.combinations import heading
from xplain.report.layout import shown_keys
from xplain.report.paper import title
from xplain.report.story import counted
from xplain.report.summary import Summary


@dataclass(frozen=True)
class CaptionedImage:
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
    """The pictures of the page, by section.

    Attributes:
        plots: of measures against the main swept key, the sweep's own measure first.
        types: of the learning stage.
        traces: of one explanation a domain.
        commands: by domain, what shows that explanation as a page to step through.
    """

    plots: list[CaptionedImage] = field(default_factory=list)
    types: list[CaptionedImage] = field(default_factory=list)
    traces: dict[str, list[CaptionedImage]] = field(default_factory=dict)
    commands: dict[str, str] = field(default_factory=dict)


def page(summary: Summary, pictures: Pictures) -> str:
    """HTML of the whole page, with all that it shows inside it."""
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
        answer=comparison.answer(summary),
        command=about["command"],
        code=f"{about['code']} (commit {commit}{dirty})",
        size=_size(summary),
        is_table1=is_table1,
        table=comparison.main_table(summary),
        undecided=comparison.undecided(summary),
        **(_beside_table1(summary) if is_table1 else {}),
        figures=pictures,
        learning=learning.table(summary),
        messages=[
            {
                "domain": title(domain),
                "sentences": sorted(
                    (name.replace("_", " "), text)
                    for name, text in _messages(summary, domain).items()
                ),
                "figures": found,
                "command": pictures.commands[domain],
            }
            for domain, found in pictures.traces.items()
        ],
    )


def _beside_table1(summary: Summary) -> dict[str, Any]:
    """What the page shows besides where it has the paper's layout."""
    tested = claims.claims(summary.episodes, learning.data_sets(summary))
    return {
        "claims": claims.table(tested),
        "parts": decomposition.table(summary),
    }


def _messages(summary: Summary, domain: str) -> Mapping[str, str]:
    """``{message: its sentence}`` of a domain."""
    return next(own.messages for _, own in summary.results if own.domain == domain)


def _heading(summary: Summary) -> str:
    if summary.report == "table1":
        return "Personalized explanations: costs and regrets"
    measure = summary.measure.title
    swept = [heading(key).lower() for key in shown_keys(summary)]
    named = measure[0].upper() + measure[1:]
    return f"{named} by {', '.join(swept)}" if swept else named


def _size(summary: Summary) -> str:
    episodes = len(summary.episodes)
    return (
        f"{len(summary.results)} of {len(summary.jobs)} jobs, {episodes:,} episodes, "
        f"{counted(summary.seeds, 'seed')}"
    )
