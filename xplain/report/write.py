"""Writes the report of a sweep: tables, plots, pictures, one page."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from xplain.report import claims, decomposition, regret_table, tables
from xplain.report.combinations import differences_csv, regret_csv
from xplain.report.page import Picture, Pictures, page
from xplain.report.paper import title
from xplain.report.summary import Summary
from xplain.storage import write_text

REPORT = "report"

CSV_OF_COMBINATIONS = "regret.csv"


def write_report(folder: Path) -> tuple[Summary, Path]:
    """Makes everything below ``<sweep>/report`` anew from the finished jobs.

    Raises:
        OSError, ValueError: this is no sweep's folder, or it cannot be written.
    """
    summary = Summary(folder)
    report = folder / REPORT
    report.mkdir(exist_ok=True)
    if summary.results:
        write_text(report / CSV_OF_COMBINATIONS, regret_csv(summary))
        write_text(report / "differences.csv", differences_csv(summary))
        write_text(report / "table.md", regret_table.markdown(summary))
        write_text(report / "table.tex", regret_table.latex(summary))
        if summary.report == "table1":
            write_text(report / "table1.md", tables.markdown(summary))
            write_text(report / "table1.tex", tables.latex(summary))
            write_text(report / "table1.csv", tables.as_csv(summary))
            _write_more_of_table1(summary, report)
        write_text(report / "index.html", page(summary, draw(summary, report)))
    return summary, report


def _write_more_of_table1(summary: Summary, report: Path) -> None:
    """Beside the paper's table: a row a setting, regret to the clairvoyant, what the paper claims,
    and what costs are made of."""
    to_floor = "regret to clairvoyant"
    write_text(report / "table1_by_setting.md", tables.markdown(summary, by_setting=True))
    write_text(report / "table1_clairvoyant.md", tables.markdown(summary, measure=to_floor))
    write_text(report / "table1_clairvoyant.csv", tables.as_csv(summary, to_floor))
    tested = claims.claims(summary.episodes, summary.types_found())
    write_text(report / "claims.md", claims.markdown(tested))
    write_text(report / "decomposition.md", decomposition.markdown(summary))


def draw(summary: Summary, report: Path) -> Pictures:
    """Draws every plot and picture into the folder."""
    from xplain.report import plots, sweep_plots

    pictures = Pictures()
    drawn = [
        (
            pictures.regret,
            "regret",
            sweep_plots.against_main_key(summary, "regret", "regret (cost − oracle’s)"),
            sweep_plots.regret_caption(summary),
        ),
        (
            pictures.diagnostics,
            "messages",
            sweep_plots.against_main_key(summary, "messages", "messages an episode"),
            "Messages given in an episode, mean over traces and users.",
        ),
        (
            pictures.diagnostics,
            "inexplicable",
            sweep_plots.against_main_key(
                summary, "inexplicable labels", "inexplicable labels an episode"
            ),
            "Labels “inexplicable” in an episode, summed over its steps, mean over traces and "
            "users.",
        ),
        (
            pictures.types,
            "disagreements",
            plots.elbows(summary),
            "Disagreements of labels within clusters against the number of clusters; rings mark "
            "the numbers of user types that were chosen.",
        ),
        (
            pictures.types,
            "belief",
            sweep_plots.belief_over_steps(summary),
            "Belief in the user’s true type after each step, mean over the traces that last so "
            "long.",
        ),
    ]
    for section, name, figure, caption in drawn:
        if figure is not None:
            plots.save(figure, report / f"{name}.svg")
            section.append(Picture(report / f"{name}.svg", caption))
    for domain, path, caption in _trace_pictures(summary, report):
        pictures.traces.setdefault(domain, []).append(Picture(path, caption))
    return pictures


def _trace_pictures(summary: Summary, report: Path) -> Iterator[tuple[str, Path, str]]:
    """(domain, picture, caption): one trace a domain, explained to two types of users, one who
    needs many messages and one who needs few."""
    from xplain.report import traces

    for domain in summary.domains:
        found = summary.example(domain)
        if found is None:
            continue
        folder, label, results = found
        for story in traces.telling(list(traces.stories(folder, "solver"))):
            path = report / f"trace_{domain}_{story.user_type}.png"
            traces.save_trace(path, results.scene, story)
            yield (
                domain,
                path,
                f"{title(domain)}, {title(results.solver)}, λ = {results.trade_off:g} (job "
                f"“{label}”): trace {story.trace + 1} explained to a user of type "
                f"{story.user_type}; cost {story.cost:g}.",
            )
