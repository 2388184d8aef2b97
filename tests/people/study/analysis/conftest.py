"""A snapshot of a study in which simulated participants took part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.people.client import Client
from tests.people.study.stand_in import FAULTLESS
from tests.people.visitors import GENEROUS, Visitor
from xplain.people.bots import visit
from xplain.people.store import Store
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study
from xplain.people.web import create_app


@pytest.fixture(scope="package")
def collected(tmp_path_factory: pytest.TempPathFactory, study: Study) -> tuple[bytes, str]:
    """Makes a snapshot with 24 bots, some of whom leave, one person, and one visitor. Returns also
    the server's secret."""
    folder = tmp_path_factory.mktemp("collected")
    store = Store(folder / "study.sqlite", study)
    app = create_app(store, GENEROUS)

    def take_part(number: int, habits: Habits, token: str) -> None:
        someone = StudyBot(study.plan, habits, np.random.default_rng(number))
        visit(Visitor(Client(app)), someone, token)

    for number, token in enumerate(store.invite(24, "bot")):
        take_part(number, Habits(leaving=0.05, mistake=0.1), token)
    take_part(0, FAULTLESS, store.invite(1, "person")[0])
    store.enter_invited(store.invite(1, "person")[0])
    store.snapshot(folder / "snapshot.sqlite")
    secret = store.secret.hex()
    store.close()
    return (folder / "snapshot.sqlite").read_bytes(), secret


@pytest.fixture
def snapshot(collected: tuple[bytes, str], tmp_path: Path) -> Path:
    """Makes a separate copy of the snapshot."""
    path = tmp_path / "snapshot.sqlite"
    path.write_bytes(collected[0])
    return path
