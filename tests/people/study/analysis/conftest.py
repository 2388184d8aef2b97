"""A snapshot of a study in which simulated participants took part."""

from pathlib import Path

import numpy as np
import pytest

from tests.people.study.stand_in import FAULTLESS
from tests.people.visitors import take_part
from xplain.people.store import Store
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study


@pytest.fixture(scope="package")
def collected(tmp_path_factory: pytest.TempPathFactory, study: Study) -> tuple[bytes, str]:
    """Makes a snapshot with 24 bots, some of whom leave, one person, and one visitor. Returns also
    the server's secret."""
    folder = tmp_path_factory.mktemp("collected")
    store = Store(folder / "study.sqlite", study)
    rngs, err = map(np.random.default_rng, range(24)), Habits(leaving=0.05, mistake=0.1)
    take_part(store, (StudyBot(study.plan, err, rng) for rng in rngs), "bot")
    take_part(store, [StudyBot(study.plan, FAULTLESS, np.random.default_rng(0))])
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
