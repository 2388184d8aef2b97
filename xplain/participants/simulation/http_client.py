"""A simulated participant over HTTP: reads the pages' HTML, as a browser without scripts would."""

from __future__ import annotations

import http.client
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Protocol
from urllib.parse import urlencode, urlsplit

_DRAWINGS = re.compile(r"<svg.*?</svg>", re.DOTALL)
WIDTH = {"width": "1280"}
"""Of the window that a client without scripts says it has."""


@dataclass
class Choice:
    """A radio button or a checkbox with the words beside it."""

    name: str
    value: str
    text: str = ""


class Page(HTMLParser):
    """What a participant sees of a page.

    Attributes:
        stage: of the protocol; "" on other pages.
        hidden: the hidden fields of the form that goes on.
        choices: its radio buttons and checkboxes.
        messages, facts: the sentences on the page.
        headings: texts of h1.
        steps: ``data-step`` of the list's items: which transitions a clip shows.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.stage = ""
        self.hidden: dict[str, str] = {}
        self.choices: list[Choice] = []
        self.messages: list[str] = []
        self.facts: list[str] = []
        self.headings: list[str] = []
        self.steps: list[str] = []
        self._text: list[str] | None = None
        self._skip = False
        self._inside: list[str] = []
        # Most of a page is drawn, and simulated people read.
        self.feed(_DRAWINGS.sub("", html))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes fields; starts to collect texts."""
        found = {name: value or "" for name, value in attrs}
        kind, classes = found.get("type", ""), found.get("class", "").split()
        if tag == "body":
            self.stage = found.get("data-stage", "")
        elif tag == "form" or (tag == "details" and "leave" in classes):
            self._skip = self._skip or tag == "details"
        elif tag == "input" and not self._skip:
            if kind == "hidden":
                # Scripts would fill in the width of the window.
                self.hidden[found["name"]] = found.get("value") or WIDTH.get(found["name"], "")
            elif kind in ("radio", "checkbox"):
                self.choices.append(Choice(found["name"], found["value"]))
        elif tag == "ul" and "facts" in classes:
            self._inside.append("facts")
        elif tag == "div" and "message" in classes:
            self._start("message")
        elif tag == "li" and "data-step" in found:
            self.steps.append(found["data-step"])
        elif tag == "li" and self._inside[-1:] == ["facts"]:
            self._start("fact")
        elif tag == "label":
            self._start("label")
        elif tag == "h1":
            self._start("h1")
        elif tag == "span" and "tag" in classes:
            self._inside.append("tag")

    def _start(self, what: str) -> None:
        self._inside.append(what)
        self._text = []

    def handle_data(self, data: str) -> None:
        """Adds to the text that is being collected, if any."""
        if self._text is not None and self._inside[-1:] != ["tag"]:
            self._text.append(data)

    def handle_endtag(self, tag: str) -> None:
        """Puts the collected text where it belongs."""
        ends = {"message": "div", "fact": "li", "label": "label", "h1": "h1", "tag": "span"}
        ends["facts"] = "ul"
        if tag == "details":
            self._skip = False
        if not self._inside or ends[self._inside[-1]] != tag:
            return
        what = self._inside.pop()
        text = " ".join("".join(self._text or ()).split())
        if what == "message":
            self.messages.append(text)
        elif what == "fact":
            self.facts.append(text)
        elif what == "h1":
            self.headings.append(text)
        elif what == "label" and self.choices:
            self.choices[-1].text = text
        if what not in ("tag", "facts"):
            self._text = None

    def groups(self) -> dict[str, list[Choice]]:
        """The choices by name, in the page's order."""
        found: dict[str, list[Choice]] = {}
        for choice in self.choices:
            found.setdefault(choice.name, []).append(choice)
        return found


class Visitor(Protocol):
    """Somebody simulated."""

    def leaves(self) -> bool:
        """Whether this page is where they drop out."""
        ...

    def fill(self, page: Page) -> tuple[list[tuple[str, str]], float]:
        """The fields that they fill in on a page, and how long it took them, in seconds."""
        ...


