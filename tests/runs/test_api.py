"""From Python: the same runs, folders and errors as on the command line."""

from __future__ import annotations

import datetime
import importlib
import json
import logging
import os
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra

import xplain
from tests import forked
from tests.conftest import ROOT
from tests.runs import sweeps
from tests.runs.sweeps import SERIAL
from xplain.errors import InputError, XplainError
from xplain.solvers.greedy import QMDP
from xplain.solvers.simple import QHR

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

sys.path.append(str(Path(__file__).with_name("own")))
_own = importlib.import_module("own_solvers")
Named, Talkative = _own.Named, _own.Talkative


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_pictures: None) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_run_is_that_of_the_command_line(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = xplain.run("solver=qhr", *SMALL, trade_off=1.5)
    assert capsys.readouterr().out == ""
    sweeps.output_of(here / "other", "solver=qhr", *SMALL, "lambda=1.5", SERIAL)
    (folder,) = (here / "other" / "outputs" / "runs").iterdir()
    shown = xplain.load(folder)
    assert isinstance(shown, xplain.Run)
    assert shown.results.fingerprint == run.results.fingerprint
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


def test_a_sweep_takes_lists_and_objects_and_gives_frames_and_axes(
    here: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("xplain.report.stages.EVERY", 0.0)
    monkeypatch.setattr("xplain.runs.sweep.POLL", 0.05)
    caplog.set_level(logging.INFO, "xplain")
    sweep = xplain.sweep(*SMALL, SERIAL, solver=[QMDP(), "qhr", QHR()], trade_off=[0.5, 2])
    told = re.findall("^sweep: (.) of 6 jobs done, 0 failed(.*)$", "\n".join(caplog.messages), re.M)
    assert any(left for _, left in told)
    for count, left in told:
        assert bool(re.fullmatch(r", about 0:0\d:\d\d left", left)) == (count in "12345")
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
    about = json.loads((sweep.folder / "sweep.json").read_text())
    assert about["command"] == " ".join(("python -m xplain -m", SERIAL, *SMALL, "solver=qhr"))
    named = [{*job["overrides"]} - {*SMALL} for job in about["jobs"]]
    assert named == [set(), set(), {"solver=qhr"}, {"solver=qhr"}, set(), set()]


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"lamda": 3}, "lamda: no such key; did you mean lambda?"),
        ({"tradeoff": 3}, "tradeoff: no such key; did you mean trade_off?"),
        ({"users_counts": 3}, "users.counts: no such key; did you mean users.count?"),
        ({"solver": "nonsense"}, "solver=nonsense: unknown choice"),
        ({"trade_off": -1}, "lambda (trade_off)=-1.0: a number ≥ 0"),
        ({"solver": object()}, "an object of a dataclass at the top level of a module"),
        ({"config_dir": "absent"}, "a folder with choices of your own"),
        ({"dry_run": True}, "only the command line has dry runs"),
    ],
)
def test_what_is_wrong_is_one_line(here: Path, keys: dict[str, Any], said: str) -> None:
    for start in (xplain.run, xplain.sweep):
        with pytest.raises(XplainError) as error:
            start(*SMALL, **keys)
        assert said in str(error.value)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="of a run or a sweep"):
        xplain.load(here)
    with pytest.raises(XplainError, match=r"^lambda.*=\[1, 2\]: one value; xplain\.sweep accepts"):
        xplain.run(*SMALL, trade_off=[1, 2])


TEXTS = ["null", "true", "1e3", "ä λ\n", "a\\'b", "${x}".replace("$", "§"), "x,y", "[1]", ""]


def test_values_arrive_as_they_are_given_and_equal_objects_are_one_job(here: Path) -> None:
    every = dict.fromkeys(TEXTS, 1.0) | {"of": TEXTS}
    other = {"": 1.0}
    given = [
        ("null", every),
        ("1e3", every),
        ("1e3", dict([*every.items()][::-1])),
        ("\\${x}", other),
    ]
    solvers = [Named(text=text, cells=((6, 2),), fees=fees) for text, fees in given]
    assert solvers[1] == solvers[2]
    sweep = xplain.sweep(*SMALL, SERIAL, solver=solvers, seed=range(2), outputs=here / "a ${b}'c")
    configs = [run.results.config for run in sweep.runs]
    found = [(own["solver"]["text"], own["solver"]["fees"], own["seed"]) for own in configs]
    wanted = [(*own, seed) for own in (given[0], given[1], given[3]) for seed in (0, 1)]
    assert len(found) == 6
    assert all(own in found for own in wanted)
    assert all(config["solver"]["cells"] == [[6, 2]] for config in configs)
    assert sweep.folder.is_relative_to(here / "a ${b}'c")
    for seed in (np.arange(2), [np.int64(0), np.int64(1)]):
        again = xplain.sweep(*SMALL, SERIAL, solver=solvers, seed=seed, outputs=here / "a ${b}'c")
        assert again.folder == sweep.folder
    run = xplain.run(*SMALL, trade_off=np.float32(0.5), message_cost={"goals": 2.0, **FEES})
    assert run.results.config["message_cost"]["goals"] == 2.0
    assert run.results.trade_off == 0.5


