"""One self-contained HTML page of a sweep: tables, plots, pictures and episodes, nothing loaded
from elsewhere."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

from xplain.experiment.results import EPISODES, Results
from xplain.interaction.statistics import Estimate
from xplain.report import claims, comparison, decomposition, learning, paper_table
from xplain.report.combinations import grouped, heading, value_label, value_title
from xplain.report.layout import plot_layout, shown_keys, table_layout
from xplain.report.measure import TITLES
from xplain.report.paper import title
from xplain.report.story import counted
from xplain.report.summary import Summary
from xplain.report.sweep_plots import AXES, by_step, has_roots, middle
from xplain.storage import encode

MOST_EPISODES = 40_000_000
"""Bytes of episodes (they shrink to a twentieth) that a page may hold."""


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
    """The pictures of the page, by section."""

    types: list[CaptionedImage] = field(default_factory=list)
    traces: dict[str, list[CaptionedImage]] = field(default_factory=dict)


def page(summary: Summary, pictures: Pictures) -> str:
    """HTML of the whole page, with all that it shows inside it."""
    from jinja2 import Environment, StrictUndefined

    source, script, player = (
        files("xplain.report").joinpath(name).read_text(encoding="utf-8")
        for name in ("page.html", "page.js", "player.html")
    )
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
            }
            for domain, found in pictures.traces.items()
        ],
        script=script,
        plots=_plain(_plots(summary)),
        episodes=packed(list(_episodes(summary))),
        player=packed(player),
    )


def _beside_table1(summary: Summary) -> dict[str, Any]:
    """What the page shows besides where it has the paper's layout."""
    tested = claims.claims(summary.episodes, learning.data_sets(summary))
    return {
        "claims": claims.table(tested),
        "parts": decomposition.table(summary),
        "ranges": paper_table.ranges(summary),
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


def packed(content: Any) -> str:
    """JSON, compressed, in letters: what a script takes out again."""
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()


def _plain(content: Any) -> str:
    """JSON that nothing inside a script element can end."""
    return json.dumps(content, ensure_ascii=False).replace("<", "\\u003c")


def _plots(summary: Summary) -> dict[str, Any]:
    """What the script draws and filters: a cell a combination of the shown keys."""
    layout, table = plot_layout(summary), table_layout(summary)
    keys = [*([layout.x] if layout.x else []), *layout.lines, *layout.panels]
    values = {key: summary.values(key) for key in keys}
    names = dict.fromkeys((summary.measure.name, "cost", *summary.counted))
    cells = []
    for at, frame in grouped(summary, keys):
        beliefs, episodes = by_step(summary, "belief_in_true_type", at)
        if at.get("solver") == "baseline":
            beliefs = beliefs[:0]  # it believes nothing
        estimates = {name: summary.estimate(frame, name) for name in names}
        cells.append(
            {
                "at": [values[key].index(at[key]) for key in keys],
                "of": {name: _ends(own) for name, own in estimates.items() if own is not None},
                "belief": [round(float(value), 4) for value in beliefs],
                "episodes": [int(count) for count in episodes],
            }
        )
    across = [at for at, _ in grouped(summary, table.across)] if table.down else []
    return {
        "keys": [
            {
                "name": heading(key),
                "axis": AXES.get(key, heading(key)),
                "values": [value_title(key, value) or "–" for value in values[key]],
                "labels": [value_label(key, value) or "–" for value in values[key]],
                "numbers": values[key] if layout.numeric and key == layout.x else None,
                "middle": values[key].index(middle(summary, key)),
            }
            for key in keys
        ],
        "x": layout.x is not None,
        "lines": len(layout.lines),
        "alike": "domain" not in layout.panels,
        "roots": has_roots(summary),
        "measures": [{"name": name, "title": TITLES[name]} for name in names],
        "cells": cells,
        "down": [keys.index(key) for key in table.down or table.across],
        "across": [[[keys.index(key), values[key].index(at[key])] for key in at] for at in across],
        "before": int(summary.measure.reference is not None),
        "filters": summary.report != "table1",
    }


def _ends(own: Estimate) -> list[float | None]:
    ends = (own.mean, own.low, own.high)
    return [None if math.isnan(value) else round(value, 6) for value in ends]


def _episodes(summary: Summary) -> Iterator[Mapping[str, Any]]:
    """Every job with its episodes, as the player takes them; the first of all jobs where they are
    too many for a page."""
    jobs = [(job, results, _lines(summary, job)) for job, results in summary.results]
    most = MOST_EPISODES // max(len(jobs), 1)
    for job, results, lines in jobs:
        kept: list[dict[str, Any]] = []
        size = 0
        for line in lines:
            size += len(line)
            if kept and size > most:
                break
            kept.append(_episode(json.loads(line), results))
        yield {
            "label": job["label"],
            "domain": results.domain,
            "solver": title(results.solver),
            "tradeOff": results.trade_off,
            "sentences": results.messages,
            "scene": encode(results.scene),
            "titles": {name: name.replace("_", " ") for name in results.types.found},
            "told": "The values behind a choice are not kept in a sweep; the demo shows them.",
            "believes": [],
            "chosen": "",
            "of": len(lines),
            "episodes": kept,
        }


def _lines(summary: Summary, job: Mapping[str, Any]) -> list[str]:
    path = summary.folder_of(job) / EPISODES
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return [line for line in text.splitlines() if '"solver": "solver"' in line]


def _episode(line: Mapping[str, Any], results: Results) -> dict[str, Any]:
    """One line of ``episodes.jsonl`` as the player takes it."""
    types, config = results.types, results.config
    alike = dict(zip(types.true, types.behave_alike, strict=True)).get(line["type"])
    named = types.found if len(line["prior"]) == len(types.found) else ()
    price, bad = config.get("message_cost", 1.0), config.get("inexplicability_cost", 1.0)
    worth = config.get("ask", {}).get("cost", 0.0)
    factor = config.get("again", {}).get("price", 1.0)
    steps, cost, said = [], 0.0, set[str]()
    for step in line["steps"]:
        own = [
            (price[name] if isinstance(price, Mapping) else price) * (factor if name in said else 1)
            for name in step["messages"]
        ]
        said |= {*step["messages"]}
        asked = step.get("questions", [])
        cost += results.trade_off * sum(own) + bad * step["labels"].count(0) + worth * len(asked)
        belief = dict(zip(named, step["belief"], strict=False))
        page = {"said": step["messages"], "labels": step["labels"], "values": [], "asked": asked}
        steps.append({**page, "belief": belief, "cost": round(cost, 6)})
    found = zip(types.found, types.stands_for, strict=True)
    return {
        "trace": line["trace"],
        "user": line["type"],
        "cost": line["cost"],
        "right": [name for name, of in found if of == alike and len(types.found) > 1],
        "phrases": line["transitions"],
        "positions": line["positions"],
        "changes": line.get("changes", []),
        "prior": dict(zip(named, line["prior"], strict=False)),
        "steps": steps,
    }
