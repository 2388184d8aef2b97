"""Browsers without a network, and the ways that they take through the pages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

from tests.people.client import Client
from xplain.people.bots import Bot, Browser, Page, visit
from xplain.people.export import find_differences
from xplain.people.server import Server
from xplain.people.store import Store
from xplain.people.web import create_app

Walk = Iterator[tuple[str, Page]]
GENEROUS = Server(("invitation", "open"), burst=1e9, visitor_burst=1e9, blinded=False)


class Visitor(Browser):
    """A browser that talks to the application directly."""

    def __init__(self, client: Client) -> None:
        super().__init__("http://localhost")
        self.client = client

    def another(self) -> Visitor:
        """A new browser of the same application."""
        return Visitor(Client(self.client.app))

    def send(
        self, method: str, path: str, fields: list[tuple[str, str]] | None = None
    ) -> tuple[int, str]:
        reply = self.client.open(path, method=method, data=fields, follow_redirects=True)
        return reply.status_code, reply.text

    def answer(self, page: Page, *fields: tuple[str, str]) -> tuple[int, str, Page]:
        """Answers a page. Returns the status, the next page's text, and the page."""
        status, html = self.post("/study", [*page.hidden.items(), *fields])
        return status, html, Page.of_html(html)


def field(html: str, name: str) -> str:
    """Returns the value of a hidden field."""
    found = re.search(rf'name="{name}" value="([^"]*)"', html)
    assert found, f"no field {name} in {html}"
    return found.group(1)


def enter(visitor: Visitor, invitation: str) -> str:
    """Goes to the consent page."""
    _, html = visitor.get(f"/?invitation={invitation}")
    fields = [("token", field(html, "token")), ("invitation", invitation)]
    status, html = visitor.post("/enter", fields)
    assert status == 200
    return html


def newcomer(store: Store, server: Server = GENEROUS) -> Visitor:
    """A new browser of a new application."""
    return Visitor(Client(create_app(store, server)))


def arrive(store: Store, server: Server = GENEROUS) -> tuple[Visitor, Page]:
    """Makes a visitor with a new invitation and a new browser, at the consent page."""
    visitor = newcomer(store, server)
    return visitor, Page.of_html(enter(visitor, *store.invite(1, "person")))


def consent(store: Store, who: str) -> Any:
    """Gives consent, directly in the store."""
    payload = {"agree": 1, "text": store.flow.plan.texts.consent_hash}
    return store.submit(who, 0, "consent", payload)


def agreed(store: Store) -> str:
    """Somebody with a new invitation who agrees. Returns their id."""
    who = store.enter_invited(*store.invite(1, "person"))
    consent(store, who)
    return who


def pages(visitor: Visitor, person: Bot[Any, Any], invitation: str) -> Walk:
    """Yields every page, before it is answered."""
    html = enter(visitor, invitation)
    while True:
        page = Page.of_html(html)
        yield html, page
        if not page.hidden:
            return
        status, html = visitor.post("/study", [*page.hidden.items(), *person.fill(page)[0]])
        assert status == 200


def way(store: Store, person: Bot[Any, Any], stream: str = "person") -> Walk:
    """Every page on the way of somebody with a new invitation and a new browser."""
    return pages(newcomer(store), person, *store.invite(1, stream))


def take_part(store: Store, people: Iterable[Bot[Any, Any]], stream: str = "person") -> list[str]:
    """Simulated people go through the pages, one after the other. Returns the stages where they
    end."""
    app = create_app(store, GENEROUS)
    return [visit(Visitor(Client(app)), one, *store.invite(1, stream)) for one in people]


def differences(store: Store) -> list[str]:
    """Lists decisions that the plan would make differently."""
    return find_differences(store.flow, store.everybody())


def query(store: Store, sql: str, values: Any = ()) -> list[dict[str, Any]]:
    """Returns rows of the database that a store has open."""
    found = store._connection.execute(sql, values)
    names = [column[0] for column in found.description]
    return [dict(zip(names, row, strict=True)) for row in found]
