"""Results are saved before they are shown, nothing of a user's is deleted, and a sweep's folder has
one process at a time."""

import json
import logging
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests import forked, processes
from tests.report import handmade
from tests.runs import sweeps
from tests.runs.sweeps import output_of
from xplain.cli.main import main
from xplain.errors import InputError
from xplain.experiment.results import load_results, save_results
from xplain.runs.folder import alone, find_unlisted_results

MINE = ("tracking=none", "solver=mine", "--config-dir=choices")


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


REFUSED = (
    (".", "dry_run=true"),
    (".", "lambda=-1"),
    ("mine", "dry_run=true"),
    ("mine", "lambda=-1"),
    ("mine", "lambda=abc"),
    ("mine", "lambda=1,2"),
    ("mine", "tracking=null"),
    ("mine", "domain.map=S"),
    ("mine", "observers=file", "observers.path=absent.csv"),
    ("mine", "users=explicit", "users.groups={}"),
    (".", "-m", "lambda=1,2", "dry_run=true", sweeps.SERIAL),
    ("mine", "-m", "lambda=1,-2", sweeps.SERIAL),
    ("done", "lambda=-1"),
    ("done", "dry_run=true"),
    ("done", "solver=nonsense"),
)


def test_refusals_and_dry_runs_leave_a_users_files_and_other_results(tmp_path: Path) -> None:
    for name in ("notes.txt", "mine/results.csv", "mine/deep/more.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_text("a year of work")
    given = (*sweeps.SINGLE, "tracking=none", "certify.traces=1")
    shown, made = output_of(tmp_path, *given, "hydra.run.dir=done"), load_results(tmp_path / "done")
    for figure in (made.metrics["cost"].mean, made.bounds["policy_cost"]):
        assert f" {figure:.3f}" in shown
    with unchanged(tmp_path):
        for place, *words in REFUSED:
            code = 0 if "dry_run=true" in words else 2
            said = output_of(tmp_path, *given, f"hydra.run.dir={place}", *words, code=code)
            assert code or re.search("^(1 job, done|2 jobs: 1 done, 1 to run)$", said, re.MULTILINE)
        said = output_of(tmp_path, *given, "hydra.run.dir=done", "lambda=2", code=2)
    assert "hydra.run.dir='done': another folder" in said


def test_a_picture_that_cannot_be_drawn_costs_no_results(tmp_path: Path) -> None:
    (tmp_path / "mine" / "trace.png").mkdir(parents=True)
    output = output_of(tmp_path, *sweeps.SINGLE, "tracking=none", "hydra.run.dir=mine")
    assert "there is no picture: " in output
    assert {"results.json", "episodes.jsonl"} <= {p.name for p in (tmp_path / "mine").iterdir()}


def test_a_certificate_that_needs_too_much_memory_costs_no_results(tmp_path: Path) -> None:
    sweeps.with_solver(tmp_path, "own.Frugal\nmemory_gib: 1e-9")
    words = (*MINE, "certify.traces=1", "hydra.run.dir=mine")
    output = output_of(tmp_path, *sweeps.SINGLE, *words)
    said = r"no certificate of trace 0: .* GiB .*solver.memory_gib=1e-09"
    assert re.search(said, output), output
    results = json.loads((tmp_path / "mine" / "results.json").read_text(encoding="utf-8"))
    assert (results["bounds"], results["certificates"]) == ({}, "failed")
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


@pytest.mark.parametrize("launcher", [sweeps.SERIAL, sweeps.IN_TURN])
def test_jobs_that_fail_end_no_other_and_alone_run_again(folder: Path, launcher: str) -> None:
    for target, name in (("own.Refuses", "mine"), ("own.Exits", "exits")):
        sweeps.with_solver(folder, target, name)
    words = (*sweeps.TINY[:-2], "lambda=1", "solver=mine,exits,qhr", "--config-dir=choices")
    output = output_of(folder, *words, launcher, code=1)
    end = output[output.index("1 of 3 jobs finished") :]
    for said in ("the licence server said no", "sys.exit(0)", "report: "):
        assert said in end
    first = r"^first failure: .*mine.*: RuntimeError: the licence server said no"
    assert re.search(first, output, re.MULTILINE)
    assert "Traceback" not in output
    states = {name.split()[0]: status for name, status, _ in sweeps.runs(folder)}
    (sweep,) = states.keys() - {"mine", "exits", "qhr"}
    assert states == {"qhr": "FINISHED"} | dict.fromkeys(("mine", "exits", sweep), "FAILED")
    # Only what failed runs again; jobs that were lost besides do not.
    (lost,) = folder.glob("outputs/results/*/results.json")
    lost.unlink()
    output = output_of(folder, *words, launcher, "resume=failed", code=1)
    assert "2 jobs to run" in output
    assert not lost.exists()
    assert len(sweeps.runs(folder)) == 4


@pytest.mark.parametrize("given", [sweeps.SINGLE, sweeps.QUICK])
def test_no_file_and_no_line_has_a_servers_password(tmp_path: Path, given: tuple[str, ...]) -> None:
    away = "tracking.uri='http://lab:secret@127.0.0.1:9'"
    output = output_of(tmp_path, *given, away)
    assert "MLflow did not store the results" in output
    for name, content in {**contents(tmp_path), "output": output.encode()}.items():
        assert b"secret" not in content, name
        assert not name.endswith("mlflow.db")


def test_a_folder_may_have_any_letters(tmp_path: Path) -> None:
    folder = tmp_path / "Anna's 100% thesis? ${a}"
    sweeps.with_solver(folder, "xplain.solvers.greedy.QMDP")
    output = output_of(folder, *sweeps.SINGLE, "tracking=mlflow") + output_of(
        folder, *MINE, *sweeps.QUICK[:-3], "lambda=1", sweeps.SERIAL
    )
    assert re.search("folder: outputs/runs/.*MLflow: .*1 of 1 jobs finished", output, re.DOTALL)


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("own.Unknowing", "solver='Unknowing': a solver; this class lacks knows"),
        (
            "own.Exist",
            "solver._target_='own.Exist': a class; own has Frugal, Refuses, Exits, Dies, Unknowing",
        ),
        ("onw.Exits", "solver._target_='onw.Exits': a class; Python finds no module 'onw'"),
        ("own.Exits\nmemry: 3", "solver.memry=3: no parameter of own.Exits; it takes knows"),
    ],
)
def test_a_class_that_will_not_do_is_one_line_before_any_work(
    tmp_path: Path, target: str, said: str
) -> None:
    sweeps.with_solver(tmp_path, target)
    with unchanged(tmp_path):
        for more in ((), ("-m", "lambda=1,2", sweeps.SERIAL)):
            output = output_of(tmp_path, *sweeps.SINGLE, *MINE, *more, code=2)
            assert output.startswith(f"xplain: {said}")
            assert output.count("\n") == 1
    assert not (tmp_path / "outputs" / "cache").exists()


