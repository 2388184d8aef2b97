"""Erases everything that one participant did or said, by the reference they were given.

    xplain collect erase DATABASE REFERENCE

The database is one that no server has open; a running server's page can do the same. The erasure
is written to the log, which can still be checked. Exports and backups made before keep the data.

What was learned from their answers before, about which questions tell most of others, stays in the
log without answers or reference: the questions of those who came after followed from it.
"""

from functools import partial

from xplain.cli import people

main = partial(people.erase, "collect")
