"""Recomputes every belief and message of a study from its log, and compares.

    xplain study replay DATABASE [--head DIGEST]

``--head`` is the head of the log that an earlier export printed: everything up to it must be as it
was then. The database is one that no server has open. Exit code 1 where anything differs.
"""

from functools import partial

from xplain.cli import people

main = partial(people.replay, "study")