@dataclass
class Browser:
    """Just enough of a browser: cookies, redirects, retries while the server is away.

    Attributes:
        url: of the server.
        patience: seconds to go on trying.
        timings: (seconds, status) of every request.
        address: sent as the visitor's, for servers that trust a proxy.
    """

    url: str
    patience: float = 30.0
    timings: list[tuple[float, int]] = field(default_factory=list)
    cookies: dict[str, str] = field(default_factory=dict)
    _connection: http.client.HTTPConnection | None = None

    def get(self, path: str) -> tuple[int, str]:
        """A page, redirects followed."""
        return self._follow("GET", path, None)

    def post(self, path: str, fields: list[tuple[str, str]]) -> tuple[int, str]:
        """Sends a form, then follows where it leads."""
        return self._follow("POST", path, urlencode(fields))

    def _follow(self, method: str, path: str, body: str | None) -> tuple[int, str]:
        status, headers, text = self._retried(method, path, body)
        if status == 303:
            return self._follow("GET", headers["location"], None)
        return status, text

    def _retried(self, method: str, path: str, body: str | None) -> tuple[int, dict[str, str], str]:
        until = time.monotonic() + self.patience
        while True:
            try:
                answer = self.once(method, path, body)
            except (OSError, http.client.HTTPException):
                self.close()
                if time.monotonic() > until:
                    raise
                time.sleep(0.1)
                continue
            if answer[0] not in (429, 500, 502) or time.monotonic() > until:
                return answer
            time.sleep(0.3)

    def once(self, method: str, path: str, body: str | None) -> tuple[int, dict[str, str], str]:
        """One request on the open connection: status, headers, text."""
        parts = urlsplit(self.url)
        if self._connection is None:
            self._connection = http.client.HTTPConnection(
                parts.hostname or "", parts.port, timeout=20
            )
        headers = {"Cookie": "; ".join(f"{k}={v}" for k, v in self.cookies.items())}
        if body is not None:
            headers["Content-Type"] = "application/x-www-form-urlencoded"
        start = time.perf_counter()
        self._connection.request(method, path, body, headers)
        response = self._connection.getresponse()
        text = response.read().decode(errors="replace")
        self.timings.append((time.perf_counter() - start, response.status))
        for name, value in response.getheaders():
            if name.lower() == "set-cookie":
                key, _, rest = value.partition("=")
                self.cookies[key] = rest.split(";")[0]
        return response.status, {k.lower(): v for k, v in response.getheaders()}, text

    def close(self) -> None:
        """Closes the connection; the next request opens another."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None


class Refusal(Exception):
    """The server did not accept an answer: status, and the stage of the page."""


def visit(
    browser: Browser,
    person: Visitor,
    invitation: str,
    think: Callable[[float], None] = lambda seconds: None,
) -> str:
    """Takes part from the invitation to the end.

    Args:
        browser: with the server's address.
        person: who answers.
        invitation: the token.
        think: called with the seconds a person would take before each answer.

    Returns:
        The last stage; "left" for somebody who dropped out.

    Raises:
        Refusal: an answer was not accepted.
        OSError: the server was away for longer than the browser's patience.
    """
    try:
        return _visit(browser, person, invitation, think)
    finally:
        browser.close()


def _visit(
    browser: Browser,
    person: Visitor,
    invitation: str,
    think: Callable[[float], None],
) -> str:
    _, html = browser.get(f"/?invitation={invitation}")
    page = Page(html)
    _, html = browser.post("/enter", [*page.hidden.items(), ("invitation", invitation)])
    page = Page(html)
    while page.hidden:
        if person.leaves():
            return "left"
        fields, seconds = person.fill(page)
        think(seconds)
        status, html = browser.post("/study", [*page.hidden.items(), *fields])
        if status >= 400:
            raise Refusal(status, page.stage)
        page = Page(html)
    return page.stage
