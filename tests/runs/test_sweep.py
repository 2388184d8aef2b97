"""Sweeps from the command line: jobs that run, jobs that are skipped, and failures."""

import itertools
import json
import re
import shutil
from types import SimpleNamespace
from typing import cast

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from tests.configurations import composed
from tests.runs import sweeps
from xplain.experiment.config import CONF, GROUPS, register
from xplain.report.folder import ListedJob, SweepFolder
from xplain.runs.job import Job, run_in_sweep
from xplain.runs.plan import EACH, MANY, Plan, label_jobs


def addresses(folder):
    """Lists the addresses of all results."""
    return sorted(folder.glob("outputs/results/*/results.json"))


def results(folder):
    """Reads ``{fingerprint: (time of its results, results without times)}``."""
    found = {}
    for path in addresses(folder):
        content = json.loads(path.read_text())
        for key in ("seconds", "started", "worker"):
            del content[key]
        del content["metrics"]["decision_ms"]
        found[path.parent.name] = (path.stat().st_mtime_ns, content)
    return found


def test_the_end_tells_the_table_and_the_links(finished):
    output = finished.output
    assert "4 of 4 jobs finished" in output
    folder = f"folder: outputs/sweeps/{sweeps.sweep_folder(finished.folder).name}\n"
    for part in (
        folder,
        "oracle's cost",
        "QMDP",
        "QHR",
        "report/index.html",
        "&viewStateShareKey=",
    ):
        assert part in output
    assert (
        "start its server first: mlflow ui --backend-store-uri sqlite:///outputs/mlflow.db"
        in output
    )
    assert not {*"\x1b\r"} & {*output}  # clean where the output is no terminal


def test_mlflow_has_one_parent_with_the_answer_and_children(finished):
    found = sweeps.runs(finished.folder)
    (parent,) = (name for name, _, parent in found if parent is None)
    assert parent == sweeps.sweep_folder(finished.folder).name
    children = sorted(name for name, _, parent in found if parent is not None)
    assert children == sorted(
        f"{solver} λ={trade_off}" for solver in ("qmdp", "qhr") for trade_off in ("0.5", "1")
    )
    assert {status for _, status, _ in found} == {"FINISHED"}
    with sweeps.database(finished.folder) as database:
        (note,) = database.execute(
            "select value from tags join runs using (run_uuid) where key = 'mlflow.note.content' "
            "and runs.name = ?",
            (parent,),
        ).fetchone()
    assert note.startswith("Least cost: ")


def test_the_same_command_again_runs_nothing_and_all_anew_on_demand(finished):
    folder = finished.folder
    before, tables, runs = results(folder), sweeps.tables(folder), sweeps.runs(folder)
    assert "no job to run" in sweeps.output_of(folder, *sweeps.TINY, sweeps.SERIAL)
    assert (results(folder), sweeps.tables(folder), sweeps.runs(folder)) == (before, tables, runs)
    sweeps.output_of(folder, *sweeps.TINY, sweeps.SERIAL, "resume=none")
    after = results(folder)
    assert all(after[name][0] != before[name][0] for name in before)
    assert {n: c for n, (_, c) in after.items()} == {n: c for n, (_, c) in before.items()}
    assert (sweeps.tables(folder), sweeps.runs(folder)) == (tables, runs)
    assert len(runs) == 1 + 4


def test_only_what_is_missing_or_damaged_runs(finished):
    folder = finished.folder
    before = results(folder)
    lost, damaged, other = addresses(folder)[:3]
    lost.unlink()
    damaged.write_text('{"metrics": ')
    content = json.loads(other.read_text())
    # It took 3000 s, another one less than a second: so will the other two together.
    other.write_text(json.dumps(content | {"seconds": {"explain": 3000.0}}))
    output = sweeps.output_of(folder, *sweeps.TINY, sweeps.SERIAL, "dry_run=true")
    assert "4 jobs: 2 done, 2 to run" in output
    assert re.search(r"expected time: about 0:50:0\d for one worker, estimated", output)
    other.write_text(json.dumps(content | {"schema": 0}))  # of another version
    output = sweeps.output_of(folder, *sweeps.TINY, sweeps.SERIAL)
    assert "3 jobs to run, 1 finished before" in output
    after = results(folder)
    again = {name for name in after if after[name][0] != before[name][0]}
    assert again == {path.parent.name for path in (lost, damaged, other)}
    # The same numbers, whoever computed them.
    assert {n: c for n, (_, c) in after.items()} == {n: c for n, (_, c) in before.items()}


