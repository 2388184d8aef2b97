"""Runs the same sweep with every launcher and sweeper of Hydra, and checks that the results are the
same.

    python benchmarks/launchers.py [WAY ...] [--quick]

Ways: ``joblib`` (the reference, always run), ``basic`` (Hydra's own sweeper and launcher), ``ray``
(local, two nodes), ``submitit`` (``submitit_local``) and ``optuna`` (its sweeper, all points of the
grid); without any way, all installed ways run. Install the packages of the last three ways in a
separate environment: ``pip install 'xplain-hri[ray,submitit]' hydra-optuna-sweeper``.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

SWEEP = (
    "-m",
    "domain=four_rooms",
    "users.count=2",
    "traces=1",
    "max_steps=5",
    "points=20",
    "labeler=tree",
    "clusterer=perfect",
    "tracking=none",
    "solver=qmdp,qhr",
    "lambda=0.5,1,2",
)
WAYS = {
    "joblib": (),
    "basic": ("hydra/sweeper=basic", "hydra/launcher=basic"),
    "ray": ("hydra/launcher=ray", "+hydra.launcher.ray.init.object_store_memory=null"),
    "submitit": ("hydra/launcher=submitit_local",),
    "optuna": (
        "hydra/sweeper=optuna",
        "hydra/sweeper/sampler=grid",
        "hydra.sweeper.n_trials=6",
        "hydra.sweeper.n_jobs=2",
    ),
}
TIMES = ("seconds", "started", "worker")


def main() -> int:
    """Runs the ways; the exit code is 1 if a way gives other results."""
    parser = argparse.ArgumentParser()
    parser.add_argument("ways", nargs="*", choices=[*WAYS, []])
    parser.add_argument("--quick", action="store_true", help="the reference alone, in one worker")
    given = parser.parse_args()
    installed = ("joblib", "basic", *(way for way in ("ray", "submitit", "optuna") if brought(way)))
    wrong, reference = 0, None
    for way in ["joblib"] if given.quick else dict.fromkeys(["joblib", *(given.ways or installed)]):
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder, address(way) as more:
            more += ["hydra.launcher.n_jobs=1"] if given.quick else []
            command = [sys.executable, "-m", "xplain", *SWEEP, *WAYS[way], *more]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
            found = results(Path(folder))
        reference = reference or found
        same = done.returncode == 0 and found == reference and len(found) == 6
        wrong += not same
        seconds = f"{time.monotonic() - began:.0f} s"
        print(f"{way:10} {len(found)} results, {'the same' if same else 'DIFFERENT'}, {seconds}")
        if not same:
            print(done.stderr[-3000:])
    return int(wrong > 0)


def brought(way: str) -> bool:
    """Returns True if the package of a launcher or sweeper is installed."""
    kinds = ("launcher", "sweeper")
    return any(find_spec(f"hydra_plugins.hydra_{way}_{kind}") for kind in kinds)


@contextmanager
def address(way: str) -> Iterator[list[str]]:
    """Starts a Ray cluster with two nodes on this machine, and yields its address as an override;
    yields an empty list for all other ways."""
    if way != "ray":
        yield []
        return
    os.environ["RAY_AUTH_MODE"] = "disabled"
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        yield [f"hydra.launcher.ray.init.address={cluster.address}"]
    finally:
        cluster.shutdown()


def results(folder: Path) -> dict[str, Any]:
    """Reads ``{fingerprint: results without times}``."""
    found = {}
    for path in folder.glob("outputs/results/*/results.json"):
        content = json.loads(path.read_text())
        del content["metrics"]["decision_ms"]
        found[path.parent.name] = {k: v for k, v in content.items() if k not in TIMES}
    return found


if __name__ == "__main__":
    sys.exit(main())
