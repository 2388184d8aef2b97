"""Studies, stores and pages for the tests; all on a domain that the study has never seen."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flask.testing import FlaskClient

from tests.study.stand_in import street_study
from xplain.participants.server.app import create_app
from xplain.participants.server.http import Server
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import Browser
from xplain.study.protocol.plan import Study
from xplain.study.simulation.participant import Habits, Person

FAULTLESS = Habits(0, 0, 0, 0, mistake=0)
GENEROUS = Server(("invitation", "prolific", "open"), burst=1e9, visitor_burst=1e9)


class Visitor(Browser):
    """A browser that talks to the application directly."""

    def __init__(self, client: FlaskClient) -> None:
        super().__init__("http://localhost")
        self.client = client

    def once(self, method: str, path: str, body: str | None) -> tuple[int, dict[str, str], str]:
        kind = "application/x-www-form-urlencoded" if body is not None else None
        reply = self.client.open(path, method=method, data=body, content_type=kind)
        return reply.status_code, {k.lower(): v for k, v in reply.headers.items()}, reply.text


@pytest.fixture(scope="session")
def study() -> Study:
    return street_study()


@pytest.fixture
def store(tmp_path: Path, study: Study) -> Iterator[Store]:
    opened = Store(tmp_path / "study.sqlite", study)
    yield opened
    opened.close()


@pytest.fixture
def browser(store: Store) -> Callable[[], Visitor]:
    """A new browser at each call."""
    app = create_app(store, GENEROUS)
    return lambda: Visitor(app.test_client())


@pytest.fixture
def person(study: Study) -> Callable[..., Person]:
    def make(number: int = 0, habits: Habits = FAULTLESS) -> Person:
        return Person(study.plan, habits, np.random.default_rng(number))

    return make


def field(html: str, name: str) -> str:
    """The value of a hidden field."""
    found = re.search(rf'name="{name}" value="([^"]*)"', html)
    assert found, f"no field {name} in {html}"
    return found.group(1)


def enter(visitor: Visitor, invitation: str) -> str:
    """Up to the consent page."""
    _, html = visitor.get(f"/?invitation={invitation}")
    fields = [("token", field(html, "token")), ("invitation", invitation)]
    status, html = visitor.post("/enter", fields)
    assert status == 200
    return html


def consent(store: Store, who: str) -> Any:
    """Agrees, straight at the store."""
    payload = {"agree": 1, "text": store.study.plan.texts.consent_hash}
    return store.submit(who, 0, "consent", payload)
