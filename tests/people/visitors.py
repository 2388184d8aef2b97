"""Browsers without a network, and the ways that they take through the pages."""

from __future__ import annotations

import asyncio
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from http.cookies import SimpleCookie
from json import dumps, loads
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlencode, urlsplit

import anyio.to_thread
from starlette.datastructures import Headers

from xplain.people.bots import Bot, Browser, Page, visit
from xplain.people.export import find_differences
from xplain.people.site import Server
from xplain.people.store import Store
from xplain.people.web import create_app

Opened = Callable[..., Store]
"""Opens a store of a flow."""
Walk = Iterator[tuple[str, Page]]
GENEROUS = Server(("invitation", "open"), blinded=False)


LOCAL = threading.local()
"""An event loop for each thread."""
_in_a_thread = anyio.to_thread.run_sync


async def _at_once(function: Any, *args: Any, **more: Any) -> Any:
    """Calls a handler in the client's thread, because new threads would take half of the time."""
    if hasattr(LOCAL, "runner"):
        return function(*args)
    return await _in_a_thread(function, *args, **more)


anyio.to_thread.run_sync = _at_once


class Reply:
    """The response to a request."""

    def __init__(self, status: int, headers: list[tuple[bytes, bytes]], data: bytes) -> None:
        self.status_code, self.headers, self.data = status, Headers(raw=headers), data

    @property
    def text(self) -> str:
        return self.data.decode()

    def json(self) -> Any:
        return loads(self.data)


class Client:
    """A client that keeps cookies, unless it is created without."""

    def __init__(self, app: Any, cookies: bool = True) -> None:
        self.app, self.keeps, self.cookies = app, cookies, dict[str, tuple[str, str]]()

    def set_cookie(self, name: str, value: str) -> None:
        self.cookies[name] = value, "/"

    def get(self, path: str, **more: Any) -> Reply:
        return self.open(path, **more)

    def post(self, path: str, **more: Any) -> Reply:
        return self.open(path, method="POST", **more)

    def open(
        self,
        path: str,
        method: str = "GET",
        data: Any = None,
        json: Any = None,
        headers: dict[str, str] | None = None,
        base_url: str = "http://localhost",
        follow_redirects: bool = False,
    ) -> Reply:
        body = data if isinstance(data, bytes) else (data or "") if isinstance(data, str) else b""
        if json is not None:
            body = dumps(json)
        elif not isinstance(data, bytes | str):
            body = urlencode(data or (), doseq=True, errors="surrogatepass")
        content = body.encode() if isinstance(body, str) else body
        url, outside = urlsplit(path), urlsplit(base_url)
        sent = {"host": outside.netloc, **{k.lower(): v for k, v in (headers or {}).items()}}
        kept = [f"{n}={v}" for n, (v, below) in self.cookies.items() if url.path.startswith(below)]
        if kept and "cookie" not in sent:
            sent["cookie"] = "; ".join(kept)
        scope = {
            "type": "http",
            "http_version": "1.1",
            "method": method,
            "scheme": outside.scheme,
            "path": unquote(url.path),
            "raw_path": url.path.encode(),
            "query_string": url.query.encode(),
            "root_path": "",
            "headers": [(k.encode("latin-1"), v.encode("latin-1")) for k, v in sent.items()],
            "client": ("127.0.0.1", 1),
            "server": ("localhost", 80),
        }
        reply = self._run(scope, content)
        for cookie in SimpleCookie("\r\n".join(reply.headers.getlist("set-cookie"))).values():
            self.cookies[cookie.key] = cookie.value, cookie["path"]
            if not self.keeps or cookie["max-age"] == "0":
                del self.cookies[cookie.key]
        if follow_redirects and reply.status_code == 303:
            return self.get(reply.headers["location"], base_url=base_url, follow_redirects=True)
        return reply

    def _run(self, scope: dict[str, Any], content: bytes) -> Reply:
        came: list[dict[str, Any]] = [{"type": "http.request", "body": content}]
        parts: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return came.pop() if came else await asyncio.Event().wait()  # type: ignore[return-value]

        async def send(message: dict[str, Any]) -> None:
            parts.append(message)

        if not hasattr(LOCAL, "runner"):
            LOCAL.runner = asyncio.Runner()
        LOCAL.runner.run(self.app(scope, receive, send))
        data = b"".join(part.get("body", b"") for part in parts)
        return Reply(parts[0]["status"], parts[0]["headers"], data)


class Visitor(Browser):
    """A browser that talks to the application directly."""

    def __init__(self, client: Client) -> None:
        super().__init__("http://localhost")
        self.client = client

    def another(self) -> Visitor:
        """A new browser of the same application."""
        return Visitor(Client(self.client.app))

    def post(self, path: str, fields: list[tuple[str, str]] | None) -> tuple[int, str]:
        method = "GET" if fields is None else "POST"
        reply = self.client.open(path, method=method, data=fields, follow_redirects=True)
        return reply.status_code, reply.text

    def answer(self, page: Page, *fields: tuple[str, str]) -> tuple[int, str, Page]:
        """Answers a page. Returns the status, the next page's text, and the page."""
        status, html = self.post("/study", [*page.hidden.items(), *fields])
        return status, html, Page.of_html(html)


def enter(visitor: Visitor, invitation: str) -> str:
    """Goes to the consent page."""
    _, html = visitor.get(f"/?invitation={invitation}")
    fields = Page.of_html(html).hidden | {"invitation": invitation}
    status, html = visitor.post("/enter", [*fields.items()])
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


@contextmanager
def copied(store: Store) -> Iterator[sqlite3.Connection]:
    """Opens a copy of a store's database."""
    with tempfile.TemporaryDirectory() as folder:
        store.snapshot(path := Path(folder, "copy.sqlite"))
        with closing(sqlite3.connect(path)) as copy:
            yield copy


def query(store: Store, sql: str, values: Any = ()) -> list[dict[str, Any]]:
    """Returns rows of a store's database."""
    with copied(store) as copy:
        copy.row_factory = sqlite3.Row
        return [dict(row) for row in copy.execute(sql, values)]
