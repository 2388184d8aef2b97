"""Labels, observers, and their codebook, from a collection's database that no server has open (or
from a snapshot).

    xplain collect export DATABASE FOLDER
"""

from __future__ import annotations

from xplain.cli.study.export import given, said


def main(arguments: list[str]) -> None:
    """Writes the tables and their codebook into the folder."""
    database, folder = given("xplain collect export", arguments)
    from xplain.collect.analysis.export import export

    said(folder, export(database, folder))
