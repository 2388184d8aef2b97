"""Measures how often the paper's learner finds the types, and the accuracy of labelers under
perfect clustering.

    python benchmarks/learner.py                 20 seeds per setting, some minutes
    python benchmarks/learner.py --quick         1 seed of one setting
    python benchmarks/learner.py --first 300 --seeds 100     more and other seeds

Queries are shared, with the paper's numbers of labels, k-means and the elbow of disagreements.
Types count as found if the adjusted Rand index to the behaviourally distinct true types is 1.
"""

import argparse

import numpy as np
from hydra import compose, initialize_config_dir
from joblib import Parallel, delayed
from rich.console import Console
from rich.table import Table

from xplain.experiment.config import CONF, register
from xplain.experiment.from_config import components_of
from xplain.experiment.pipeline import prepare as prepared

SETTINGS = {
    "rescue, 5 types": ["domain=rescue"],
    "four rooms, 2 types": ["domain=four_rooms", "users.count=2"],
    "four rooms, 3 types": ["domain=four_rooms", "users.count=3"],
    "four rooms, 4 types": ["domain=four_rooms", "users.count=4"],
}


def learning(overrides: list[str], seed: int) -> dict[str, float]:
    """Returns the figures of the learning stage on one data set."""
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("config", [*overrides, f"seed={seed}", "traces=1", "queries=shared"])
    return prepared(components_of(cfg)).learning


def main() -> None:
    """Prints one row for each setting."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--quick", action="store_true", help="1 seed of one setting")
    arguments.add_argument("--first", type=int, default=0, help="first seed")
    arguments.add_argument("--seeds", type=int, default=20, help="data sets per setting")
    arguments.add_argument("--jobs", type=int, default=2, help="processes")
    chosen = arguments.parse_args()
    seeds = range(chosen.first, chosen.first + (1 if chosen.quick else chosen.seeds))
    jobs, settings = chosen.jobs, SETTINGS
    if chosen.quick:  # in this process, because starting others takes longer
        jobs, settings = 1, dict([*SETTINGS.items()][1:2])
    table = Table(
        "setting", "found", "mean ARI", "accuracy, perfect clustering", "lowest of a data set"
    )
    for name, overrides in settings.items():
        rows = Parallel(jobs)(delayed(learning)(overrides, seed) for seed in seeds)
        indices = [row["adjusted_rand_index"] for row in rows]
        accuracies = [row["perfect_labeler_accuracy"] for row in rows]
        table.add_row(
            name,
            f"{sum(index == 1 for index in indices)} of {len(rows)}",
            f"{np.mean(indices):.3f}",
            f"{np.mean(accuracies):.3f}",
            f"{min(accuracies):.3f}",
        )
    Console().print(table)


if __name__ == "__main__":
    main()
