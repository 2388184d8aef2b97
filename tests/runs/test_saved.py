"""Results are saved before they are shown, and nothing of a user's is deleted."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests import forked, processes
from tests.runs import sweeps

MINE = ("tracking=none", "solver=mine", "--config-dir=choices")
SOLVERS = '''
import sys
from dataclasses import dataclass

from xplain.solvers.simple import Silent


@dataclass(frozen=True)
class Frugal(Silent):
    """Needs no tables, and allows none."""

    memory_gib: float = 1e-9


@dataclass(frozen=True)
class Refuses:
    """A solver that cannot plan."""

    knows: str = "types"

    def plan(self, problem, seed=0):
        raise RuntimeError("the licence server said no")


@dataclass(frozen=True)
class Exits(Refuses):
    def plan(self, problem, seed=0):
        sys.exit(0)


class Unknowing:
    def plan(self, problem, seed=0):
        return None
'''


def with_solver(folder: Path, target: str) -> None:
    """Writes ``solver=mine`` of this class, and the module own.py, into the folder."""
    choice = folder / "choices" / "solver"
    choice.mkdir(parents=True)
    (choice / "mine.yaml").write_text(f"_target_: {target}\n")
    (folder / "own.py").write_text(SOLVERS)


def run(folder: Path, *words: str) -> tuple[int, str]:
    """Runs ``xplain …`` there, flags before keys; returns exit code and all output."""
    return forked.run(folder, *sorted(words, key=lambda word: not word.startswith("-")))


def contents(folder: Path) -> dict[str, bytes]:
    """Reads ``{path: content}`` of all files except the test's own files and locks, which are
    empty."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock"]
    found = {str(path.relative_to(folder)): path.read_bytes() for path in files}
    return {name: content for name, content in found.items() if name != forked.OUTPUT}


