"""Sweeps from the command line: what runs, what is skipped, what a failure does."""

from __future__ import annotations

import json
import re
import shutil

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from tests import forked
from tests.configurations import composed
from tests.runs import sweeps
from xplain.experiment.config import CONF
from xplain.runs import hydra_plugins, sweep
from xplain.runs.mlflow import Disk
from xplain.runs.reuse import Todo
from xplain.runs.sweep import carry_out


def results(folder):
    """``{job: (time of its results, results without times)}``."""
    found = {}
    for path in sorted((sweeps.sweep_folder(folder) / "jobs").glob("*/results.json")):
        content = json.loads(path.read_text())
        for key in ("seconds", "started"):
            del content[key]
        del content["metrics"]["decision_ms"]
        found[path.parent.name] = (path.stat().st_mtime_ns, content)
    return found


def test_the_end_tells_the_table_the_share_and_the_links(finished):
    output = finished.output
    assert "6 of 6 jobs finished" in output
    assert re.search(r"\d+% in the method itself, \d+% in all else", output)
    for part in ("oracle's cost", "QMDP", "QHR", "report/index.html", "&viewStateShareKey="):
        assert part in output
    assert "once this runs: mlflow ui --backend-store-uri sqlite:///outputs/mlflow.db" in output
    assert "\x1b" not in output  # clean where the output is no terminal
    assert "\r" not in output


def test_mlflow_has_one_parent_and_children_with_true_times(finished):
    found = sweeps.runs(finished.folder)
    (parent,) = (name for name, _, parent in found if parent is None)
    assert parent == sweeps.sweep_folder(finished.folder).name
    children = sorted(name for name, _, parent in found if parent is not None)
    assert children == sorted(
        f"{solver} λ={trade_off}" for solver in ("qmdp", "qhr") for trade_off in ("0.5", "1", "2")
    )
    assert {status for _, status, _ in found} == {"FINISHED"}
    with sweeps.database(finished.folder) as database:
        times = {
            name: (start, end)
            for name, start, end in database.execute("select name, start_time, end_time from runs")
        }
        (note,) = database.execute(
            "select value from tags join runs using (run_uuid) where key = 'mlflow.note.content' "
            "and runs.name = ?",
            (parent,),
        ).fetchone()
    assert note.startswith("Least cost: ")
    # Each job's own: from its results; the sweep begins before all and ends with the last.
    sweep = times.pop(parent)
    for path in (sweeps.sweep_folder(finished.folder) / "jobs").glob("*/results.json"):
        content = json.loads(path.read_text())
        end = content["started"] + sum(content["seconds"].values())
        assert times.pop(content["name"]) == (int(1000 * content["started"]), int(1000 * end))
        assert sweep[0] <= 1000 * content["started"] <= 1000 * end < sweep[1] + 1


def test_the_same_command_again_runs_nothing_and_says_the_same(finished):
    folder = finished.folder
    before, tables, runs = results(folder), sweeps.tables(folder), sweeps.runs(folder)
    code, output = sweeps.run(folder, *sweeps.TINY, sweeps.SERIAL)
    assert code == 0, output
    assert "nothing is missing" in output
    assert (results(folder), sweeps.tables(folder), sweeps.runs(folder)) == (before, tables, runs)


def test_only_what_is_missing_or_damaged_runs(finished):
    folder = finished.folder
    before = results(folder)
    lost, damaged = "solver=qmdp,lambda=1", "solver=qhr,lambda=2"
    jobs = sweeps.sweep_folder(folder) / "jobs"
    (jobs / lost / "results.json").unlink()
    (jobs / damaged / "results.json").write_text('{"metrics": ')
    code, output = forked.run(folder, *sweeps.TINY, sweeps.SERIAL, "dry_run=true")
    assert "6 jobs: 4 done, 0 done elsewhere (to be copied), 2 to run" in output
    assert re.search(r"time to expect: about \d+ s, as its finished jobs took", output)
    code, output = sweeps.run(folder, *sweeps.TINY, sweeps.SERIAL)
    assert code == 0, output
    assert "2 jobs to run, 4 finished before" in output
    after = results(folder)
    again = {name for name in after if after[name][0] != before[name][0]}
    assert again == {lost, damaged}
    # The same numbers, whoever computed them.
    assert {n: c for n, (_, c) in after.items()} == {n: c for n, (_, c) in before.items()}


