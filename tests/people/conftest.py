"""Stores, studies and simulated participants on a domain that the study has never seen."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.people.client import Client
from tests.people.study.stand_in import FAULTLESS, street_study
from tests.people.visitors import Visitor, newcomer
from xplain.people.log import Clock
from xplain.people.store import Store
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study

Opened = Callable[..., Store]


@pytest.fixture(scope="session")
def study() -> Study:
    return street_study()


@pytest.fixture
def person(study: Study) -> Callable[..., StudyBot]:
    def make(number: int = 0, habits: Habits = FAULTLESS) -> StudyBot:
        return StudyBot(study.plan, habits, np.random.default_rng(number))

    return make


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Opened]:
    """Opens stores of flows, which are closed at the end."""
    with ExitStack() as stores:

        def make(flow: Any, clock: Clock | None = None, name: str = "s") -> Store:
            store = Store(tmp_path / f"{name}.sqlite", flow, clock)
            stores.callback(store.close)
            return store

        yield make


@pytest.fixture
def store(opened: Opened, study: Study) -> Store:
    return opened(study)


@pytest.fixture
def browser(store: Store) -> Visitor:
    return newcomer(store)


@pytest.fixture
def client(browser: Visitor) -> Client:
    return browser.client
