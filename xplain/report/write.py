"""Writes the report of a sweep: tables, plots, pictures, one page."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from xplain.experiment.results import Results
from xplain.report import claims, comparison, decomposition, learning, paper_table
from xplain.report.combinations import differences_csv, heading, regret_csv
from xplain.report.layout import plot_layout
from xplain.report.measure import TITLES
from xplain.report.page import CaptionedImage, Pictures, page
from xplain.report.paper import title
from xplain.report.summary import Summary, rank
from xplain.storage import write_text

REPORT = "report"

CSV_OF_COMBINATIONS = "regret.csv"


def write_report(folder: Path, measure: str | None = None) -> tuple[Summary, Path]:
    """Makes everything below ``<sweep>/report`` anew from the finished jobs.

    Args:
        folder: of the sweep.
        measure: see :class:`Summary`.

    Raises:
        OSError, ValueError: this is no sweep's folder, or it cannot be written.
    """
    summary = Summary(folder, measure)
    report = folder / REPORT
    report.mkdir(exist_ok=True)
    if summary.results:
        for name, text in _tables(summary):
            write_text(report / name, text)
        write_text(report / "index.html", page(summary, draw(summary, report)))
    return summary, report


def _tables(summary: Summary) -> Iterator[tuple[str, str]]:
    """(file, content)."""
    yield CSV_OF_COMBINATIONS, regret_csv(summary)
    yield "differences.csv", differences_csv(summary)
    yield "table.md", comparison.table(summary).markdown()
    yield "undecided.md", comparison.undecided(summary).markdown()
    yield "table.tex", comparison.table(summary).latex()
    if summary.report == "table1":
        for name, measure in (("table1", "regret"), ("table1_clairvoyant", "above_floor")):
            yield f"{name}.md", paper_table.table(summary, measure=measure).markdown()
            yield f"{name}.csv", paper_table.as_csv(summary, measure)
        yield "table1.tex", paper_table.table(summary).latex()
        yield "table1_by_setting.md", paper_table.table(summary, by_setting=True).markdown()
        tested = claims.claims(summary.episodes, learning.data_sets(summary))
        yield "claims.md", claims.table(tested).markdown()
        yield "decomposition.md", decomposition.table(summary).markdown()


def draw(summary: Summary, report: Path) -> Pictures:
    """Draws every plot and picture into the folder."""
    from xplain.report import plots, sweep_plots, traces

    pictures, key = Pictures(), heading(plot_layout(summary).x or "")
    drawn = []
    for name in (summary.measure.name, "messages", "inexplicable labels"):
        file = "regret" if name == summary.measure.name else name.partition(" ")[0]
        caption = f"{TITLES[name][0].upper()}{TITLES[name][1:]} against {key}"
        figure = sweep_plots.against_main_key(summary, name, TITLES[name])
        drawn.append((file, caption, figure))
    caption = "Belief in the user's true type over steps"
    drawn.append(("belief", caption, sweep_plots.belief_over_steps(summary)))
    for file, caption, figure in drawn:
        if figure is not None:
            plots.save(figure, report / f"{file}.svg")
            pictures.plots.append(CaptionedImage(report / f"{file}.svg", caption))
    disagreements = plots.elbows(summary)
    if disagreements is not None:
        plots.save(disagreements, report / "disagreements.svg")
        caption = (
            "Disagreements of labels within clusters against the number of clusters; rings mark "
            "the numbers of user types that were chosen."
        )
        pictures.types.append(CaptionedImage(report / "disagreements.svg", caption))
    for domain in summary.domains:
        job, results = _example(summary, domain)
        folder, path = summary.address(job), report / f"trace_{domain}.png"
        figure, story, which = traces.draw_typical(folder, results.scene)
        plots.save(figure, path)
        whose = f"{title(results.solver)}, λ = {results.trade_off:g} (job “{job['label']}”)"
        caption = f"{title(domain)}, {whose}: {which}."
        pictures.traces[domain] = [CaptionedImage(path, caption)]
        words = [*job["overrides"], "--trace", str(story.trace), "--user", story.user_type]
        pictures.commands[domain] = shlex.join(["python", "-m", "xplain", "demo", *words])
    return pictures


def _example(summary: Summary, domain: str) -> tuple[dict[str, Any], Results]:
    """One job of a domain: at λ = 1 where that was run, else at the middle one, with the solver
    that comes first."""
    own = [one for one in summary.results if one[1].domain == domain]
    trade_offs = sorted({results.trade_off for _, results in own})
    middle = 1.0 if 1.0 in trade_offs else trade_offs[len(trade_offs) // 2]
    at = [one for one in own if one[1].trade_off == middle]
    return min(at, key=lambda one: (rank(one[1].solver), one[1].solver))
