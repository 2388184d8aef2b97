"""CSV and Parquet tables, and their codebook, from a study's database that no server has open (or
from a snapshot).

    xplain study export DATABASE FOLDER
"""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import Parser


def main(arguments: list[str]) -> None:
    """Writes the tables and their codebook into the folder."""
    parser = Parser("xplain study export")
    parser.add_argument("database", type=Path)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args(arguments)
    from xplain.study.analysis.export import export

    head = export(given.database, given.folder)
    print(f"tables and codebook in {given.folder}\nhead of the log: {head}")
