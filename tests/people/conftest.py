"""Stores and applications on a domain that the study has never seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI

from tests.people.client import Client
from tests.people.study.conftest import person as person
from tests.people.study.conftest import study as study
from tests.people.visitors import GENEROUS, Visitor
from xplain.people.store import Store
from xplain.people.study.flow import Study
from xplain.people.web import create_app


@pytest.fixture
def store(tmp_path: Path, study: Study) -> Iterator[Store]:
    opened = Store(tmp_path / "study.sqlite", study)
    yield opened
    opened.close()


@pytest.fixture
def browser(store: Store) -> Callable[[], Visitor]:
    """A new browser at each call."""
    app = create_app(store, GENEROUS)
    return lambda: Visitor(Client(app))


@pytest.fixture
def app(store: Store) -> FastAPI:
    return create_app(store, GENEROUS)


@pytest.fixture
def client(app: FastAPI) -> Client:
    return Client(app)
