"""Stores and applications on a domain that the study has never seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from tests.people.client import Client
from tests.people.study.conftest import person as person
from tests.people.study.conftest import study as study
from tests.people.visitors import GENEROUS, Visitor
from xplain.people.log import Clock
from xplain.people.store import Store
from xplain.people.study.flow import Study
from xplain.people.web import create_app

Opened = Callable[..., Store]


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
def browser(store: Store) -> Callable[[], Visitor]:
    """Returns a function that makes a new browser at each call."""
    app = create_app(store, GENEROUS)
    return lambda: Visitor(Client(app))


@pytest.fixture
def app(store: Store) -> FastAPI:
    return create_app(store, GENEROUS)


@pytest.fixture
def client(app: FastAPI) -> Client:
    return Client(app)
