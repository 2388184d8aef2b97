"""Table 1 and its companions as Markdown, LaTeX and CSV, the paper's values beside ours."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from dataclasses import dataclass

from xplain.evaluation.statistics import Estimate
from xplain.report.paper import table1, title
from xplain.report.summary import Summary


@dataclass(frozen=True)
class Entry:
    """One number of Table 1."""

    domain: str
    setting: str
    trade_off: float
    column: str
    estimate: Estimate
    paper: float | None
    episodes: int

    @property
    def difference(self) -> float | None:
        """Our value minus the paper's; None where the paper has none."""
        return None if self.paper is None else self.estimate.mean - self.paper


REFERENCES = ("oracle", "clairvoyant")
"""Whose costs stand before the methods' regrets."""


def entries(summary: Summary, by_setting: bool = False, measure: str = "regret") -> Iterator[Entry]:
    """All numbers, row by row: the references' costs, then the regret of each method.

    Args:
        summary: of a sweep.
        by_setting: one row a setting; else a domain's settings are pooled, as in the paper.
        measure: ``regret`` (to the oracle) or ``regret to clairvoyant``, of which the paper has no
            values.
    """
    published = table1()
    for domain in summary.domains:
        settings = summary.settings(domain) if by_setting else [None]
        for setting in settings:
            for trade_off in summary.trade_offs:
                paper = published.get((domain, trade_off), {}) if measure == "regret" else {}
                cells = [
                    (name, summary.reference(name, domain, trade_off, setting))
                    for name in REFERENCES
                ] + [
                    (method, summary.estimate(measure, domain, trade_off, method, setting))
                    for method in summary.methods
                ]
                for column, cell in cells:
                    if cell is not None:
                        yield Entry(
                            domain,
                            cell.setting,
                            trade_off,
                            column,
                            cell.estimate,
                            paper.get(column),
                            cell.episodes,
                        )


