"""Reading a study's database: also one that an older version wrote, or nobody finished."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from hydra.utils import get_class

from tests.people.study.stand_in import street_plan
from xplain.errors import InputError
from xplain.people.analysis.stored import MOVED, plan_of, read_plan, reading, renamed
from xplain.people.study.plan import StudyPlan
from xplain.people.study.site import StudySite

STORED = [
    "xplain.data.observers.SimulatedObservers",
    "xplain.data.queries.Shared",
    "xplain.evaluation.explainees.Slips",
    "xplain.learning.dirichlet.DirichletMixture",
    "xplain.questions.labeler.HypothesisTrainer",
    "xplain.solvers.certified.Certified",
    "xplain.solvers.pomcp.POMCP",
    "xplain.users.observers.FileObservers",
    "xplain.users.types.RandomCover",
]
"""Components as older plans name them: one of each module that has moved."""


def test_each_moved_module_has_a_component_here() -> None:
    assert {name.rpartition(".")[0] for name in STORED} == MOVED.keys()


@pytest.mark.parametrize("old", STORED)
def test_a_moved_component_is_where_the_table_says_and_no_longer_where_it_was(old: str) -> None:
    assert get_class(renamed({"_target_": old})["_target_"]).__name__ == old.rpartition(".")[2]
    with pytest.raises(ImportError):
        get_class(old)


def test_names_are_renamed_wherever_a_class_is_named_and_nowhere_else() -> None:
    old, new = "xplain.users.types.RandomCover", "xplain.domains.users.types.RandomCover"
    config = {"a": [{"_target_": old, "note": old}], "b": {"_target_": "builtins.dict"}, "c": 1.5}
    expected = {"a": [{"_target_": new, "note": old}], "b": {"_target_": "builtins.dict"}, "c": 1.5}
    assert renamed(config) == expected
    assert config["a"][0]["_target_"] == old  # type: ignore[index]


def test_a_plan_with_names_of_before_goes_on_and_keeps_its_hash() -> None:
    old, new = "xplain.solvers.pomcp.POMCP", "xplain.solvers.pomcp.solver.POMCP"
    solvers = {"personalized": {"_target_": new, "simulations": 50}}
    plan = street_plan(conditions=solvers | {"conformant": solvers["personalized"]})
    text = plan.text.replace(json.dumps(new), json.dumps(old))
    assert text != plan.text
    study = StudySite.of(StudyPlan.from_text(text)).flow
    assert study.plan.text == text
    assert study.plan.probes == plan.probes


def test_a_database_without_a_plan_is_a_start_for_the_server_and_no_data(tmp_path: Path) -> None:
    path = tmp_path / "study.sqlite"
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL)")
    assert read_plan(path, StudyPlan) is None
    assert read_plan(tmp_path / "none.sqlite", StudyPlan) is None
    with pytest.raises(InputError, match=r"study\.sqlite"), reading(path) as opened:
        plan_of(opened, StudyPlan)
