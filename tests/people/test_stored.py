"""Reading a study's database: also one that nobody finished."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from xplain.errors import InputError
from xplain.people.export import read, read_plan
from xplain.people.study.flow import StudyState
from xplain.people.study.plan import StudyPlan


def test_a_database_without_a_plan_is_a_start_for_the_server_and_no_data(tmp_path: Path) -> None:
    path = tmp_path / "study.sqlite"
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
    assert read_plan(path, StudyPlan) is None
    assert read_plan(tmp_path / "none.sqlite", StudyPlan) is None
    with pytest.raises(InputError, match=r"study\.sqlite"):
        read(path, StudyPlan, StudyState)
