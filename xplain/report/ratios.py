"""Computes for each kind of people the cost of an explainer divided by the cost of the best other
explainer in the sweep."""

import pandas as pd
from scipy.stats import gmean

from xplain.interaction.statistics import clustered_ratio
from xplain.report.compare import group_episodes, heading, headings, label
from xplain.report.frame import Summary
from xplain.report.table import Table


def compute_ratios(summary: Summary) -> Table:
    """Makes a table of ratios, with a row for each problem and a column for each way to explain.

    A ratio is the cost of a way divided by the cost of the best other way in the sweep, for the
    same people. Above 1, the other way costs less. The last rows are geometric means over the kinds
    of people.
    """
    found = []
    for values, frame in group_episodes(summary, summary.posed):
        ways = group_episodes(summary, summary.ways or ["solver"], frame)
        costs = pd.DataFrame({label(k): own.set_index(summary.problem)["cost"] for k, own in ways})
        for way in costs:
            best = costs.drop(columns=way).mean().idxmin()
            both = costs[[way, best]].dropna()
            clusters = both.index.get_level_values(summary.replicate)
            ratio = clustered_ratio(both[way], both[best], clusters)
            text = f"{ratio.mean:.2f} ± {(ratio.high - ratio.low) / 2:.2f}"
            found.append({**headings(values), "way": way, "mean": ratio.mean, "text": text})
    cells = pd.DataFrame(found)
    posed = [heading(key) for key in summary.posed]
    kinds = {head: "all" for head in posed if head.startswith("explainee")}
    every = cells.assign(**kinds).groupby([*posed, "way"], sort=False)["mean"].agg(gmean)
    means = every.map("{:.2f}".format).reset_index(name="text")
    shown = pd.concat([cells, means]).set_index([*posed, "way"])["text"].unstack(sort=False)
    caption = (
        "Cost divided by the cost of the best other way for the same people, with its 95 % "
        "interval."
    )
    return Table(shown.fillna("").reset_index(), len(posed), caption)
