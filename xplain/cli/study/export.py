"""CSV and Parquet tables, and their codebook, from a study's database that no server has open (or
from a snapshot).

    xplain study export DATABASE FOLDER
"""

from __future__ import annotations

from pathlib import Path

from xplain.cli.parser import Parser


def main(arguments: list[str]) -> None:
    """Writes the tables and their codebook into the folder."""
    database, folder = given("xplain study export", arguments)
    from xplain.study.analysis.export import export

    said(folder, export(database, folder))


def given(name: str, arguments: list[str]) -> tuple[Path, Path]:
    """Database and folder, of any protocol's command."""
    parser = Parser(name)
    parser.add_argument("database", type=Path)
    parser.add_argument("folder", type=Path)
    found = parser.parse_args(arguments)
    return found.database, found.folder


def said(folder: Path, head: str) -> None:
    """Where the tables are, and the head of the log."""
    print(f"tables and codebook in {folder}\nhead of the log: {head}")