def test_one_at_a_time_has_a_sweep_also_before_its_folder_is_there(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    folder, order = tmp_path / "sweeps" / "new-1", []

    def second() -> None:
        with alone(folder, "another process has it"):
            order.append("second")

    with ThreadPoolExecutor(1) as pool, alone(folder, "nobody has it"):
        waiting = pool.submit(second)
        while "another process has it" not in caplog.text and not waiting.done():
            time.sleep(0.05)
        order.append("first")
    assert order == ["first", "second"]
    assert "nobody has it" not in caplog.text


def result_at(folder: Path, fingerprint: str) -> None:
    """Writes a result, and nothing else."""
    folder.mkdir(parents=True)
    save_results(folder, handmade.results(fingerprint, {}, ()))


def test_a_sweep_on_another_disk_finds_its_results(tmp_path: Path) -> None:
    outputs = tmp_path / "outputs"
    outputs.mkdir()
    (tmp_path / "disk" / "deep").mkdir(parents=True)
    (outputs / "sweeps").symlink_to(tmp_path / "disk" / "deep")
    folder = sweeps.planned(outputs, 1)
    result_at(outputs / "results" / "f0", "f0")
    assert [folder.state(job) for job in folder.jobs] == ["finished"]


def test_results_that_no_run_and_no_sweep_has_are_listed_and_deleted_when_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs = tmp_path / "outputs"
    folder = sweeps.planned(outputs, 2)
    by_another_sweeper = folder.path.with_name("basic") / "jobs" / "f7"
    by_another_sweeper.mkdir(parents=True)
    for name in ("f0", "f1", "f7", "run", "lost", "old"):
        result_at(outputs / "results" / name, name)
    result_at(outputs / "runs" / "mine", "run")
    assert {path.name for path in find_unlisted_results(outputs)} == {"lost", "old"}
    assert all(size > 0 for size in find_unlisted_results(outputs).values())
    main(["clean", "--outputs", str(outputs)])
    assert len([*(outputs / "results").iterdir()]) == 6
    main(["clean", "--outputs", str(outputs), "--delete"])
    left = {path.name for path in (outputs / "results").iterdir()}
    assert left == {"f0", "f1", "f7", "run"}
    said = r"(.* MiB .*(lost|old)\n){2}2 .* clean --delete .*\n(.*\n){2}2 results, .*deleted\n"
    assert re.fullmatch(said, capsys.readouterr().out)
    (folder.path / "sweep.json").write_text("not JSON")  # whose results are they?
    with pytest.raises(InputError):
        find_unlisted_results(outputs)
