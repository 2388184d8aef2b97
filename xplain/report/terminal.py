"""Prints the results of a run, and the table of a sweep, on the terminal."""

import sys
from collections.abc import Mapping

import pandas as pd
from rich.console import Console

from xplain.experiment.progress import is_terminal
from xplain.experiment.results import Figure, Results
from xplain.explanation.belief import NO_FIT
from xplain.report.claims import answer, list_undecided
from xplain.report.compare import table
from xplain.report.frame import NO_REFERENCE, RIGHT, Summary, warning_about_oracle
from xplain.report.paper import table1
from xplain.report.table import count_things, table_of

WIDTH = 100
"""Columns if the output is no terminal; a wider table is not cut."""

TITLES = {
    "cost": "cost",
    "clairvoyant_cost": "clairvoyant's cost",
    "regret_to_clairvoyant": "cost − clairvoyant's",
    "oracle_cost": "oracle's cost",
    "regret": "regret (cost − oracle's)",
    "messages": "messages given",
    "inexplicable_labels": "inexplicable labels",
    "questions": "questions asked",
    "questions_cost": "cost of questions",
    "final_belief": "final belief in true type",
}
"""Figures that are printed; results.json has more."""

BY_CHANCE = ", above the optimum by sampling error"
"""Text for a simulated value above a proven bound, which no policy can exceed."""


def print_sweep(summary: Summary) -> None:
    """Prints the sweep's table and the lowest cost on standard output."""
    own = table(summary)
    shown = own.text()
    needed = max(WIDTH, Console(width=10_000).measure(shown).maximum)
    count = len(list_undecided(summary).frame)
    more = f"{count_things(count, 'undecided difference')}: the report says what would decide each."
    below = ((answer(summary), WIDTH), (more if count else "", WIDTH), (own.caption, WIDTH))
    for text, width in ((own.about, needed), (shown, needed), *below):
        if text:
            _make_console(width, markup=False).print(text)


def print_summary(results: Results) -> None:
    """Prints the run's figures as a table on standard output, beside the paper's values."""
    console = _make_console()
    console.print(_make_headline(results))
    as_paper = results.choices["explainee"] == "exact" and not _describe_questions(results)
    setting = results.choices["domain"], results.trade_off
    published = table1().get(setting, {}) if as_paper else {}
    places = {results.solver: "regret", "oracle": "oracle_cost"}
    paper = {places[key]: f"{value:.2f}" for key, value in published.items() if key in places}
    known, rows = results.metrics, []
    is_marked = results.learning.get("fresh_accuracy", 1.0) < RIGHT
    for name in (name for name in TITLES if name in known):
        mark = f" {NO_REFERENCE}" if is_marked and name in ("oracle_cost", "regret") else ""
        row = {"measure": TITLES[name] + mark, "mean": f"{known[name].mean:.3f}"}
        row["95 % interval"] = _format_interval(known[name])
        rows.append(row | ({"paper": paper.get(name, "")} if paper else {}))
    console.print(table_of(rows, 1).text())
    below = (
        warning_about_oracle(results.learning, known["regret"].mean) if "regret" in known else ""
    )
    for text in filter(None, [_compare_for_no_type(results), below]):
        console.print(text)


def print_certificates(bounds: Mapping[str, float]) -> None:
    """Prints the certificates on standard output: the bounds of the optimal value, and the value
    and the cost of the policy under the learned model. Prints nothing without certificates."""
    if not bounds:
        return
    traces = count_things(int(bounds["traces"]), "trace")
    lines = [
        f"certificates, {traces}, discounted returns under the learned model:",
        f"  optimum between {bounds['optimal_lower']:.4f} and {bounds['optimal_upper']:.4f}; "
        "expected value of perfect information "
        f"{_format_range(bounds, 'value_of_perfect_information')}",
    ]
    if bounds.get("fresh_labels") == 0:
        lines.append(
            "  the bounds assume labels that are drawn again at each step; this belief does not, "
            "so this policy has no certificate"
        )
    if "policy_value" in bounds:
        lines += [
            f"  this policy {bounds['policy_value']:.4f} ({_describe_precision(bounds)}), "
            f"suboptimality {_format_range(bounds, 'price_of_approximation')}",
            f"expected cost of this policy under the learned model, undiscounted, {traces}: "
            f"{bounds['policy_cost']:.3f}",
        ]
    _make_console().print("\n".join(lines))


def _make_console(width: int = WIDTH, **look: bool) -> Console:
    """Makes a console with the width of the terminal, if there is one."""
    return Console(highlight=False, width=None if is_terminal(sys.stdout) else width, **look)  # type: ignore[arg-type]


def _compare_for_no_type(results: Results) -> str:
    """Returns a sentence about the users whom no found type fits. It compares the mean costs for
    these users of the solver, of giving all messages, and of one explanation for all types.
    Returns "" if the belief has only the found types."""
    wide = pd.DataFrame(map(vars, results.episodes)).pivot(
        index=["trace", "type"], columns="solver", values=["cost", "fit"]
    )
    if "say_all" not in wide["cost"]:
        return ""
    users = wide["cost"][wide["fit"]["solver"] < NO_FIT]
    said = f"no found type fits {len(users)} of {len(wide)} users"
    if not len(users):
        return said
    mean = users.mean()
    return (
        f"{said}; for these users the solver costs {mean['solver']:.2f}, giving all messages "
        f"{mean['say_all']:.2f}, and one explanation for all types {mean['conformant']:.2f}"
    )


def _describe_questions(results: Results) -> str:
    """Describes when the explainer asks and the cost κ of a question; "" without questions."""
    choice = results.choices["ask"]
    return "" if choice == "never" else f"ask={choice}, κ = {results.config['ask']['cost']:g}"


def _make_headline(results: Results) -> str:
    """Makes two lines: the settings of the run, and the learned types."""
    users = results.choices["explainee"]
    what = [
        results.domain,
        results.solver,
        f"λ = {results.trade_off:g}",
        f"{count_things(results.config['traces'], 'trace')} × "
        f"{count_things(len(results.types.true), 'type')}",
        "" if users == "exact" else f"explainee={users}",
        _describe_questions(results),
        f"seed {results.seed}",
    ]
    known = results.learning

    def figure(text: str, name: str) -> str:
        return text.format(known[name]) if name in known else ""

    learned = [
        figure("user types found: {:.0f}", "types_found"),
        figure(" of {:.0f}", "true_types"),
        figure(", adjusted Rand index {:.2f}", "adjusted_rand_index"),
        f" ({results.elbow.rule})",
        figure("; labelers {:.1%} right on held-out labels", "labeler_accuracy"),
        figure(", {:.1%} on fresh questions", "fresh_accuracy"),
    ]
    return f"{' · '.join(filter(None, what))}\n{''.join(learned)}"


def _format_interval(figure: Figure) -> str:
    return "one trace" if figure.low is None else f"{figure.low:.3f} … {figure.high:.3f}"


def _describe_precision(bounds: Mapping[str, float]) -> str:
    if bounds["policy_value_exact"] == 1:
        return "exact"
    half = bounds["policy_value_high"] - bounds["policy_value"]
    beyond = bounds["policy_value"] > bounds["optimal_upper"]
    return f"± {half:.4f}" + (BY_CHANCE if beyond else "")


def _format_range(bounds: Mapping[str, float], name: str) -> str:
    return f"{bounds[f'{name}_low']:.4f} … {bounds[f'{name}_high']:.4f}"
