"""Labels, observers, and their codebook, from a collection's database that no server has open (or
from a snapshot).

    xplain collect export DATABASE FOLDER
"""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import Parser


def main(arguments: list[str]) -> None:
    """Writes the tables and their codebook into the folder."""
    parser = Parser("xplain collect export")
    parser.add_argument("database", type=Path)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args(arguments)
    from xplain.collect.analysis.export import export

    export(given.database, given.folder)
    print(f"tables and codebook in {given.folder}")
