"""Collecting labels from the real server, and the way on: discover, types, an explainer."""

from __future__ import annotations

import threading
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.collect.stand_in import FAULTLESS, street_collection
from tests.participants.server_process import ServerProcess
from xplain.cli.main import main
from xplain.collect.protocol.plan import Collection
from xplain.collect.server.protocol import CollectProtocol
from xplain.collect.simulation.observer import Observer, observer
from xplain.learning.saved_types import LearnedTypes
from xplain.message_sets import names_of
from xplain.participants.server.store import Store
from xplain.participants.simulation.bots import Researcher
from xplain.participants.simulation.http_client import Browser, Page

RATE = ("server.requests_per_second=1e6", "server.burst=1e6", "server.visitor_burst=1e6")


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


class Careful:
    """An observer who writes down every answer that the server acknowledged."""

    def __init__(self, url: str, person: Observer, invitation: str) -> None:
        self.browser = Browser(url, patience=90)
        self.person, self.invitation = person, invitation
        self.acknowledged: list[int] = []

    def take_part(self) -> str:
        """To the end, however often the server dies."""
        _, html = self.browser.get(f"/?invitation={self.invitation}")
        fields = [*Page(html).hidden.items(), ("invitation", self.invitation)]
        page = Page(self.browser.post("/enter", fields)[1])
        while page.hidden:
            time.sleep(0.1)
            answer = [*page.hidden.items(), *self.person.fill(page)[0]]
            status, html = self.browser.post("/study", answer)
            assert status == 200, html
            self.acknowledged.append(int(page.hidden["sequence"]))
            page = Page(html)
        self.browser.close()
        return page.stage


def survive(database: Path, collection: Collection, kills: int, people: int) -> tuple[int, int]:
    """Kills the server while people answer; how many answers were acknowledged and stored."""
    server = ServerProcess(database, *RATE, command="collect")
    server.start()
    ended = threading.Event()

    def parade(number: int) -> list[Careful]:
        """One observer after another, until the last kill."""
        own: list[Careful] = []
        while not ended.is_set():
            person = observer(collection.plan, FAULTLESS, len(own), number)
            visitor = Careful(server.url, person, invitations[number].pop())
            assert visitor.take_part() == "done"
            own.append(visitor)
        return own

    researcher = Researcher(server.url, server.key)
    invitations = [researcher.invite(60) for _ in range(people)]
    with ThreadPoolExecutor(people) as pool:
        futures = [pool.submit(parade, number) for number in range(people)]
        pause = np.random.default_rng(0)
        for _ in range(kills):
            time.sleep(0.5 + pause.random())
            server.kill()
            server.start()
        ended.set()
        visitors = [visitor for future in futures for visitor in future.result()]
    server.stop()
    store, stored = Store(database, CollectProtocol(collection)), 0
    for visitor in visitors:
        who = store.enter_invited(visitor.invitation)
        rows = store.query(
            "SELECT source_sequence AS n FROM event WHERE participant = ? AND "
            "source = 'protocol' ORDER BY sequence",
            (who,),
        )
        assert [row["n"] for row in rows] == list(range(len(rows)))  # none lost, none doubled
        assert visitor.acknowledged == sorted(set(visitor.acknowledged))
        assert set(visitor.acknowledged) <= {row["n"] for row in rows}
        assert store.participant(who).state.stage == "done"
        stored += len(rows)
    assert store.query("PRAGMA integrity_check") == [{"integrity_check": "ok"}]
    store.close()
    return sum(len(visitor.acknowledged) for visitor in visitors), stored


@pytest.mark.slow
def test_kill_9_twenty_times_under_eight_participants(
    database: Path, collection: Collection, capsys: pytest.CaptureFixture[str]
) -> None:
    acknowledged, stored = survive(database, collection, kills=20, people=8)
    with capsys.disabled():
        print(f"\n20 kills: {acknowledged} answers acknowledged, {stored} stored")
    assert 200 < acknowledged <= stored
    replays(database, capsys)


def test_a_kill_loses_nothing_that_was_acknowledged(
    database: Path, collection: Collection, capsys: pytest.CaptureFixture[str]
) -> None:
    acknowledged, stored = survive(database, collection, kills=1, people=3)
    assert 20 < acknowledged <= stored
    replays(database, capsys)


def test_a_running_collection_keeps_its_plan(database: Path, collection: Collection) -> None:
    from xplain.collect.protocol.plan import CollectPlan

    with ServerProcess(database, "points=30", "queries=battery", command="collect") as server:
        assert "are ignored" in server.log()
        assert "points" in server.log()
        assert Researcher(server.url, server.key).plan(CollectPlan).hash == collection.plan.hash
