"""Collecting labels from the real server, and the way on: discover, types, an explainer."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pandas as pd
import pytest

from tests.collect.stand_in import FAULTLESS, street_collection
from tests.participants.killing import RATE, survive
from tests.participants.server_process import ServerProcess
from xplain.cli.main import main
from xplain.collect.protocol.plan import Collection
from xplain.collect.server.protocol import CollectProtocol
from xplain.collect.simulation.observer import Observer, observer
from xplain.learning.saved_types import LearnedTypes
from xplain.message_sets import names_of
from xplain.participants.server.store import Store
from xplain.participants.simulation.bots import Researcher


@pytest.fixture(scope="module")
def collection() -> Collection:
    return street_collection(points=20)


@pytest.fixture
def database(tmp_path: Path, collection: Collection) -> Path:
    """With a plan in it."""
    path = tmp_path / "collect.sqlite"
    Store(path, CollectProtocol(collection)).close()
    return path


def replays(database: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    main(["collect", "replay", str(database)])
    assert "all equal" in capsys.readouterr().out


def test_from_bots_to_types(
    database: Path,
    collection: Collection,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The whole first half of the method, over HTTP: 24 who err and lapse, then the types."""
    monkeypatch.chdir(tmp_path)
    with ServerProcess(database, *RATE, command="collect") as server:
        assert "adjusted Rand index" in server.log()
        archive = tmp_path / "collect.zip"
        arguments = ["--url", server.url, "--key", server.key, "--count", "24", "--at-once", "6"]
        habits = ["--error", "0.05", "--lapse", "0.02"]
        main(["collect", "bots", *arguments, *habits, "--save", str(archive)])
        assert "24 done" in capsys.readouterr().out
    with zipfile.ZipFile(archive) as out:
        out.extractall(tmp_path)
    data = tmp_path / "study"
    for path in (data / "snapshot.sqlite", database):
        replays(path, capsys)
    main(["collect", "export", str(database), "again"])
    assert (tmp_path / "again/labels_bot.csv").read_text() == (data / "labels_bot.csv").read_text()
    assert not (data / "labels.csv").exists()  # nobody but bots was there
    labels = [f"data={data}/labels_bot.csv", f"hypotheses={data}/hypotheses.npz"]
    main(["discover", *labels, "labeler=hypotheses", "output=found", "held_out=false"])
    found = pd.read_csv(tmp_path / "found" / "assignment.csv").set_index("observer")["type"]
    observers = pd.read_csv(data / "observers.csv").set_index("observer").loc[found.index]
    # What they state is what they are: simulated people know what they hold wrong.
    stated = observers.filter(like="stated_").agg("".join, axis=1)
    from sklearn.metrics import adjusted_rand_score

    assert adjusted_rand_score(stated, found) >= 0.95
    types = LearnedTypes.load(tmp_path / "found" / "types.npz")
    assert len(types.labelers) == len(collection.plan.roles)
    messages = collection.plan.hypotheses.messages
    wrong = {names_of(role.held, messages) for role in collection.plan.roles}
    likeliest = {tuple(sorted(one.split(";"))) for one in observers["likeliest"]}
    assert wrong <= likeliest


def survivors(database: Path, collection: Collection, kills: int, people: int) -> tuple[int, int]:
    """Answers acknowledged and stored."""

    def person(number: int, place: int) -> Observer:
        return observer(collection.plan, FAULTLESS, number, place)

    return survive(database, CollectProtocol(collection), "collect", person, kills, people)


@pytest.mark.slow
def test_kill_9_twenty_times_under_eight_participants(
    database: Path, collection: Collection, capsys: pytest.CaptureFixture[str]
) -> None:
    acknowledged, stored = survivors(database, collection, kills=20, people=8)
    with capsys.disabled():
        print(f"\n20 kills: {acknowledged} answers acknowledged, {stored} stored")
    assert 200 < acknowledged <= stored
    replays(database, capsys)


def test_a_kill_loses_nothing_that_was_acknowledged(
    database: Path, collection: Collection, capsys: pytest.CaptureFixture[str]
) -> None:
    acknowledged, stored = survivors(database, collection, kills=1, people=3)
    assert 20 < acknowledged <= stored
    replays(database, capsys)


def test_a_running_collection_keeps_its_plan(database: Path, collection: Collection) -> None:
    from xplain.collect.protocol.plan import CollectPlan

    with ServerProcess(database, "points=30", "queries=battery", command="collect") as server:
        assert "are ignored" in server.log()
        assert "points" in server.log()
        assert Researcher(server.url, server.key).plan(CollectPlan).hash == collection.plan.hash
