"""Collects labels from people in a web page: ``xplain collect domain=rescue``, or
``xplain collect transitions=TABLE.csv facts=FACTS.csv`` for one's own robot.

Before the first start it says what to expect, from simulated people. That start fixes the
collection in its database; later starts go on with it. How a lab does it: docs/collect.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping

from xplain.cli.study.serve import checked, run_server, running
from xplain.config import composed, require_seed


def main(arguments: list[str]) -> None:
    """Serves the collection that overrides of conf/collect.yaml describe."""
    cfg = composed("collect", arguments)
    require_seed(cfg)
    path, server = checked(cfg)
    from xplain.collect.prepare import collect_plan
    from xplain.collect.probes import collection_of
    from xplain.collect.protocol.plan import CollectPlan
    from xplain.collect.server.protocol import CollectProtocol

    plan = running(cfg, path, CollectPlan, collect_plan)
    print(expected(plan.expectation), file=sys.stderr)
    run_server(CollectProtocol(collection_of(plan)), server, path, cfg)


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
