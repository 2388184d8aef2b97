"""The real server: dry runs over HTTP, kill -9, one process for each database; and the whole method
with simulated people, from labels to a study whose policies know only the types found in them."""

import re
import subprocess
import threading
import time
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import adjusted_rand_score

from tests import forked
from tests.conftest import Run
from tests.people.server_process import running, serving
from tests.people.street import ASK, bot_of, flow_of, street_collection, street_study
from tests.people.visitors import GENEROUS, Opened, query, take_part
from xplain.cli.main import main
from xplain.errors import InputError
from xplain.experiment.config import compose_config
from xplain.explanation.message_sets import names_of
from xplain.learning.saved import LearnedTypes
from xplain.people.bots import Browser, Researcher, visit
from xplain.people.collect import tables as collect
from xplain.people.collect.bot import Habits, bot
from xplain.people.collect.flow import Collection
from xplain.people.collect.prepare import collect_plan
from xplain.people.flow import Fields
from xplain.people.store import Store
from xplain.people.study.flow import Study
from xplain.people.study.plan import StudyPlan
from xplain.people.study.prepare import study_plan
from xplain.people.study.tables import export
from xplain.people.web import create_app


def test_bots_take_part_and_the_data_goes_all_the_way(
    study: Study, tmp_path: Path, run: Run, no_pictures: None
) -> None:
    """Also, the server keeps the plan of its database."""
    database, archive, backup = (tmp_path / f for f in ("study.sqlite", "study.zip", "b.sqlite"))
    with serving(database, study, "rules.per_cell=99", "lambda=2") as server:
        assert re.search(r"are ignored: (?!.*\bseed\b).*lambda", server.log())
        assert Researcher(server.url, server.key).plan(study.PLAN).hash == study.plan.hash
        bots = ("study bots", "--url", server.url, "--key")
        run(*bots, server.key, "--count", 12, "--at-once", 6, "--leaving", 0.01, "--save", archive)
        # The server runs.
        assert f"{backup}, its key in {backup}.key" in run("study backup", database, backup)[1]
        code, _, error = run(*bots, "wrong")
        assert code == 2
        assert "researcher's key" in error
    with zipfile.ZipFile(archive) as out:
        out.extractall(tmp_path)
    for path in (backup, database):
        assert "all equal" in run("study replay", path)[1]
    assert run("study analyse", "study", "--stream", "bot")[0] == 0
    people = pd.read_csv(tmp_path / "study" / "participants.csv")
    assert set(people["stream"]) == {"bot"}
    assert (people["stage"] == "done").sum() >= 6