def test_all_anew_on_demand(finished, tmp_path):
    shutil.copytree(finished.folder, tmp_path, dirs_exist_ok=True)
    before, tables, runs = results(tmp_path), sweeps.tables(tmp_path), sweeps.runs(tmp_path)
    code, output = sweeps.run(tmp_path, *sweeps.TINY, sweeps.SERIAL, "resume=none")
    assert code == 0, output
    after = results(tmp_path)
    assert all(after[name][0] != before[name][0] for name in before)
    assert sweeps.tables(tmp_path) == tables
    assert [name for name, *_ in sweeps.runs(tmp_path)] == [name for name, *_ in runs]
    assert len(runs) == 1 + 6


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["resume=maybe"], "resume='maybe': one of missing, failed, none"),
        (["discount=0.95,7"], "discount=7.0: a number in (0, 1]"),
        (["users.count=2,0"], "users.count=0: a whole number ≥ 1"),
        (["observers.label_noise=0,0.7"], "observers.label_noise=0.7: a number in [0, 0.5]"),
    ],
)
def test_bad_values_are_found_before_any_job_starts(tmp_path, arguments, said):
    code, output = sweeps.run(tmp_path, *sweeps.QUICK, *arguments)
    assert code == 2
    assert output.strip().splitlines() == [f"xplain: {said}"]
    assert not (tmp_path / "outputs").exists()


def without_tracking(finished, folder):
    """A copy of the finished sweep's results, and of nothing else."""
    shutil.copytree(
        sweeps.sweep_folder(finished.folder),
        folder / "outputs" / "sweeps" / sweeps.sweep_folder(finished.folder).name,
    )


def test_a_sweep_that_grows_runs_what_is_new_and_shows_all_of_it(finished, tmp_path, empty_store):
    without_tracking(finished, tmp_path)
    before = {name: content for name, (_, content) in results(finished.folder).items()}
    wider = (*sweeps.TINY[:-1], "lambda=0.5,1,2,3", sweeps.SERIAL)
    code, output = sweeps.run(tmp_path, *wider, "dry_run=true")
    assert code == 0, output
    assert "8 jobs: 0 done, 6 done elsewhere (to be copied), 2 to run" in output
    assert len(list((tmp_path / "outputs" / "sweeps").iterdir())) == 1
    assert not (tmp_path / "outputs" / "mlflow.db").exists()

    shutil.copy(empty_store, tmp_path / "outputs" / "mlflow.db")
    code, output = sweeps.run(tmp_path, *wider)
    assert code == 0, output
    assert "2 jobs to run, 6 copied from finished runs and sweeps" in output
    (grown,) = [
        path
        for path in (tmp_path / "outputs" / "sweeps").iterdir()
        if path.name != sweeps.sweep_folder(finished.folder).name
    ]
    for name, content in before.items():
        copied = json.loads((grown / "jobs" / name / "results.json").read_text())
        # The same numbers under the new sweep's name for them.
        assert copied.pop("id") != content.pop("id")
        assert {key: copied[key] for key in ("episodes", "stamp", "config")} == {
            key: content[key] for key in ("episodes", "stamp", "config")
        }
        assert (grown / "jobs" / name / "episodes.jsonl").exists()
    assert len(list((grown / "jobs").glob("*/results.json"))) == 8
    names = [name for name, _, parent in sweeps.runs(tmp_path) if parent is not None]
    assert len(names) == len(set(names)) == 8


def test_a_run_on_its_own_is_taken_into_a_sweep(folder):
    code, output = forked.run(folder, *sweeps.SINGLE)
    assert code == 0, output
    assert "folder: outputs/runs/" in output
    (picture,) = (folder / "outputs" / "runs").rglob("trace.png")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert re.search(r"MLflow: http://127.0.0.1:5000/#/experiments/\d+/runs/[0-9a-f]{32}", output)
    code, output = sweeps.run(folder, *sweeps.QUICK)
    assert code == 0, output
    assert "1 jobs to run, 1 copied" in output
    assert len(sweeps.runs(folder)) == 1 + (1 + 2)