def as_csv(summary: Summary, measure: str = "regret") -> str:
    """One line a number, pooled and by setting, six decimals; ``measure`` as in
    :func:`entries`."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        [
            "domain",
            "setting",
            "lambda",
            "column",
            "mean",
            "low",
            "high",
            "paper",
            "difference",
            "episodes",
        ]
    )
    rows = list(entries(summary, measure=measure))
    if any(len(summary.settings(domain)) > 1 for domain in summary.domains):
        rows += list(entries(summary, by_setting=True, measure=measure))
    for e in rows:
        numbers = [e.estimate.mean, e.estimate.low, e.estimate.high, e.paper, e.difference]
        writer.writerow(
            [e.domain, e.setting, f"{e.trade_off:g}", e.column]
            + [number(x, 6) for x in numbers]
            + [e.episodes]
        )
    return out.getvalue()


def grid(
    summary: Summary, by_setting: bool = False, measure: str = "regret"
) -> list[tuple[str, str, float, list[Entry]]]:
    """(domain, setting, λ, numbers in the order of the columns)."""
    rows: dict[tuple[str, str, float], list[Entry]] = {}
    for entry in entries(summary, by_setting, measure):
        rows.setdefault((entry.domain, entry.setting, entry.trade_off), []).append(entry)
    return [(*key, numbers) for key, numbers in rows.items()]


def columns(summary: Summary) -> list[str]:
    """Keys of the columns."""
    known = {name for name in REFERENCES if summary.episodes[name].notna().any()}
    return [*(name for name in REFERENCES if name in known), *summary.methods]


def markdown(summary: Summary, by_setting: bool = False, measure: str = "regret") -> str:
    """The table in the paper's layout: mean, interval, and the paper's value with the
    difference; arguments as of :func:`entries`."""
    keys = columns(summary)
    heads = ["Domain", "λ", *(title(key) for key in keys)]
    lines = ["| " + " | ".join(heads) + " |", "|---|---|" + "---|" * len(keys)]
    for domain, setting, trade_off, numbers in grid(summary, by_setting, measure):
        cells = {entry.column: cell_text(entry) for entry in numbers}
        name = f"{title(domain)} {setting if by_setting else ''}".rstrip()
        words = [name, f"{trade_off:g}", *(cells.get(key, "") for key in keys)]
        lines.append("| " + " | ".join(words) + " |")
    return "\n".join([*lines, "", caption(summary, measure), ""])


def cell_text(entry: Entry) -> str:
    """``0.52 [0.31, 0.73] (paper 0.46, +0.06)``."""
    text = number(entry.estimate.mean)
    if not math.isnan(entry.estimate.low):
        text += f" {interval(entry.estimate)}"
    if entry.paper is not None:
        text += f" (paper {entry.paper:.2f}, {signed(entry.difference)})"
    return text


def latex(summary: Summary) -> str:
    """The table for a paper (booktabs): intervals below the means, the paper's values beside."""
    keys = columns(summary)
    lines = [
        r"% \usepackage{booktabs}",
        r"\begin{tabular}{ll" + "r@{ }l" * len(keys) + "}",
        r"\toprule",
        "Domain & $\\lambda$ & "
        + " & ".join(rf"\multicolumn{{2}}{{c}}{{{tex(title(key))}}}" for key in keys)
        + r" \\",
    ]
    last = ""
    for domain, _, trade_off, numbers in grid(summary):
        lines += [r"\midrule"] if domain != last else []
        own = {entry.column: entry for entry in numbers}
        means, intervals = [], []
        for key in keys:
            entry = own.get(key)
            paper = "" if entry is None or entry.paper is None else f"({entry.paper:.2f})"
            means.append(f"${number(entry.estimate.mean)}$ & {paper}" if entry else " & ")
            known = entry is not None and not math.isnan(entry.estimate.low)
            text = rf"\tiny${interval(entry.estimate)}$" if entry is not None and known else ""
            intervals.append(rf"\multicolumn{{2}}{{c}}{{{text}}}")
        name = tex(title(domain)) if domain != last else ""
        lines.append(f"{name} & {trade_off:g} & " + " & ".join(means) + r" \\")
        lines.append(" & & " + " & ".join(intervals) + r" \\")
        last = domain
    lines += [r"\bottomrule", r"\end{tabular}", f"% {caption(summary, difference=False)}"]
    return "\n".join(lines) + "\n"


def caption(summary: Summary, measure: str = "regret", difference: bool = True) -> str:
    """How to read the table.

    Args:
        summary: of the sweep.
        measure: as in :func:`entries`.
        difference: whether the table tells our difference to the paper beside its value.
    """
    pooled = [
        f"{title(domain)} pools {len(summary.settings(domain))} settings "
        f"({'; '.join(summary.settings(domain))})"
        for domain in summary.domains
        if len(summary.settings(domain)) > 1
    ]
    unit = "seeds" if summary.seeds > 1 else "traces"
    to_oracle = measure == "regret"
    whose = "oracle's" if to_oracle else "clairvoyant's"
    paper = "; in parentheses the paper's value" if to_oracle else ""
    if paper and difference:
        paper += " and our difference to it"
    text = (
        f"Costs of the references, and regret (cost minus the {whose} on the same trace and user) "
        f"of each method; 95 % intervals over {unit} in brackets{paper}."
    )
    if summary.missing:
        text += f" {summary.missing} of {len(summary.jobs)} jobs are missing."
    return " ".join([text, *(f"{words}." for words in pooled)])


def number(value: float | None, decimals: int = 2) -> str:
    """Fixed decimals, never a negative zero; empty where there is none."""
    if value is None or math.isnan(value):
        return ""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def signed(value: float | None) -> str:
    """Two decimals with their sign, + or -; empty where there is no value."""
    return "" if value is None else f"{round(value, 2) + 0.0:+.2f}"


def interval(estimate: Estimate) -> str:
    """The ends of the interval as text, such as ``[0.31, 0.73]``."""
    return f"[{number(estimate.low)}, {number(estimate.high)}]"


def tex(text: str) -> str:
    """Text without what LaTeX would take for commands."""
    return text.replace("_", r"\_").replace("%", r"\%").replace("&", r"\&")
