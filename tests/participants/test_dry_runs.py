"""The real server: dry runs over HTTP, kill -9, one process a database."""

from __future__ import annotations

import time
import zipfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.conftest import Command
from tests.participants.killing import RATE, survive
from tests.participants.server_process import ServerProcess
from tests.study.stand_in import FAULTLESS, street_study
from xplain.cli.main import main
from xplain.participants.server.store import Store
from xplain.participants.simulation.bots import Researcher
from xplain.participants.simulation.http_client import Browser, Refusal, visit
from xplain.study.analysis.export import export
from xplain.study.protocol.plan import Study, StudyPlan
from xplain.study.server.protocol import StudyProtocol
from xplain.study.simulation.participant import Habits, Person


@pytest.fixture
def database(tmp_path: Path, study: Study) -> Path:
    """With a plan in it."""
    path = tmp_path / "study.sqlite"
    Store(path, StudyProtocol(study)).close()
    return path


def test_bots_take_part_and_the_data_goes_all_the_way(
    database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ServerProcess(database, *RATE) as server:
        archive = tmp_path / "study.zip"
        arguments = ["--url", server.url, "--key", server.key, "--count", "24", "--at-once", "6"]
        main(["study", "bots", *arguments, "--leaving", "0.01", "--save", str(archive)])
        with pytest.raises(SystemExit) as ended:
            main(["study", "bots", "--url", server.url, "--key", "wrong"])
        assert ended.value.code == 2
        assert "researcher's key" in capsys.readouterr().err
    with zipfile.ZipFile(archive) as out:
        out.extractall(tmp_path)
    capsys.readouterr()
    for path in (tmp_path / "study" / "snapshot.sqlite", database):
        main(["study", "replay", str(path)])
        assert "all equal" in capsys.readouterr().out
    main(["study", "analyse", str(tmp_path / "study"), "--stream", "bot"])
    people = pd.read_csv(tmp_path / "study" / "participants.csv")
    assert set(people["stream"]) == {"bot"}
    assert (people["stage"] == "done").sum() >= 12


def survivors(database: Path, study: Study, kills: int, people: int) -> tuple[int, int]:
    """Answers acknowledged and stored."""

    def person(number: int, place: int) -> Person:
        return Person(study.plan, FAULTLESS, np.random.default_rng([place, number]))

    return survive(database, StudyProtocol(study), "study", person, kills, people)


def _everything_replays(database: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["study", "replay", str(database)])
    assert "all equal" in capsys.readouterr().out


def test_kill_9_loses_nothing_that_was_acknowledged(
    database: Path, study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    acknowledged, stored = survivors(database, study, kills=1, people=4)
    assert 10 < acknowledged <= stored
    _everything_replays(database, capsys)


@pytest.mark.slow
def test_kill_9_twenty_times_under_eight_participants(
    database: Path, study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    acknowledged, stored = survivors(database, study, kills=20, people=8)
    with capsys.disabled():
        print(f"\n20 kills: {acknowledged} answers acknowledged, {stored} stored")
    assert 200 < acknowledged <= stored
    _everything_replays(database, capsys)


def fill_every_place(study: Study, path: Path, habits: Habits) -> Counter[str]:
    """People's places, filled over HTTP by simulated people some of whom drop out for good."""
    Store(path, StudyProtocol(study)).close()
    places = len(study.plan.cells) * study.plan.rules.per_cell
    stages: Counter[str] = Counter()
    with ServerProcess(path, *RATE) as server:
        invitations = Researcher(server.url, server.key).invite(400, "person")

        def one(number: int) -> str:
            person = Person(study.plan, habits, np.random.default_rng(number))
            try:
                return visit(Browser(server.url), person, invitations.pop())
            except Refusal as refusal:
                if refusal.args[0] != 503:
                    raise
                time.sleep(0.5)  # every place is taken for now
                return "full"

        with ThreadPoolExecutor(4) as pool:
            while stages["done"] < places:
                begun = sum(stages.values())
                stages.update(pool.map(one, range(begun, begun + 4)))
    return stages


def every_cell_is_full(study: Study, path: Path, out: Path) -> None:
    export(path, out)
    people = pd.read_csv(out / "participants.csv")
    done = people[people["stage"] == "done"]
    assert set(done.groupby(["type", "condition"]).size()) == {study.plan.rules.per_cell}
    assert len(done) == len(study.plan.cells) * study.plan.rules.per_cell


RULES = {"per_cell": 2, "max_attempts": 2, "timeout_minutes": 0.04, "recall": True}


def test_cells_fill_up_alike_over_http(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study, path = street_study(rules=RULES), tmp_path / "study.sqlite"
    stages = fill_every_place(study, path, Habits(leaving=0.04, mistake=0.03))
    assert stages["left"] > 0
    every_cell_is_full(study, path, tmp_path / "out")
    _everything_replays(path, capsys)


@pytest.mark.slow
def test_forty_bots_in_the_rescue_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from xplain.config import composed
    from xplain.study.policies import study_of
    from xplain.study.prepare import study_plan

    study = study_of(
        study_plan(composed("study", ["rules.per_cell=4", "rules.timeout_minutes=0.05"]))
    )
    path = tmp_path / "study.sqlite"
    stages = fill_every_place(study, path, Habits(leaving=0.02))
    assert stages["done"] == 40
    assert stages["left"] > 3
    every_cell_is_full(study, path, tmp_path / "out")
    main(["study", "analyse", str(tmp_path / "out")])
    main(["study", "replay", str(path)])
    said = capsys.readouterr().out
    assert "all equal" in said
    with capsys.disabled():
        print(f"\n{dict(stages)}\n{said}")


def test_one_process_a_database(database: Path, command: Command) -> None:
    with ServerProcess(database):
        second = command("xplain study", f"database={database}", "port=1")
    assert second.returncode == 2
    assert "another process is using it" in second.stderr
    assert "Traceback" not in second.stderr


def test_a_running_study_keeps_its_plan(database: Path, study: Study) -> None:
    with ServerProcess(database, "rules.per_cell=99", "lambda=2") as server:
        assert "are ignored" in server.log()
        assert "lambda" in server.log()
        plan = Researcher(server.url, server.key).plan(StudyPlan)
    assert plan.hash == study.plan.hash
