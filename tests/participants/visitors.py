"""Browsers without a network, and the ways that they take through the pages."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from flask.testing import FlaskClient

from xplain.participants.server.http import Server
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import Browser, Page
from xplain.study.simulation.participant import Person

GENEROUS = Server(
    ("invitation", "prolific", "open"), ("s",), burst=1e9, visitor_burst=1e9, blinded=False
)


class Visitor(Browser):
    """A browser that talks to the application directly."""

    def __init__(self, client: FlaskClient) -> None:
        super().__init__("http://localhost")
        self.client = client

    def once(self, method: str, path: str, body: str | None) -> tuple[int, dict[str, str], str]:
        kind = "application/x-www-form-urlencoded" if body is not None else None
        reply = self.client.open(path, method=method, data=body, content_type=kind)
        return reply.status_code, {k.lower(): v for k, v in reply.headers.items()}, reply.text


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
    payload = {"agree": 1, "text": store.protocol.plan.texts.consent_hash}
    return store.submit(who, 0, "consent", payload)


def pages(visitor: Visitor, person: Person, invitation: str) -> Iterator[tuple[str, Page]]:
    """Every page on the way, before it is answered."""
    html = enter(visitor, invitation)
    while True:
        page = Page(html)
        yield html, page
        if not page.hidden:
            return
        status, html = visitor.post("/study", [*page.hidden.items(), *person.fill(page)[0]])
        assert status == 200
