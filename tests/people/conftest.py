"""Stores, studies and simulated participants on a domain that the study has never seen."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.people.street import street_study
from tests.people.visitors import Client, Opened, Visitor, newcomer
from xplain.people.log import Clock
from xplain.people.store import Store
from xplain.people.study.flow import Study


@pytest.fixture(scope="session")
def study() -> Study:
    return street_study()


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
