"""The report of a sweep: tables, plots, and one HTML page with all of them."""

import base64
import hashlib
import json
import shlex
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.figure import Figure

from xplain.experiment.fingerprint import code_version, library_versions
from xplain.experiment.results import RESULTS
from xplain.report import claims, plots, trace
from xplain.report.compare import (
    differences_csv,
    heading,
    is_beside_paper,
    regret_csv,
    table,
    tabulate,
)
from xplain.report.frame import TITLES, Summary, rank
from xplain.report.paper import title
from xplain.report.table import Table, count_things, number
from xplain.storage import write_text

REPORT = "report"
TEMPLATE = Path(__file__).with_name("page.html")
FILES = ("table.md", "table.tex", "regret.csv", "differences.csv", "index.html")
"""Files that every report has."""

LEARNING = {
    "true_types": "types",
    "types_found": "found",
    "adjusted_rand_index": "adjusted Rand index",
    "labeler_accuracy": "labelers right",
    "fresh_accuracy": "on fresh questions",
    "everyone_accuracy": "one labeler for all right",
}
"""Figures of the learning stage, with their titles."""


def write_report(folder: Path, measure: str | None = None) -> tuple[Summary, Path]:
    """Writes everything below ``<sweep>/report`` from the finished jobs, unless a complete report
    with the same content exists.

    Args:
        folder: folder of the sweep.
        measure: the measure that compares the jobs; None chooses a measure that is fair to all.

    Raises:
        OSError, InputError, ValueError: the folder has no sweep, or cannot be written.
    """
    summary = Summary(folder, measure)
    report = folder / REPORT
    report.mkdir(exist_ok=True)
    made_of = digest_content(summary)
    is_there = all((report / name).exists() for name in FILES) and (
        made_of in (report / "index.html").read_text(encoding="utf-8")
    )
    if summary.results and not is_there:
        made = {name: make(summary) for name, make in TABLES.items()}
        tables = {name: own for name, own in made.items() if len(own.frame)}
        texts = {
            **{f"{name}.md": own.markdown() for name, own in tables.items()},
            "table.tex": tables["table"].latex(),
            "regret.csv": regret_csv(summary),
            "differences.csv": differences_csv(summary),
            "index.html": page(summary, tables, report, made_of),  # last: the report is complete
        }
        for name, text in texts.items():
            write_text(report / name, text)
    return summary, report


def digest_content(summary: Summary) -> str:
    """Computes a digest of all that decides a report: the sweep with its results and failures, the
    measure, this package, and the libraries that calculate and draw."""
    results = [summary.folder.address(job) / RESULTS for job, _ in summary.results]
    # code_version covers only modules.
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in (TEMPLATE, *results)))
    versions = [code_version(), library_versions(), matplotlib.__version__]
    words = [summary.about, summary.measure.name, summary.failures] if summary.results else []
    digest.update(json.dumps([versions, *words], sort_keys=True).encode())
    return digest.hexdigest()


def page(summary: Summary, tables: dict[str, Table], report: Path, made_of: str) -> str:
    """Makes the HTML of the whole page, which contains all pictures; the pictures are also files.

    Args:
        summary, tables: the jobs and the tables of the sweep.
        report: receives the pictures.
        made_of: digest of the content, kept in the page.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        summary=summary,
        made_of=made_of,
        beside_paper=is_beside_paper(summary),
        swept=[heading(key).lower() for key in summary.shown],
        answer=claims.answer(summary),
        size=f"{len(summary.results)} of {len(summary.jobs)} jobs, {len(summary.episodes):,} "
        f"episodes, {count_things(summary.seeds, 'seed')}",
        tables=tables,
        pictures=draw(summary, report),
        examples=[example(summary, domain, report) for domain in summary.values("domain")],
    )


def draw(summary: Summary, report: Path) -> dict[str, dict[str, str]]:
    """Draws every plot into the folder. Returns ``{name: {"caption", "address"}}``, where the
    address is a ``data:`` address with the whole picture."""
    key = heading(plots.plot_keys(summary)[0] or "")
    measures = {
        "regret": summary.measure.name,
        "messages": "messages",
        "inexplicable": "inexplicable_labels",
    }
    drawn = {
        name: (f"{TITLES[own].capitalize()} against {key}", plots.against_main_key(summary, own))
        for name, own in measures.items()
    }
    caption = "Belief in the user's true type, mean over the episodes with this step"
    drawn["belief"] = caption, plots.belief_over_steps(summary)
    return {
        name: {"caption": caption, "address": save_picture(figure, report / f"{name}.svg")}
        for name, (caption, figure) in drawn.items()
        if figure is not None
    }


def example(summary: Summary, domain: Any, report: Path) -> dict[str, Any]:
    """Draws one explanation of a domain, with λ = 1 or the middle λ, and the first solver. Returns
    the picture, the sentences of the messages, and the command that shows it as a page."""
    own = [one for one in summary.results if one[1].domain == domain]
    trade_offs = sorted({results.trade_off for _, results in own})
    middle = 1.0 if 1.0 in trade_offs else trade_offs[len(trade_offs) // 2]
    at = [one for one in own if one[1].trade_off == middle]
    job, results = min(at, key=lambda one: (rank(one[1].solver), one[1].solver))
    figure, story, which = trace.draw_typical(summary.folder.address(job), results)
    words = [*job.overrides, "--trace", str(story["trace"]), "--user", story["type"]]
    whose = f"{title(results.solver)}, λ = {results.trade_off:g} (job “{job.label}”)"
    return {
        "domain": title(domain),
        "caption": f"{title(domain)}, {whose}: {which}.",
        "address": save_picture(figure, report / f"trace_{domain}.svg"),
        "sentences": dict(sorted(results.messages.items())),
        "command": shlex.join(["python", "-m", "xplain", "demo", *words]),
    }


def save_picture(figure: Figure, path: Path) -> str:
    """Writes an SVG. Returns a ``data:`` address with the whole picture."""
    plots.save(figure, path)
    return f"data:image/svg+xml;base64,{base64.b64encode(path.read_bytes()).decode()}"


def learning_table(summary: Summary) -> Table:
    """Makes a table of how well types and labels were learned. Each combination of the swept
    values that decide the data has a row."""

    def cells(own: pd.DataFrame) -> dict[str, str]:
        means = own.reindex(columns=[*LEARNING]).mean().dropna()
        return {
            title: f"{means[name]:.1%}" if name.endswith("accuracy") else number(means[name])
            for name, title in LEARNING.items()
            if name in means
        }

    caption = "Means over seeds. Labelers are scored on labels that were held out."
    return tabulate(summary, summary.settings, summary.data_sets, cells, caption)


TABLES = {
    "table": table,
    "undecided": claims.list_undecided,
    "claims": claims.claims_table,
    "ratios": claims.compute_ratios,
    "learning": learning_table,
    "decomposition": claims.decomposition,
}
"""The tables of a report, by the names of their files. An empty table has no file."""
