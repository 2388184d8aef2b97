"""Collects labels from people in a web page: ``xplain collect domain=rescue``, or
``xplain collect transitions=TABLE.csv facts=FACTS.csv`` for one's own robot.

Before the first start it says what to expect, from simulated people. That start fixes the
collection in its database; later starts go on with it. How a lab does it: docs/collect.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from xplain.cli.study.serve import check_address, database_of, run_server, server_of
from xplain.config import composed, require_seed

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from xplain.collect.protocol.plan import Collection


def main(arguments: list[str]) -> None:
    """Serves the collection that overrides of conf/collect.yaml describe."""

    cfg = composed("collect", arguments)
    require_seed(cfg)
    check_address(cfg)
    path = database_of(cfg)
    server = server_of(cfg)
    collection, ignored = running_collection(cfg, path)
    if ignored:
        print(
            f"collect: goes on as it was started; these keys differ now and are ignored: "
            f"{', '.join(ignored)}",
            file=sys.stderr,
        )
    print(expected(collection.plan.expectation), file=sys.stderr)
    run_server(collection, server, path, cfg, "collect")


def running_collection(cfg: DictConfig, path: Path) -> tuple[Collection, list[str]]:
    """The collection in the database, or a new one; and the keys of ``cfg`` that it does not
    follow."""
    from xplain.collect.prepare import collect_plan
    from xplain.collect.probes import collection_of
    from xplain.collect.stored import read_plan
    from xplain.study.settings import fixed
    from xplain.study.stored import renamed

    plan = read_plan(path)
    if plan is None:
        print("collect: asking simulated people first …", file=sys.stderr)
        return collection_of(collect_plan(cfg)), []
    now = fixed(cfg)
    ignored = [key for key in now if now[key] != renamed(plan.config.get(key))]
    return collection_of(plan), ignored


def expected(figures: Mapping[str, float]) -> str:
    """What simulated people let one expect, in a line or two."""
    lines = [
        f"collect: expect of {figures['people']:.0f} people × {figures['labels']:.0f} labels, "
        f"{figures['error']:.0%} of them wrong: types found with an adjusted Rand index of "
        f"{figures['rand_index']:.2f} (1 is perfect; least {figures['rand_index_least']:.2f} of "
        f"{figures['runs']:.0f} simulations; {figures['rand_index_more']:.2f} with ten more people)"
    ]
    if "cost" in figures:
        lines.append(
            f"collect: an explanation then costs {figures['cost']:.2f} (λ = 1); knowing every "
            f"label, {figures['floor']:.2f}"
        )
    return "\n".join(lines)
