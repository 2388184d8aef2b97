"""A snapshot of a study in which simulated participants took part."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.participants.conftest import browser as browser
from tests.participants.conftest import store as store
from tests.participants.visitors import Visitor
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import visit
from xplain.study.simulation.participant import Habits, Person


@pytest.fixture
def snapshot(
    store: Store,
    browser: Callable[[], Visitor],
    person: Callable[..., Person],
    tmp_path: Path,
) -> Path:
    """24 bots, some of whom leave, one person, one who only looked in."""
    for number, token in enumerate(store.invite(24, "bot")):
        habits = Habits(leaving=0.05, mistake=0.1)
        visit(browser(), person(number, habits), token)
    visit(browser(), person(), store.invite(1, "person")[0])
    store.enter_invited(store.invite(1, "person")[0])
    path = tmp_path / "snapshot.sqlite"
    store.snapshot(path)
    return path
