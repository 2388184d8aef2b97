"""Draws docs/pictures/asking.png and prints the table of docs/asking.md, from ``python -m xplain
sweeps=asking``, which it runs if needed.

    python benchmarks/asking_picture.py
    python benchmarks/asking_picture.py --quick    a smoke run
"""

import argparse
from pathlib import Path
from typing import Any

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import xplain
from xplain.report.paper import title
from xplain.report.plots import COLOURS, STYLE, save

PICTURE = Path(__file__).parent.parent / "docs" / "pictures" / "asking.png"
POLICIES = {
    "never asks, certified optimum": ("certified", "never", ""),
    "never asks, QMDP": ("qmdp", "never", ""),
    "asks first, QMDP": ("qmdp", "clips", "first"),
    "asks at any time, QMDP": ("qmdp", "clips", "anytime"),
    "asks at any time, certified optimum": ("certified", "clips", "anytime"),
}
"""The rows of the table: the solver, ``ask`` and ``ask.when``."""
DRAWN: dict[str, dict[str, Any]] = {
    "never asks, certified optimum": {"color": COLOURS[7], "linewidth": 3},
    "asks at any time, certified optimum": {"color": COLOURS[5], "linewidth": 7, "alpha": 0.6},
    "asks first, QMDP": {"color": COLOURS[1], "linestyle": "none", "marker": "s", "markersize": 7},
    "asks at any time, QMDP": {"color": COLOURS[0], "linewidth": 2, "marker": "o"},
}
FLOOR = "type known (clairvoyant)"


@matplotlib.rc_context(STYLE)
def main() -> None:
    """Draws the picture and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    quick = parser.parse_args().quick
    few = (
        *("traces=1", "points=20", "ask.cost=0.1,0.5", "ask.clips=20"),
        "hydra.launcher.n_jobs=1",  # other processes would import everything again
    )
    sweep = xplain.sweep("sweeps=asking", "tracking=none", *(few if quick else ()))
    frame = pd.read_csv(sweep.folder / "report" / "regret.csv", keep_default_na=False)
    domains = list(dict.fromkeys(frame["domain"]))
    figure = Figure(figsize=(5.4 * len(domains), 4.6), layout="constrained")
    for axes, domain in zip(
        figure.subplots(1, len(domains), squeeze=False)[0], domains, strict=True
    ):
        draw(axes, frame[frame["domain"] == domain])
        axes.set_title(title(domain), loc="left", weight="bold", fontsize=15)
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize=12)
    if not quick:
        save(figure, PICTURE)
    print(table(frame))


def of(frame: pd.DataFrame, policy: str) -> pd.DataFrame:
    """Selects a policy's rows, by κ."""
    solver, ask, when = POLICIES[policy]
    own = (frame["solver"] == solver) & (frame["ask"] == ask) & (frame["ask.when"] == when)
    return frame[own].set_index("ask.cost").sort_index()


def draw(axes: Axes, frame: pd.DataFrame) -> None:
    """Draws the cost against κ in one domain."""
    for policy, style in DRAWN.items():
        own = of(frame, policy)
        axes.plot(own.index, own["cost_mean"], label=policy, **style)
    floor = float(frame["clairvoyant_mean"].iloc[0])
    axes.axhline(floor, color="black", linestyle=":", linewidth=2, label=FLOOR)
    axes.set_ylim(bottom=0)
    axes.set_xticks([0.05, 0.2, 0.3, 0.5, 1], ["0.05", "0.2", "0.3", "0.5", "1"])
    axes.tick_params(labelsize=12)
    axes.set_xlabel("κ, cost of a question (an inexplicable label costs 1)", fontsize=12)
    axes.set_ylabel("cost of an explanation", fontsize=12)


def table(frame: pd.DataFrame) -> str:
    """Writes the costs, with the number of questions in parentheses, in Markdown."""
    costs = sorted({float(cost) for cost in frame["ask.cost"]})
    lines = [
        f"| domain | policy | {' | '.join(f'κ = {cost:g}' for cost in costs)} |",
        "|---|---|" + "---|" * len(costs),
    ]
    for domain, one in frame.groupby("domain", sort=False):
        for policy in POLICIES:
            own = of(one, policy)
            cells = [
                f"{row['cost_mean']:.2f}"
                + (f" ({row['questions_mean']:.1f})" if row["questions_mean"] else "")
                for _, row in own.iterrows()
            ]
            lines.append(f"| {title(str(domain))} | {policy} | {' | '.join(cells)} |")
        floor = f"{one['clairvoyant_mean'].iloc[0]:.2f}"
        lines.append(f"| {title(str(domain))} | {FLOOR} | {' | '.join([floor] * len(costs))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