def test_bots_trust_the_labs_own_authority(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They use https with a certificate that SSL_CERT_FILE names, and no proxy."""
    files = {"ssl_keyfile": f"{tmp_path}/key.pem", "ssl_certfile": f"{tmp_path}/lab.pem"}
    made = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=lab", "-addext"]
    made += ["subjectAltName=IP:127.0.0.1", "-keyout", files["ssl_keyfile"]]
    subprocess.run(["openssl", *made, "-out", files["ssl_certfile"]], check=True)
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:1")
    key = store.researcher_key
    with running(create_app(store, GENEROUS), **files) as url:
        with pytest.raises(InputError, match="certificate verify failed"):
            Researcher(url, key)
        monkeypatch.setenv("SSL_CERT_FILE", files["ssl_certfile"])
        (invitation,) = Researcher(url, key).invite(1)
        assert visit(Browser(url), bot_of(store.flow, 0), invitation) == "done"


def test_bots_find_the_path_of_the_address(store: Store) -> None:
    """Cookies are below this path, also where no proxy removes it."""
    server = replace(GENEROUS, address="https://lab.example.org/robots")
    with running(create_app(store, server)) as url:
        researcher = Researcher(url, store.researcher_key)
        (invitation,) = researcher.invite(1)
        assert visit(Browser(researcher.browser.url), bot_of(store.flow, 0), invitation) == "done"


@dataclass
class Careful(Browser):
    """The browser of a participant, which records every answer that the server acknowledged."""

    patience: float = 90.0
    acknowledged: list[int] = field(default_factory=list)

    def post(self, path: str, fields: Fields | None) -> tuple[int, str]:
        status, html = super().post(path, fields)
        if path == "/study":
            self.acknowledged.append(int(dict(fields or ())["sequence"]))
        return status, html


@pytest.mark.parametrize(
    ("kind", "kills", "people", "least"),
    [
        ("study", 1, 8, 20),  # who come into every condition
        ("collect", 1, 3, 10),
        pytest.param("study", 20, 8, 200, marks=pytest.mark.slow),
        pytest.param("collect", 20, 8, 200, marks=pytest.mark.slow),
    ],
)
def test_kill_9_loses_nothing_that_was_acknowledged(
    kind: str, kills: int, people: int, least: int, tmp_path: Path, run: Run
) -> None:
    """No acknowledged answer is lost or stored twice. This holds in all three conditions of the
    study; the server also dies while people are asked questions."""
    flow: Any = street_study(ask=ASK) if kind == "study" else flow_of(kind)
    errs, path = {"label_noise": 0.2} if kind == "study" else {}, tmp_path / "s.sqlite"
    server, ended = serving(path, flow, "server.blinded=false"), threading.Event()

    def parade(place: int, invitations: Sequence[str]) -> dict[str, Careful]:
        """Sends one person after another, until the last kill."""
        own = dict[str, Careful]()
        while not ended.is_set():
            browser, invitation = Careful(server.url), invitations[len(own)]
            person = bot_of(flow, len(own), place, **errs)
            assert visit(browser, person, invitation, lambda _: time.sleep(0.1)) == "done"
            own[invitation] = browser
        return own

    with server, ThreadPoolExecutor(people) as pool:
        researcher, pause = Researcher(server.url, server.key), np.random.default_rng(0)
        invited = [researcher.invite(100) for _ in range(people)]
        walks = pool.map(parade, range(people), invited)
        for _ in range(kills):
            time.sleep(0.4 + pause.random())
            server.kill()
            server.start()
        ended.set()
        visitors = {token: one for own in walks for token, one in own.items()}
    stored = 0
    with closing(Store(path, flow)) as store:
        sql = "SELECT source_sequence AS n FROM event WHERE participant = ? AND "
        for invitation, visitor in visitors.items():
            who = store.enter_invited(invitation)
            rows = query(store, f"{sql} source = 'protocol' ORDER BY sequence", (who,))
            numbers = [row["n"] for row in rows]
            assert numbers == list(range(len(rows)))  # none lost, none doubled
            # Everybody saw every page once, in order: they went on where they were.
            assert visitor.acknowledged == sorted(set(visitor.acknowledged))
            assert set(visitor.acknowledged) <= set(numbers)
            assert store.participant(who).state.stage == "done"
            stored += len(rows)
        assert query(store, "PRAGMA integrity_check") == [{"integrity_check": "ok"}]
    assert least < sum(len(visitor.acknowledged) for visitor in visitors.values()) <= stored
    assert "all equal" in run(f"{kind} replay", path)[1]
    if kind == "study":
        export(path, tmp_path / "out")
        told = pd.read_csv(tmp_path / "out" / "participants.csv")
        asked = told.groupby("condition")["questions_asked"].sum()
        assert asked["asking"] > 0 == asked["personalized"] == asked["conformant"]


def test_from_bots_to_types(opened: Opened, tmp_path: Path, run: Run) -> None:
    """The first half of the method over HTTP: 18 people who err and lose attention, then the
    types."""
    collection = street_collection(points=20)
    store = opened(collection)
    with running(create_app(store, GENEROUS)) as url:
        bots = ("--url", url, "--key", store.researcher_key, "--count", 18, "--at-once", 6)
        habits = ("--error", 0.05, "--lapse", 0.02)
        assert "18 done" in run("collect bots", *bots, *habits, "--save", "collect.zip")[1]
    store.close()
    with zipfile.ZipFile(tmp_path / "collect.zip") as out:
        out.extractall(tmp_path)
    data = tmp_path / "study"
    assert "all equal" in run("collect replay", store.path)[1]
    run("collect export", store.path, "again")
    assert (tmp_path / "again/labels_bot.csv").read_text() == (data / "labels_bot.csv").read_text()
    assert not (data / "labels.csv").exists()  # nobody but bots was there
    labels = [f"data={data}/labels_bot.csv", f"hypotheses={data}/hypotheses.npz"]
    run("discover", *labels, "labeler=hypotheses", "output=found", "held_out=false")
    # The tests of `discover` draw no pictures.
    assert (tmp_path / "found" / "messages.png").stat().st_size > 1000
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


@pytest.fixture(scope="module")
def types(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Finds the types in the answers of 10 people × 20 adaptive questions at 5 % wrong answers;
    returns their file."""
    folder = tmp_path_factory.mktemp("found")
    plan = collect_plan(compose_config("collect", ["points=20", "seed=0"]))
    with closing(Store(folder / "c.sqlite", Collection(plan))) as store:
        people = (bot(plan, Habits(error=0.05), 1, number) for number in range(10))
        assert {*take_part(store, people, "bot")} == {"done"}
    collect.export(folder / "c.sqlite", folder)
    given = (f"data={folder}/labels_bot.csv", f"hypotheses={folder}/hypotheses.npz")
    with pytest.MonkeyPatch.context() as patch:
        forked.leave_out_pictures(patch.setattr)
        main(["discover", *given, "held_out=false", "labeler=hypotheses", f"output={folder}"])
    return folder / "types.npz"


def planned(types: Path, *arguments: str) -> StudyPlan:
    return study_plan(compose_config("study", [f"types={types}", "seed=0", *arguments]))


def test_people_as_they_are_get_fewer_messages_by_the_types_that_were_found(
    types: Path, tmp_path: Path, run: Run, no_pictures: None
) -> None:
    plan = planned(types, "briefing=none")
    assert plan.problem.type_names[:-1] == LearnedTypes.load(types).names
    assert [role.briefing for role in plan.roles] == [()]
    path = tmp_path / "study.sqlite"
    with closing(Store(path, Study.of(plan))) as store:
        visitors = (bot_of(store.flow, number) for number in range(10))
        assert {*take_part(store, visitors, "bot")} == {"done"}
    run("study export", path, "out", "--identifiers", "identifiers.csv")
    assert len(pd.read_csv(tmp_path / "identifiers.csv")) == 10
    assert "Messages" in run("study analyse", "out", "--stream", "bot")[1]
    people = pd.read_csv(tmp_path / "out" / "participants.csv")
    means = people.groupby("condition")[["messages_given", "inexplicable_transitions"]].mean()
    assert people.groupby("condition").size().tolist() == [5, 5]
    assert means["messages_given"]["personalized"] < means["messages_given"]["conformant"] - 1
    wrong = means["inexplicable_transitions"]
    assert wrong["personalized"] <= wrong["conformant"]