def test_labels_begin_with_the_setting() -> None:
    swept = [{"solver": solver, "points": points} for solver in "ab" for points in "12"]
    assert [job.label for job in label_jobs([ListedJob("", (), one, "") for one in swept])] == [
        *("points=1 a", "points=2 a", "points=1 b", "points=2 b")
    ]


def test_many_jobs_are_batches_each_of_one_data_set(tmp_path):
    """Each job is in one batch; batches that make data sets come first."""

    def planned(data_sets, trade_offs, launcher):
        jobs = {
            f"{seed} {number}": cast("Job", SimpleNamespace(source=str(seed)))
            for seed in range(data_sets)
            for number in range(trade_offs)
        }
        config = OmegaConf.create({"hydra": {"launcher": launcher}})
        plan = Plan(SweepFolder(tmp_path), (), jobs, {}, config, {})
        return [*jobs.values()], plan.batches()

    cases = itertools.product(((2, 3), (7, 50), (MANY, 30)), ({}, {"n_jobs": 2}))
    for (data_sets, trade_offs), launcher in cases:
        jobs, batches = planned(data_sets, trade_offs, launcher)
        enough = EACH * 2 if launcher else MANY
        assert sorted(map(id, jobs)) == sorted(id(job) for batch in batches for job in batch)
        assert all(len({job.source for job in batch}) == 1 for batch in batches)
        assert len({batch[0].source for batch in batches[:data_sets]}) == data_sets
        assert min(enough, len(jobs)) / 2 <= len(batches) <= enough + data_sets
        assert len(jobs) >= enough or len(batches) == len(jobs)


@pytest.mark.parametrize(
    ("swept", "said"),
    [
        ("discount=0.95,7", "discount=7.0: a number in (0, 1]"),
        ("users.count=2,0", "users.count=0: a whole number ≥ 1"),
        ("lambda=interval(0,1)", "a list, choice(...) or range(...)"),
        ("solver=glob(q*)", "a list, choice(...) or range(...)"),
    ],
)
def test_bad_values_are_found_before_any_job_starts(tmp_path, swept, said):
    output = sweeps.output_of(tmp_path, *sweeps.QUICK, swept, code=2)
    assert re.fullmatch(rf"xplain: .*{re.escape(said)}.*\n", output)
    assert not (tmp_path / "outputs").exists()


def test_a_run_and_a_sweep_share_a_result(folder):
    """This holds in both orders; an existing result is not computed again."""
    output = sweeps.output_of(folder, *sweeps.SINGLE)
    assert "folder: outputs/runs/" in output
    assert re.search(r"MLflow: http://127.0.0.1:5000/#/experiments/\d+/runs/[0-9a-f]{32}", output)
    first = results(folder)
    assert "1 jobs to run, 1 finished before" in sweeps.output_of(folder, *sweeps.QUICK)
    assert len(sweeps.runs(folder)) == 1 + (1 + 2)
    assert "the result exists already" in sweeps.output_of(folder, *sweeps.SINGLE)
    assert first.items() <= results(folder).items()
    assert len(results(folder)) == 2
    kept = [json.loads(p.read_text()) for p in folder.glob("outputs/runs/*/results.json")]
    assert len(kept) == 2  # a run has a folder of its own, with all of its files
    assert kept[0] == kept[1]
    assert len(sweeps.runs(folder)) == 1 + (1 + 2)


def test_hydras_own_sweeper_gives_the_same_results(finished, tmp_path):
    words = (*sweeps.TINY, sweeps.SERIAL, "hydra/sweeper=basic", "tracking=none")
    assert "4 of 4 jobs finished" in sweeps.output_of(tmp_path, *words)
    assert not (tmp_path / "outputs" / "mlflow.db").exists()
    own, reference = results(tmp_path), results(finished.folder)
    assert {n: c for n, (_, c) in own.items()} == {n: c for n, (_, c) in reference.items()}
    assert sweeps.tables(tmp_path) == sweeps.tables(finished.folder)