@contextmanager
def unchanged(folder: Path) -> Iterator[None]:
    before = contents(folder)
    yield
    after = contents(folder)
    assert {name: after.get(name) for name in before} == before


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (".", ("dry_run=true",)),
        (".", ("lambda=-1",)),
        ("mine", ("dry_run=true",)),
        ("mine", ("lambda=-1",)),
        ("mine", ("lambda=abc",)),
        ("mine", ("lambda=1,2",)),
        ("mine", ("solver=nonsense",)),
        ("mine", ("domain.map=S",)),
        ("mine", ("observers=file", "observers.path=absent.csv")),
        ("mine", ("users=explicit", "users.groups={}")),
        (".", ("-m", "lambda=1,2", "dry_run=true")),
        ("mine", ("-m", "lambda=1,-2")),
    ],
)
def test_refusals_and_dry_runs_leave_a_users_files(
    tmp_path: Path, place: str, words: tuple[str, ...]
) -> None:
    for name in ("notes.txt", "mine/results.csv", "mine/deep/more.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_text("a year of work")
    with unchanged(tmp_path):
        given = (*sweeps.SINGLE, "tracking=none", f"hydra.run.dir={place}", *words)
        code, output = run(tmp_path, *given)
    assert code == (0 if "dry_run=true" in words else 2), output


def test_a_run_does_not_touch_the_results_of_another(tmp_path: Path) -> None:
    given = (*sweeps.SINGLE, "tracking=none", "hydra.run.dir=mine")
    code, output = run(tmp_path, *given)
    assert code == 0, output
    with unchanged(tmp_path):
        for words in (("lambda=2",), ("lambda=-1",), ("dry_run=true",), ("solver=nonsense",)):
            code, output = run(tmp_path, *given, *words)
            assert code == (0 if "dry_run=true" in words else 2), output
            assert words != ("lambda=2",) or "hydra.run.dir='mine': another folder" in output


def test_a_picture_that_cannot_be_drawn_costs_no_results(tmp_path: Path) -> None:
    (tmp_path / "mine" / "trace.png").mkdir(parents=True)
    code, output = run(tmp_path, *sweeps.SINGLE, "tracking=none", "hydra.run.dir=mine")
    assert code == 0, output
    assert "there is no picture: " in output
    assert {"results.json", "episodes.jsonl"} <= {p.name for p in (tmp_path / "mine").iterdir()}


def test_a_certificate_that_needs_too_much_memory_costs_no_results(tmp_path: Path) -> None:
    with_solver(tmp_path, "own.Frugal")
    with (tmp_path / "choices/solver/mine.yaml").open("a", encoding="utf-8") as file:
        file.write("memory_gib: 1e-9\n")
    words = (*MINE, "certify.traces=1", "hydra.run.dir=mine")
    code, output = run(tmp_path, *sweeps.SINGLE, *words)
    assert code == 0, output
    said = r"no certificate of trace 0: .* GiB .*solver.memory_gib=1e-09"
    assert re.search(said, output), output
    results = json.loads((tmp_path / "mine" / "results.json").read_text(encoding="utf-8"))
    assert results["bounds"] == {}
    assert results["metrics"]["cost"]
    assert "solver" in (tmp_path / "mine" / "episodes.jsonl").read_text(encoding="utf-8")


def test_a_reader_who_leaves_costs_no_results(tmp_path: Path) -> None:
    """This is ``xplain … | true``."""
    command = [sys.executable, "-m", "xplain", *sweeps.SINGLE, "tracking=none"]
    with (tmp_path / "error.txt").open("w") as stderr:
        process = processes.start(
            command, cwd=tmp_path, env=sweeps.environment(), stdout=subprocess.PIPE, stderr=stderr
        )
    process.stdout.close()
    code, error = process.wait(), (tmp_path / "error.txt").read_text()
    assert code == 0, error
    assert "closed pipe" in error
    assert "Traceback" not in error
    (results,) = tmp_path.glob("outputs/runs/*/results.json")
    assert results.stat().st_size > 1000
    assert results.with_name("trace.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("launcher", ["hydra/launcher=basic", "hydra.launcher.n_jobs=1"])
def test_a_job_that_fails_ends_no_other_and_is_told(tmp_path: Path, launcher: str) -> None:
    with_solver(tmp_path, "own.Refuses")
    (tmp_path / "choices" / "solver" / "exits.yaml").write_text("_target_: own.Exits\n")
    given = (*MINE, *sweeps.TINY[:-2], "lambda=1", "solver=mine,exits,qhr", launcher)
    code, output = run(tmp_path, *given)
    assert code == 1, output
    end = output[output.index("1 of 3 jobs finished") :]
    assert "the licence server said no" in end
    assert "sys.exit(0)" in end
    assert "report: " in end
    assert "Traceback" not in output


@pytest.mark.parametrize("given", [sweeps.SINGLE, sweeps.QUICK])
def test_no_file_and_no_line_has_a_servers_password(tmp_path: Path, given: tuple[str, ...]) -> None:
    away = "tracking.uri='http://lab:secret@127.0.0.1:9'"
    code, output = run(tmp_path, *given, away)
    assert code == 0, output
    assert "MLflow did not store the results" in output
    for name, content in {**contents(tmp_path), "output": output.encode()}.items():
        assert b"secret" not in content, name


def test_a_folder_may_have_any_letters(tmp_path: Path) -> None:
    folder = tmp_path / "Anna's 100% thesis"
    with_solver(folder, "xplain.solvers.greedy.QMDP")
    code, output = run(folder, *MINE, *sweeps.QUICK[:-3], "lambda=1", sweeps.SERIAL)
    assert code == 0, output
    assert "1 of 1 jobs finished" in output


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("own.Unknowing", "solver='Unknowing': a solver; this class lacks knows"),
        (
            "own.Exist",
            "solver._target_='own.Exist': a class; own has Frugal, Refuses, Exits, Unknowing",
        ),
        ("onw.Exits", "solver._target_='onw.Exits': a class; Python finds no module 'onw'"),
        ("own.Exits\nmemry: 3", "solver.memry=3: no parameter of own.Exits; it takes knows"),
    ],
)
def test_a_class_that_will_not_do_is_one_line_before_any_work(
    tmp_path: Path, target: str, said: str
) -> None:
    with_solver(tmp_path, target)
    with unchanged(tmp_path):
        for more in ((), ("-m", "lambda=1,2")):
            code, output = run(tmp_path, *sweeps.SINGLE, *MINE, *more)
            assert code == 2, output
            assert output.startswith(f"xplain: {said}")
            assert output.count("\n") == 1
    assert not (tmp_path / "outputs" / "cache").exists()
