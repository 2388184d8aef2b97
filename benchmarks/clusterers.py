"""Counts how often clusterers find the types: in both domains, with shared or independent
questions, with and without errors.

    python benchmarks/clusterers.py              20 seeds per setting, some minutes
    python benchmarks/clusterers.py --quick      1 seed of one setting, few labels
    python benchmarks/clusterers.py --methods kmeans --noise 0 --seeds 40 --first 100

Domains decide the numbers of labels and types (four rooms: 2, 3 and 4 types); each type has three
observers. ``right`` counts the data sets whose adjusted Rand index (ARI) to the behaviourally
distinct true types is 1, and ``k`` the data sets with the right number of types; ``rules`` names
the rules that chose this number.
"""

import argparse
from collections import Counter
from itertools import product
from typing import Any

import numpy as np
from hydra.utils import instantiate
from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table
from sklearn.metrics import adjusted_rand_score

from xplain.experiment.config import compose_config
from xplain.experiment.pipeline import observe

SETTINGS = {
    "rescue, 5 types": ("domain=rescue",),
    **{
        f"four rooms, {count} types": ("domain=four_rooms", f"users.count={count}")
        for count in (2, 3, 4)
    },
}
Row = dict[str, Any]


def found(
    setting: str, queries: str, noise: float, method: str, seed: int, points: int | None
) -> Row:
    """Returns the result of a clusterer on one data set."""
    few = () if points is None else (f"points={points}",)
    choices = (*SETTINGS[setting], f"queries={queries}", f"observers.label_noise={noise}", *few)
    cfg = compose_config("observe", choices)
    parts = (instantiate(cfg[name]) for name in ("domain", "users", "observers", "queries"))
    observed = observe(*parts, seed=seed)
    clusterer = instantiate(compose_config("discover", [f"clusterer={method}"]).clusterer)
    clustering = clusterer.cluster(observed, seed)
    true = observed.behaviour
    assert true is not None  # simulated observers have known types
    return {
        "ari": adjusted_rand_score(true, clustering.assignment),
        "k": clustering.n_types == len(np.unique(true)),
        "rule": clustering.rule,
    }


def main() -> None:
    """Prints a row for each setting, kind of questions, noise and method."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--quick", action="store_true", help="1 seed, 40 labels per observer")
    arguments.add_argument("--first", type=int, default=0, help="first seed")
    arguments.add_argument("--seeds", type=int, default=20, help="data sets per setting")
    arguments.add_argument("--jobs", type=int, default=2, help="processes")
    arguments.add_argument("--methods", nargs="+", default=["dirichlet", "kmeans"])
    arguments.add_argument("--settings", nargs="+", default=list(SETTINGS), choices=SETTINGS)
    arguments.add_argument("--noise", nargs="+", type=float, default=[0.0, 0.05])
    chosen = arguments.parse_args()
    seeds = range(chosen.first, chosen.first + (1 if chosen.quick else chosen.seeds))
    points = 40 if chosen.quick else None
    table = Table("setting", "questions", "errors", "clusterer", "right", "k", "mean ARI", "rules")
    if chosen.quick:  # in this process, because starting others takes longer
        chosen.settings, chosen.noise, chosen.jobs = chosen.settings[1:2], chosen.noise[:1], 1
    axes = (chosen.settings, ("independent", "shared"), chosen.noise, chosen.methods)
    for setting, queries, noise, method in product(*axes):
        rows = Parallel(chosen.jobs)(
            delayed(found)(setting, queries, noise, method, seed, points) for seed in seeds
        )
        rules = Counter(row["rule"] for row in rows)
        table.add_row(
            *(setting, queries, f"{noise:g}", method),
            f"{sum(row['ari'] == 1 for row in rows)} of {len(rows)}",
            str(sum(row["k"] for row in rows)),
            f"{np.mean([row['ari'] for row in rows]):.3f}",
            ", ".join(f"{rule} {count}" for rule, count in rules.most_common()),
        )
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
