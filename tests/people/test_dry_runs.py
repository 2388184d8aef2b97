"""The real server: dry runs over HTTP, kill -9, one process for each database."""

import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.metrics import adjusted_rand_score

from tests import forked
from tests.conftest import Run
from tests.people.collect.stand_in import street_collection
from tests.people.killing import RATE, survive
from tests.people.kinds import bot_of, flow_of
from tests.people.server_process import ServerProcess
from tests.people.study.stand_in import ASK, FAULTLESS, street_study
from xplain.explanation.message_sets import names_of
from xplain.learning.saved import LearnedTypes
from xplain.people.bots import Researcher, Visitor
from xplain.people.store import Store
from xplain.people.study.bot import StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.tables import export


def test_bots_take_part_and_the_data_goes_all_the_way(
    study: Study, tmp_path: Path, run: Run
) -> None:
    """Also, the server keeps the plan of its database, and no second server takes the database."""
    database, archive, backup = (tmp_path / f for f in ("study.sqlite", "study.zip", "b.sqlite"))
    Store(database, study).close()
    with ServerProcess(database, *RATE, "rules.per_cell=99", "lambda=2") as server:
        second = forked.start(tmp_path, "study", f"database={database}", "port=1")
        assert re.search("are ignored: .*lambda", server.log())
        assert Researcher(server.url, server.key).plan(study.PLAN).hash == study.plan.hash
        bots = ("study bots", "--url", server.url, "--key")
        run(*bots, server.key, "--count", 12, "--at-once", 6, "--leaving", 0.01, "--save", archive)
        run("study backup", database, backup)  # made while the server runs
        code, _, error = run(*bots, "wrong")
        assert code == 2
        assert "researcher's key" in error
        code, said = forked.wait(tmp_path, second)
        assert code == 2
        assert "another process is using it" in said
        assert "Traceback" not in said
    with zipfile.ZipFile(archive) as out:
        out.extractall(tmp_path)
    for path in (backup, database):
        assert "all equal" in run("study replay", path)[1]
    assert run("study analyse", "study", "--stream", "bot")[0] == 0
    people = pd.read_csv(tmp_path / "study" / "participants.csv")
    assert set(people["stream"]) == {"bot"}
    assert (people["stage"] == "done").sum() >= 6


def err(flow: Study, *seeds: int) -> StudyBot:
    """Makes a participant who labels one step in five wrongly."""
    habits = replace(FAULTLESS, label_noise=0.2)
    return StudyBot(flow.plan, habits, np.random.default_rng(seeds))


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
    kind: str,
    kills: int,
    people: int,
    least: int,
    tmp_path: Path,
    run: Run,
) -> None:
    """This holds in all three conditions of the study; the server also dies while people are asked
    questions."""
    flow: Any = street_study(ask=ASK) if kind == "study" else flow_of(kind)
    person: Callable[..., Visitor] = partial(err if kind == "study" else bot_of, flow)
    path = tmp_path / "s.sqlite"
    Store(path, flow).close()
    acknowledged, stored = survive(path, flow, kind, person, kills, people)
    assert least < acknowledged <= stored
    assert "all equal" in run(f"{kind} replay", path)[1]
    if kind == "study":
        export(path, tmp_path / "out")
        told = pd.read_csv(tmp_path / "out" / "participants.csv")
        asked = told.groupby("condition")["questions_asked"].sum()
        assert asked["asking"] > 0 == asked["personalized"] == asked["conformant"]


def test_from_bots_to_types(tmp_path: Path, run: Run) -> None:
    """The first half of the method over HTTP: 18 people who err and lose attention, then the
    types."""
    collection, database = street_collection(points=20), tmp_path / "collect.sqlite"
    Store(database, collection).close()
    with ServerProcess(database, *RATE, "points=30", command="collect") as server:
        assert re.search("are ignored: .*points", server.log())
        bots = ("--url", server.url, "--key", server.key, "--count", 18, "--at-once", 6)
        habits = ("--error", 0.05, "--lapse", 0.02)
        assert "18 done" in run("collect bots", *bots, *habits, "--save", "collect.zip")[1]
    with zipfile.ZipFile(tmp_path / "collect.zip") as out:
        out.extractall(tmp_path)
    data = tmp_path / "study"
    assert "all equal" in run("collect replay", database)[1]
    run("collect export", database, "again")
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
