"""Erases everything that one participant did or said, by the reference they were given.

    xplain study erase DATABASE REFERENCE

The database is one that no server has open; a running server's page can do the same. The erasure
is written to the log, which can still be checked. Exports and backups made before keep the data.
"""

from functools import partial

from xplain.cli import people

main = partial(people.erase, "study")
