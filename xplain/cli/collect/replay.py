"""Recomputes every question and posterior of a collection from its log, and compares.

    xplain collect replay DATABASE [--head DIGEST]

``--head`` is the head of the log that an earlier export printed: everything up to it must be as it
was then. The database is one that no server has open. Exit code 1 where anything differs.
"""

from __future__ import annotations

from xplain.cli.study.replay import compare


def main(arguments: list[str]) -> None:
    """Compares, and ends the process with exit code 1 where anything differs."""
    from xplain.collect.analysis.replay import replay
    from xplain.collect.probes import collection_of
    from xplain.collect.protocol.plan import CollectPlan

    compare(arguments, CollectPlan, collection_of, replay)