def test_forced_keys_are_the_same_keys(tmp_path):
    """An example is ``++seed``, which Hydra advises if a key may exist."""
    said = []
    for force in ("", "++"):
        words = (*sweeps.QUICK[:-2], sweeps.SERIAL, f"{force}seed=0,1", f"{force}lambda=1,2")
        said.append(sweeps.output_of(tmp_path, *words, "dry_run=true"))
    assert said[0] == said[1]
    assert "8 jobs: 0 done, 8 to run" in said[0]
    assert "expected time: unknown until the first job is finished" in said[0]
    assert "qmdp λ=1 seed=0" in said[0]
    assert not (tmp_path / "outputs" / "sweeps").exists()


def test_the_command_line_replaces_and_chooses_what_a_prepared_sweep_has(tmp_path):
    """``sweeps=table1_paper`` tells settings apart by domain and number of types."""

    def jobs(*words):
        output = sweeps.output_of(tmp_path, *words, sweeps.SERIAL, "dry_run=true", "solver=qmdp")
        return [line.split()[2:] for line in output.splitlines() if line.startswith("to run")]

    table1 = ("sweeps=table1_paper", "lambda=3,4")
    assert len(jobs(*table1)) == 4 * 2
    assert len(jobs(*table1, "domain=rescue")) == 2
    assert len(jobs(*table1, "users.count=2,3")) == 2 * 2
    (line,) = sweeps.output_of(tmp_path, *table1, "domain=taxi", code=2).splitlines()
    assert "domain='taxi': values of one of the sweep's settings: domain=rescue" in line


def test_a_key_that_some_solvers_have_varies_where_it_is(tmp_path):
    words = (*sweeps.QUICK[:-3], "lambda=1", "solver.simulations=10,20", sweeps.SERIAL)
    output = sweeps.output_of(tmp_path, *words, "solver=pomcp,qmdp", "dry_run=true")
    assert "solver.simulations: no key of qmdp" in output
    assert re.findall("^to run +(.*)", output, re.MULTILINE) == [
        *("simulations=10 pomcp", "qmdp", "simulations=20 pomcp")
    ]
    output = sweeps.output_of(tmp_path, *words, "solver=qmdp,qhr", "dry_run=true", code=2)
    assert "solver.simulations: no such key" in output  # a mistake


def test_a_job_that_is_another_than_its_sweep_lists_fails_and_is_not_run(tmp_path):
    """This happens if a file of choices is edited between planning and running."""
    cfg = composed("tracking=none", f"outputs={tmp_path}")
    job = Job.of(cfg, dict.fromkeys(GROUPS, "chosen"))
    assert run_in_sweep(job, tmp_path / "own", "of another") is None
    failure = json.loads((tmp_path / "own" / "failure.json").read_text())
    assert "has other code, libraries, data or files of choices" in failure["error"]
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("name", sorted(path.stem for path in (CONF / "sweeps").glob("*.yaml")))
def test_sweep_files_set_known_keys_and_open_with_their_command(name):
    plain = composed()
    register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        chosen = compose("config", [f"sweeps={name}"], return_hydra_config=True)
    assert set(chosen) - {"hydra"} == set(plain)
    assert set(chosen.certify) == set(plain.certify)
    first = (CONF / "sweeps" / f"{name}.yaml").read_text().splitlines()[:2]
    assert first == ["# @package _global_", f"# python -m xplain sweeps={name}"]
    assert chosen.hydra.mode.name == "MULTIRUN"


def test_a_damaged_sweep_hides_no_other_and_its_command_mends_it(finished, tmp_path):
    """The project was moved."""
    shutil.copytree(finished.folder / "outputs", tmp_path / "outputs")
    own = sweeps.sweep_folder(tmp_path)
    damaged = tmp_path / "outputs" / "sweeps" / "other" / "sweep.json"
    damaged.parent.mkdir()
    damaged.write_text('{"jobs": [')
    for given in ((), (str(own),)):
        assert own.name in sweeps.output_of(tmp_path, "report", *given)
    output = sweeps.output_of(tmp_path, "sync")
    assert "left out: sweep=" in output
    assert "4 results in MLflow" in output
    output = sweeps.output_of(tmp_path, "report", str(damaged.parent), code=2)
    assert len(output.splitlines()) == 1
    shutil.rmtree(damaged.parent)
    (own / "sweep.json").write_text("not JSON")
    assert "no job to run" in sweeps.output_of(tmp_path, *sweeps.TINY, sweeps.SERIAL)
