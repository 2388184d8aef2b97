"""From Python: the same runs, folders and errors as on the command line."""

from __future__ import annotations

import datetime
import json
import logging
import os
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra

import xplain
from tests.conftest import ROOT
from tests.runs import sweeps
from xplain.domains.base import Item
from xplain.errors import InputError, XplainError
from xplain.explanation.problem import Problem
from xplain.runs.api import _words
from xplain.solvers.base import Policy
from xplain.solvers.qhr import QHR
from xplain.solvers.qmdp import QMDP

SMALL = (
    "domain=four_rooms",
    "users.count=2",
    "traces=2",
    "max_steps=5",
    "points=20",
    "labeler=tree",
    "clusterer=perfect",
    "certify.traces=0",
    "tracking=none",
)
SERIAL = "hydra/launcher=basic"


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_run_is_that_of_the_command_line(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = xplain.run("solver=qhr", *SMALL, trade_off=1.5)
    assert capsys.readouterr().out == ""
    code, output = sweeps.run(here / "other", "solver=qhr", *SMALL, "lambda=1.5", SERIAL)
    assert code == 0, output
    (folder,) = (here / "other" / "outputs" / "runs").iterdir()
    shown = xplain.load(folder)
    assert isinstance(shown, xplain.Run)
    assert shown.results.stamp == run.results.stamp
    assert shown.results.episodes == run.results.episodes
    frame = run.frame()
    own = frame[frame["solver"] == "solver"]
    assert own["cost"].mean() == pytest.approx(run.results.metrics["cost"].mean)
    assert run.results.trade_off == 1.5
    assert len(run.plot()) >= 2
    assert "cost" in run._repr_html_()
    # What is finished is taken into a sweep.
    one = xplain.sweep("solver=qhr", *SMALL, SERIAL, trade_off=[1.5])
    assert one.runs[0].results.started == run.results.started


@dataclass(frozen=True)
class Talkative(QHR):
    """A solver that prints."""

    def plan(self, problem: Problem, seed: int = 0) -> Policy:
        print("planning")
        return super().plan(problem, seed)


def test_what_a_component_prints_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    xplain.run(*SMALL, solver=Talkative())
    assert set(capsys.readouterr().out.split()) == {"planning"}


def test_runs_within_a_second_have_folders_of_their_own(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Still(datetime.datetime):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> Still:
            return cls(2026, 1, 1, 12, 0, 0, tzinfo=tz)

    monkeypatch.setattr("hydra.core.utils.datetime", Still)
    runs = [xplain.run("solver=silent", *SMALL, trade_off=asked) for asked in (0.5, 1.0)]
    assert len({run.folder for run in runs}) == 2
    assert [run.results.trade_off for run in runs] == [0.5, 1.0]


def test_a_sweep_takes_lists_and_objects_and_gives_frames_and_axes(here: Path) -> None:
    sweep = xplain.sweep(*SMALL, SERIAL, solver=[QMDP(), "qhr", QHR()], trade_off=[0.5, 2])
    frame = sweep.frame()
    assert frame["lambda"].tolist() == [0.5, 2] * 3
    costs = frame.pivot_table("cost", "lambda", "solver", sort=False)
    named, objects = costs["qhr"], costs[next(c for c in costs if c.startswith("QHR_"))]
    np.testing.assert_allclose(named, objects)  # the same solver, by name and as an object
    episodes = sweep.frame("episodes")
    assert len(episodes) == 6 * 2 * 2
    assert sweep.answer.startswith("Least cost: ")
    axes = sweep.plot()
    assert {line.get_label() for line in axes[0].containers} > {"QHR"}
    assert sweep.plot("messages")[0].get_ylabel() == "messages"
    assert "±" in sweep._repr_html_()
    again = xplain.load(sweep.folder)
    assert isinstance(again, xplain.Sweep)
    assert again.frame().equals(frame)
    command = json.loads((sweep.folder / "sweep.json").read_text())["command"]
    assert command.startswith("python -m xplain -m ")
    assert "domain=four_rooms" in command


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"lamda": 3}, "lamda: no such key; did you mean lambda?"),
        ({"solver": "nonsense"}, "solver=nonsense: unknown choice"),
        ({"trade_off": -1}, "lambda=-1.0: a number ≥ 0"),
        ({"solver": object()}, "an object of a dataclass in a module"),
        ({"config_dir": "absent"}, "a folder with choices of your own"),
    ],
)
def test_what_is_wrong_is_one_line(keys: dict[str, Any], said: str) -> None:
    for start in (xplain.run, xplain.sweep):
        with pytest.raises(XplainError) as error:
            start(*SMALL, **keys)
        assert said in str(error.value)
        assert "\n" not in str(error.value)


