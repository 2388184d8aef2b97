"""The real server: dry runs over HTTP, kill -9, one process for each database."""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path

import pandas as pd
import pytest
from sklearn.metrics import adjusted_rand_score

from tests.conftest import Command
from tests.people.collect.stand_in import street_collection
from tests.people.killing import RATE, survive
from tests.people.kinds import KINDS, bot_of, flow_of
from tests.people.server_process import ServerProcess
from xplain.cli.main import main
from xplain.explanation.message_sets import names_of
from xplain.learning.saved import LearnedTypes
from xplain.people.bots import Researcher
from xplain.people.store import Store
from xplain.people.study.flow import Study


@pytest.fixture
def database(tmp_path: Path, study: Study) -> Path:
    """With a plan in it."""
    path = tmp_path / "study.sqlite"
    Store(path, study).close()
    return path


def test_bots_take_part_and_the_data_goes_all_the_way(
    database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ServerProcess(database, *RATE) as server:
        archive = tmp_path / "study.zip"
        arguments = ["--url", server.url, "--key", server.key, "--count", "24", "--at-once", "6"]
        main(["study", "bots", *arguments, "--leaving", "0.01", "--save", str(archive)])
        backup = tmp_path / "backup.sqlite"  # made while the server runs
        main(["study", "backup", str(database), str(backup)])
        with pytest.raises(SystemExit) as ended:
            main(["study", "bots", "--url", server.url, "--key", "wrong"])
        assert ended.value.code == 2
        assert "researcher's key" in capsys.readouterr().err
    with zipfile.ZipFile(archive) as out:
        out.extractall(tmp_path)
    capsys.readouterr()
    for path in (backup, database):
        main(["study", "replay", str(path)])
        assert "all equal" in capsys.readouterr().out
    main(["study", "analyse", str(tmp_path / "study"), "--stream", "bot"])
    people = pd.read_csv(tmp_path / "study" / "participants.csv")
    assert set(people["stream"]) == {"bot"}
    assert (people["stage"] == "done").sum() >= 12


def everything_replays(kind: str, database: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    main([kind, "replay", str(database)])
    assert "all equal" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("kills", "people", "least"), [(1, 3, 10), pytest.param(20, 8, 200, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("kind", KINDS)
def test_kill_9_loses_nothing_that_was_acknowledged(
    kind: str,
    kills: int,
    people: int,
    least: int,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    flow, path = flow_of(kind), tmp_path / "s.sqlite"
    Store(path, flow).close()
    acknowledged, stored = survive(path, flow, kind, partial(bot_of, flow), kills, people)
    with capsys.disabled():
        print(f"\n{kills} kills: {acknowledged} answers acknowledged, {stored} stored")
    assert least < acknowledged <= stored
    everything_replays(kind, path, capsys)


def test_from_bots_to_types(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first half of the method over HTTP: 24 people who err and lose attention, then the
    types."""
    monkeypatch.chdir(tmp_path)
    collection, database = street_collection(points=20), tmp_path / "collect.sqlite"
    Store(database, collection).close()
    with ServerProcess(database, *RATE, command="collect") as server:
        archive = tmp_path / "collect.zip"
        arguments = ["--url", server.url, "--key", server.key, "--count", "24", "--at-once", "6"]
        habits = ["--error", "0.05", "--lapse", "0.02"]
        main(["collect", "bots", *arguments, *habits, "--save", str(archive)])
        assert "24 done" in capsys.readouterr().out
        backup = tmp_path / "backup.sqlite"
        main(["collect", "backup", str(database), str(backup)])
    with zipfile.ZipFile(archive) as out:
        out.extractall(tmp_path)
    data = tmp_path / "study"
    for path in (backup, database):
        everything_replays("collect", path, capsys)
    main(["collect", "export", str(database), "again"])
    assert (tmp_path / "again/labels_bot.csv").read_text() == (data / "labels_bot.csv").read_text()
    assert not (data / "labels.csv").exists()  # nobody but bots was there
    labels = [f"data={data}/labels_bot.csv", f"hypotheses={data}/hypotheses.npz"]
    main(["discover", *labels, "labeler=hypotheses", "output=found", "held_out=false"])
    found = pd.read_csv(tmp_path / "found" / "assignment.csv").set_index("observer")["type"]
    observers = pd.read_csv(data / "observers.csv").set_index("observer").loc[found.index]
    # What they state is what they are: simulated people know what they believe incorrectly.
    stated = observers.filter(like="stated_").agg("".join, axis=1)
    assert adjusted_rand_score(stated, found) >= 0.95
    types = LearnedTypes.load(tmp_path / "found" / "types.npz")
    assert len(types.labelers) == len(collection.plan.roles)
    messages = collection.plan.hypotheses.messages
    wrong = {names_of(role.held, messages) for role in collection.plan.roles}
    likeliest = {tuple(sorted(one.split(";"))) for one in observers["likeliest"]}
    assert wrong <= likeliest


def test_one_process_a_database(database: Path, command: Command) -> None:
    with ServerProcess(database):
        second = command("xplain study", f"database={database}", "port=1")
    assert second.returncode == 2
    assert "another process is using it" in second.stderr
    assert "Traceback" not in second.stderr


@pytest.mark.parametrize(
    ("kind", "changes", "named"),
    [("study", "rules.per_cell=99 lambda=2", "lambda"), ("collect", "points=30", "points")],
)
def test_a_running_server_keeps_its_plan(
    kind: str, changes: str, named: str, tmp_path: Path
) -> None:
    flow, path = flow_of(kind), tmp_path / "s.sqlite"
    Store(path, flow).close()
    with ServerProcess(path, *changes.split(), command=kind) as server:
        assert "are ignored" in server.log()
        assert named in server.log()
        plan = Researcher(server.url, server.key).plan(flow.PLAN)
    assert plan.hash == flow.plan.hash
