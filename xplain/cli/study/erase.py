"""Erases everything that one participant did or said, by the reference they were given.

    xplain study erase DATABASE REFERENCE

The database is one that no server has open; a running server's page can do the same. The erasure
is written to the log, which can still be checked. Exports and backups made before keep the data.
"""

from __future__ import annotations

from xplain.cli.parser import parsed
from xplain.errors import InputError


def main(arguments: list[str]) -> None:
    """Erases, for ever."""
    given = parsed("xplain study erase", arguments, "database", "reference")
    if not given.database.is_file():
        raise InputError("database", str(given.database), "a study's database")
    from xplain.people.server.database import Database

    database = Database(given.database)
    try:
        database.erase(given.reference)
    finally:
        database.close()
    print(f"erased {given.reference}; delete exports and backups that were made before, too")