FEES = dict.fromkeys(("discount", "step_cost", "penalty_cells", "penalty"), 1.0)


SCRIPT = """
from dataclasses import dataclass, field
import xplain
from xplain.errors import XplainError
from xplain.solvers.simple import QHR

@dataclass(frozen=True)
class Mine(QHR):
    extra: float = 1.0

if __name__ == "__main__":
    small = {small!r}
    run = xplain.run(*small, solver=Mine())
    assert run.results.solver.startswith("Mine_")
    try:
        xplain.sweep(*small, solver=[Mine(), Mine(2.0)])
    except XplainError as error:
        print("said:", error)
    print(len(xplain.sweep(*small, {serial!r}, solver=[Mine(), Mine(2.0)]).runs), "jobs")
"""


def test_a_component_of_the_script_itself_runs_in_this_process(here: Path) -> None:
    (here / "script.py").write_text(SCRIPT.format(small=SMALL, serial=SERIAL))
    done = forked.captured(here, "script.py")
    assert done.returncode == 0, done.stderr
    said, jobs = done.stdout.splitlines()
    assert said.startswith("said: solver='__main__.Mine': a component from a file")
    assert jobs == "2 jobs"
    assert "2 of 2 jobs finished" in done.stderr


def test_a_module_that_was_edited_is_refused_until_it_is_loaded_again(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The results of the old code would be stored at the address of the new code."""
    monkeypatch.syspath_prepend(str(here))
    source = here / "stale.py"
    source.write_text("from xplain.solvers.simple import Silent\nclass Mine(Silent): pass\n")
    importlib.invalidate_caches()
    loaded = importlib.import_module(source.stem)
    for _ in range(2):
        first = xplain.run(*SMALL, solver=loaded.Mine())
        os.utime(source, (1, 1))  # copied, and the same
    source.write_text("from xplain.solvers.simple import SayAll\nclass Mine(SayAll): pass\n")
    for start in (xplain.run, xplain.sweep):
        with pytest.raises(XplainError, match="was edited after it was loaded; reload or restart"):
            start(*SMALL, solver=loaded.Mine())
    importlib.reload(loaded)
    again = xplain.run(*SMALL, solver=loaded.Mine())
    assert first.results.fingerprint != again.results.fingerprint
    assert first.results.metrics["messages"].mean == 0 < again.results.metrics["messages"].mean


def test_a_program_keeps_its_own_settings_and_what_a_component_prints(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before, level = dict(matplotlib.rcParams), logging.getLogger("mlflow").level
    variables = {name for name in os.environ if name.startswith("MLFLOW")}
    bare = SimpleNamespace(write=len, flush=lambda: None)  # as a program may replace it
    monkeypatch.setattr(sys, "stderr", bare)
    hydra = GlobalHydra.instance().hydra
    xplain.run(*SMALL, solver=Talkative()).plot()
    assert set(capsys.readouterr().out.split()) == {"planning"}
    assert GlobalHydra.instance().hydra is hydra
    assert dict(matplotlib.rcParams) == before
    assert logging.getLogger("mlflow").level == level
    assert {name for name in os.environ if name.startswith("MLFLOW")} == variables


def test_two_threads_have_the_runs_that_each_asked_for() -> None:
    def started(solver: str) -> str:
        return xplain.sweep(*SMALL, SERIAL, solver=solver, trade_off=[1]).runs[0].results.solver

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(started, ("qhr", "silent"))) == ["qhr", "silent"]


def test_the_cells_of_the_notebook_run(here: Path) -> None:
    notebook = json.loads((ROOT / "examples" / "experiments.ipynb").read_text("utf-8"))
    cells = ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]
    assert len(cells) >= 8
    assert not any(c.get("outputs") for c in notebook["cells"])  # none are kept
    names: dict[str, Any] = {}
    for cell in cells:
        exec(compile(cell, "experiments.ipynb", "exec"), names)
    assert names["sweep"].answer