def test_every_launcher_gives_the_same_table(finished, tmp_path):
    folder = finished.folder
    code, output = sweeps.run(tmp_path, *sweeps.TINY, sweeps.SERIAL, "tracking=none")
    assert code == 0, output
    assert sweeps.tables(tmp_path) == sweeps.tables(folder)
    assert not (tmp_path / "outputs" / "mlflow.db").exists()


@pytest.mark.parametrize(
    ("package", "launcher"),
    [
        ("hydra_plugins.hydra_submitit_launcher", ["hydra/launcher=submitit_local"]),
        ("hydra_plugins.hydra_ray_launcher", ["hydra/launcher=ray"]),
    ],
)
def test_launchers_of_the_extras_give_the_same_table(finished, tmp_path, package, launcher):
    pytest.importorskip(package, reason="pip install 'xplain-hri[ray,submitit]'")
    folder = finished.folder
    code, output = sweeps.run(tmp_path, *sweeps.TINY, *launcher, "tracking=none")
    assert code == 0, output
    assert sweeps.tables(tmp_path) == sweeps.tables(folder)


def test_sync_sends_a_sweep_once(finished, folder):
    reference = sweeps.runs(finished.folder)
    sweep, outputs = sweeps.sweep_folder(finished.folder), f"outputs={folder / 'outputs'}"
    for _ in range(2):
        code, output = forked.run(folder, "sync", str(sweep), outputs)
        assert code == 0, output
        assert "6 results in MLflow" in output
    sent = sweeps.runs(folder)
    assert [(n, s, p is None) for n, s, p in sent] == [(n, s, p is None) for n, s, p in reference]


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "sweeps").glob("*.yaml")))
def test_sweep_files_set_known_keys_and_open_with_their_command(name):
    plain = composed()
    hydra_plugins.register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        chosen = compose("config", [f"sweeps={name}"], return_hydra_config=True)
    assert set(chosen) - {"hydra"} == set(plain)
    assert set(chosen.certify) == set(plain.certify)
    first = (CONF / "sweeps" / f"{name}.yaml").read_text().splitlines()[:2]
    assert first == ["# @package _global_", f"# python -m xplain sweeps={name}"]
    assert chosen.hydra.mode.name == "MULTIRUN"


def test_progress_counts_what_was_finished_before_and_what_was_copied(tmp_path, monkeypatch):
    plan, folder = sweeps.planned(tmp_path, 4)
    finished, copied, gone, waiting = (job.fingerprint for job in plan.jobs)
    there, lost = tmp_path / "there", tmp_path / "lost"
    todo = Todo((finished,), {copied: there, gone: lost}, (waiting,))
    monkeypatch.setattr(sweep, "copy_results", lambda source, *_: source == there)
    seen = []

    def watch(folder, jobs, done):
        seen.append((len(jobs), done))
        raise KeyboardInterrupt

    monkeypatch.setattr(sweep, "watched", watch)
    with pytest.raises(KeyboardInterrupt):
        carry_out(todo, plan, folder, Disk(), tmp_path, lambda jobs: None)
    assert seen == [(2, 2)]


def test_a_damaged_sweep_hides_no_other_and_its_command_mends_it(finished, tmp_path):
    shutil.copytree(finished.folder / "outputs", tmp_path / "outputs")
    own = sweeps.sweep_folder(tmp_path)
    damaged = tmp_path / "outputs" / "sweeps" / "other" / "sweep.json"
    damaged.parent.mkdir()
    damaged.write_text('{"jobs": [')
    code, output = forked.run(tmp_path, "report")
    assert code == 0, output
    assert str(own.relative_to(tmp_path)) in output
    code, output = forked.run(tmp_path, "sync")
    assert code == 0, output
    assert "left out: sweep=" in output
    assert "6 results in MLflow" in output
    code, output = forked.run(tmp_path, "report", str(damaged.parent))
    assert (code, len(output.splitlines())) == (2, 1)
    damaged.unlink()
    damaged.parent.rmdir()
    (own / "sweep.json").write_text("not JSON")
    code, output = sweeps.run(tmp_path, *sweeps.TINY, sweeps.SERIAL)
    assert code == 0, output
    assert "nothing is missing" in output
