"""Recomputes every question and posterior of a collection from its log, and compares.

    xplain collect replay DATABASE [--head DIGEST]

``--head`` is the head of the log that an earlier export printed: everything up to it must be as it
was then. The database is one that no server has open. Exit code 1 where anything differs.
"""

from functools import partial

from xplain.cli import people

main = partial(people.replay, "collect")
