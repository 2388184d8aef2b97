"""Measures the cost of messages that are missed or forgotten (docs/people-who-err.md), with a
picture.

    python benchmarks/again.py            runs sweeps=again, prints the table, draws the picture
    python benchmarks/again.py --quick    a smoke run
"""

import argparse
from dataclasses import astuple
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from explainees import DOMAINS, figure, ratio
from matplotlib.figure import Figure

import xplain
from xplain.interaction.statistics import clustered_mean

WAYS = {
    "paper": ("assumes that no message is missed", "#D55E00", "s-"),
    "told": ("knows the rates", "#009E73", "^--"),
    "learned": ("learns the rates", "#0072B2", "o-"),
    "seen": ("sees type and knowledge", "#666666", "d:"),
}
"""Explainers in the picture: name, colour and line."""
FEW = (
    *("seed=0", "traces=1", "points=20"),
    *("explainee=heedless", "explainee.forget=0.03,0.15"),
    "hydra.launcher.n_jobs=1",  # other processes would import everything again
)
"""Changes for a smoke run."""
PICTURE = Path(__file__).parent.parent / "docs" / "pictures" / "again.png"


def messages(quick: bool) -> None:
    """Makes the table and the picture of messages that are missed, from ``sweeps=again``."""
    rows = xplain.sweep("sweeps=again", "tracking=none", *(FEW if quick else ())).frame()
    rows["way"] = np.where(rows["belief"] == "told", "told", "paper")
    rows.loc[rows["belief.accept"] == "learned", "way"] = "learned"
    at = ["domain", "explainee.accept", "explainee.forget"]
    costs = rows.pivot_table("cost", [*at, "seed"], "way")
    # If no message is missed, both are one job.
    costs["told"] = costs["told"].fillna(costs["paper"])
    costs["seen"] = rows.groupby([*at, "seed"])["clairvoyant_cost"].first()
    costs = costs.reset_index()
    again = (
        rows[rows["way"] == "told"].groupby(at)["messages_again"].agg(lambda n: n.fillna(0).mean())
    )
    print(
        "| α, φ | as the paper | told | learned | type and knowledge seen | told / paper |", end=""
    )
    print(" learned / told | given again |\n|---|---|---|---|---|---|---|---|")
    for domain in DOMAINS:
        print(f"| **{domain.replace('_', ' ')}** |" + " |" * 7)
        here = costs[costs["domain"] == domain]
        pairs = sorted(zip(here[at[1]], here[at[2]], strict=True), key=lambda p: (-p[0], p[1]))
        for accept, forget in dict.fromkeys(pairs):
            own = here[(here[at[1]] == accept) & (here[at[2]] == forget)]
            by = {way: own[way].tolist() for way in WAYS}
            cells = [figure(by[way]) for way in WAYS]
            cells += [ratio(by["told"], by["paper"]), ratio(by["learned"], by["told"])]
            cells.append(f"{again.get((domain, accept, forget), 0.0):.2f}")
            print(f"| {accept:g}, {forget:g} | {' | '.join(cells)} |", flush=True)
    if not quick:
        picture(costs).savefig(PICTURE, dpi=150)


def picture(costs: pd.DataFrame) -> Figure:
    """Draws the cost against the share of missed messages, by the rate of forgetting."""
    lost = sorted(set(costs.loc[costs["explainee.accept"] == 1, "explainee.forget"]))
    figure = Figure(figsize=(9.6, 6.2), layout="constrained")
    axes = figure.subplots(len(DOMAINS), len(lost), sharex=True, sharey="row")
    for (row, domain), (column, forget) in product(enumerate(DOMAINS), enumerate(lost)):
        axis = axes[row, column]
        here = (costs["domain"] == domain) & (costs["explainee.forget"] == forget)
        for way, (name, colour, style) in WAYS.items():
            points = {
                100 * (1 - accept): clustered_mean(own[way], range(len(own)))
                for accept, own in costs[here].groupby("explainee.accept")
            }
            x = np.array(list(points))
            mean, low, high = np.array([astuple(found) for found in points.values()]).T
            axis.plot(x, mean, style, color=colour, label=name, linewidth=2, markersize=6)
            if way != "told":  # another band would hide this band
                axis.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        axis.spines[["top", "right"]].set_visible(False)
        if row == 0:
            often = f"1 in {1 / forget:.0f} facts lost per step" if forget else "nothing is lost"
            axis.set_title(often, fontsize=12)
        axis.set_xticks([0, 10, 20], ["0 %", "10 %", "20 %"])
    for row, domain in enumerate(DOMAINS):
        axes[row, 0].set_ylim(bottom=0)  # for the whole row, after it is drawn
        axes[row, 0].set_ylabel(f"{domain.replace('_', ' ')}:\ncost of an explanation", fontsize=12)
    figure.supxlabel("messages that are missed", fontsize=12)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=11)
    return figure


def main() -> None:
    """Prints the table as Markdown, and draws the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a smoke run")
    messages(parser.parse_args().quick)


if __name__ == "__main__":
    main()