def test_folders_and_rows_that_are_none_are_told(here: Path) -> None:
    with pytest.raises(InputError, match="of a run or a sweep"):
        xplain.load(here)
    with pytest.raises(InputError, match="false: nothing ran"):
        xplain.run(*SMALL, dry_run=True)


def test_values_are_written_as_the_command_line_has_them() -> None:
    item = Item("goal", "G", ((0, 2),))
    for value in (item, [item]):
        (word,) = _words({"domain": value})
        assert word.startswith("domain=Item_")
    assert _words({"trade_off": [0.5, 1], "dry_run": True, "prior": None}) == [
        "lambda=0.5,1",
        "dry_run=true",
        "prior=null",
    ]
    assert _words({"seed": range(2), "trade_off": np.linspace(0.5, 1, 2)}) == [
        "seed=0,1",
        "lambda=0.5,1.0",
    ]
    assert _words({"seed": [np.int64(1)], "outputs": Path("else where")}) == [
        "seed=1",
        "outputs='else where'",
    ]
    assert _words({"users_count": 2, "max_steps": 3}) == ["users.count=2", "max_steps=3"]
    assert _words({"cells": [[[6, 2]]]}) == ["cells=[[6,2]]"]
    assert _words({"domain.map": "S.'\n", "message_cost": {"fire": 2}}) == [
        "domain.map='S.\\'\n'",
        "message_cost={fire: 2}",
    ]


@dataclass(frozen=True)
class Fees:
    """A choice that somebody may write, with a table."""

    of: Mapping[str, float]


def test_equal_objects_are_one_value_and_others_another() -> None:
    one, same = Fees({"fire": 2.0, "smoke": 1.0}), Fees({"smoke": 1.0, "fire": 2.0})
    assert one == same
    assert _words({"domain": one}) == _words({"domain": same})
    others = [Fees({"fire": 1.0, "smoke": 2.0}), Fees({"fire": 2.0}), Fees({})]
    assert len({*_words({"domain": one}), *(_words({"domain": o})[0] for o in others)}) == 4


class Tee:
    """Standard error as a program may replace it."""

    def write(self, text: str) -> int:
        return len(text)

    def flush(self) -> None:
        pass


def test_a_program_keeps_its_own_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    before, level = dict(matplotlib.rcParams), logging.getLogger("mlflow").level
    variables = {name for name in os.environ if name.startswith("MLFLOW")}
    monkeypatch.setattr(sys, "stderr", Tee())
    xplain.run(*SMALL).plot()
    assert dict(matplotlib.rcParams) == before
    assert logging.getLogger("mlflow").level == level
    assert {name for name in os.environ if name.startswith("MLFLOW")} == variables


def test_two_threads_have_the_runs_that_each_asked_for() -> None:
    def started(solver: str) -> str:
        return xplain.sweep(*SMALL, SERIAL, solver=solver, trade_off=[1, 2]).runs[1].results.solver

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(started, ("qhr", "silent"))) == ["qhr", "silent"]


def test_a_program_that_uses_hydra_itself_keeps_its_own() -> None:
    kept = GlobalHydra.instance().hydra
    xplain.run(*SMALL)
    assert GlobalHydra.instance().hydra is kept


def test_the_cells_of_the_notebook_run(here: Path) -> None:
    notebook = json.loads((ROOT / "examples" / "experiments.ipynb").read_text("utf-8"))
    cells = ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    assert len(cells) >= 8
    assert not any(c.get("outputs") for c in notebook["cells"])  # none are kept
    names: dict[str, Any] = {}
    for cell in cells:
        exec(compile(cell, "experiments.ipynb", "exec"), names)
    assert names["sweep"].answer
