"""A simulated participant over HTTP: reads the pages' HTML, as a browser without scripts would."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import lxml.html
import requests
from requests.cookies import RequestsCookieJar

from xplain.people.flow import Fields

WIDTH = {"width": "1280"}
"""Of the window that a client without scripts says it has."""


def _of_class(tag: str, name: str) -> str:
    return f"//{tag}[contains(concat(' ', normalize-space(@class), ' '), ' {name} ')]"


_LEAVING = f"[not(ancestor::{_of_class('details', 'leave')[2:]})]"


@dataclass(frozen=True)
class Page:
    """What a participant sees of a page.

    Attributes:
        stage: of the flow; "" on other pages.
        facts, messages: the sentences on the page.
        new: the messages that are said on this page, for the first time or again.
        fields: radio buttons and checkboxes by name, each its (value, words beside it).
        steps: which transitions a clip shows.
        hidden: the hidden fields of the form that goes on.
        headings: texts of h1.
    """

    stage: str
    facts: Sequence[str] = ()
    messages: Sequence[str] = ()
    new: Sequence[str] = ()
    fields: Mapping[str, Sequence[tuple[Any, str]]] = field(default_factory=dict)
    steps: Sequence[int] = ()
    hidden: Mapping[str, str] = field(default_factory=dict)
    headings: Sequence[str] = ()

    @classmethod
    def of_html(cls, html: str) -> Page:
        """As a browser gets it."""
        tree = lxml.html.document_fromstring(html)
        fields: dict[str, list[tuple[str, str]]] = {}
        for one in tree.xpath(f"//input[@type='radio' or @type='checkbox']{_LEAVING}"):
            said = _text(one.getparent())
            fields.setdefault(one.get("name"), []).append((one.get("value"), said))
        hidden = {
            one.get("name"): one.get("value") or WIDTH.get(one.get("name"), "")
            for one in tree.xpath(f"//input[@type='hidden']{_LEAVING}")
        }
        message = _of_class("div", "message")
        return cls(
            stage=tree.find("body").get("data-stage", ""),
            facts=[_text(one) for one in tree.xpath(_of_class("ul", "facts") + "/li")],
            messages=[_text(one) for one in tree.xpath(message)],
            new=[_text(one) for one in tree.xpath(message) if "new" in one.get("class").split()],
            fields=fields,
            steps=[int(step) for step in tree.xpath("//*[not(self::body)]/@data-step") if step],
            hidden=hidden,
            headings=[_text(one) for one in tree.iter("h1")],
        )

    @classmethod
    def of_view(cls, view: Mapping[str, Any]) -> Page:
        """As a flow has it, without a server."""
        facts, told, new = (view.get(key, ()) for key in ("briefing", "told", "new"))
        steps = view.get("transitions", ())
        return cls(view["stage"], facts, told, new, view.get("fields", {}), steps)


def _text(element: Any) -> str:
    """What it says, without the tags that mark something as new."""
    said = element.xpath(".//text()[not(parent::span[@class='tag'])]")
    return " ".join("".join(said).split())


class Visitor(Protocol):
    """Somebody simulated."""

    def leaves(self, page: Page) -> bool:
        """Whether this page is where they drop out."""
        ...

    def fill(self, page: Page) -> tuple[Fields, float]:
        """The fields that they fill in on a page, and how long it took them, in seconds."""
        ...


class Cookies(RequestsCookieJar):
    """Keeps cookies that are meant for https also from a server whose proxy speaks it."""

    def set_cookie(self, cookie: Any, *args: Any, **kwargs: Any) -> Any:
        """As a cookie for any protocol."""
        cookie.secure = False
        return super().set_cookie(cookie, *args, **kwargs)


def new_session() -> requests.Session:
    """Goes straight to the server, through no proxy of the environment."""
    session = requests.Session()
    session.trust_env, session.cookies = False, Cookies()
    return session


@dataclass
class Browser:
    """Goes on trying while the server is away.

    Attributes:
        url: of the server.
        patience: seconds to go on trying.
        timings: (seconds, status) of every request.
        session: with the cookies.
    """

    url: str
    patience: float = 30.0
    timings: list[tuple[float, int]] = field(default_factory=list)
    session: requests.Session = field(default_factory=new_session)

    def get(self, path: str) -> tuple[int, str]:
        """A page, redirects followed."""
        return self.send("GET", path)

    def post(self, path: str, fields: Fields) -> tuple[int, str]:
        """Sends a form, then follows where it leads."""
        return self.send("POST", path, fields)

    def send(self, method: str, path: str, fields: Fields | None = None) -> tuple[int, str]:
        """Status and text of the last answer.

        Raises:
            OSError: the server was away for longer than the patience.
        """
        until = time.monotonic() + self.patience
        while True:
            late = time.monotonic() > until
            try:
                reply = self.session.request(method, self.url + path, data=fields, timeout=20)
            except requests.RequestException:
                if late:
                    raise
            else:
                for one in (*reply.history, reply):
                    self.timings.append((one.elapsed.total_seconds(), one.status_code))
                if late or reply.status_code not in (429, 500, 502):
                    return reply.status_code, reply.text
            time.sleep(0.2)


def walk(
    page: Page,
    answer: Callable[[Page, Fields], Page],
    person: Visitor,
    think: Callable[[float], None] = lambda seconds: None,
    look: Callable[[Page], None] = lambda page: None,
) -> str:
    """From a page to the end.

    Args:
        page: that is open.
        answer: sends the fields of a page, and gives the next one.
        person: who answers.
        think: called with the seconds that a person would take before each answer.
        look: called with every page.

    Returns:
        The last stage; "left" for somebody who dropped out.
    """
    look(page)
    while page.hidden:
        if person.leaves(page):
            return "left"
        fields, seconds = person.fill(page)
        think(seconds)
        page = answer(page, fields)
        look(page)
    return page.stage


class Refusal(Exception):
    """The server did not accept an answer: status, and the stage of the page."""


def visit(
    browser: Browser,
    person: Visitor,
    invitation: str,
    think: Callable[[float], None] = lambda seconds: None,
) -> str:
    """Takes part from the invitation to the end; see :func:`walk`.

    Raises:
        Refusal: an answer was not accepted.
        OSError: the server was away for longer than the browser's patience.
    """

    def answer(page: Page, fields: Fields) -> Page:
        status, html = browser.post("/study", [*page.hidden.items(), *fields])
        if status >= 400:
            raise Refusal(status, page.stage)
        return Page.of_html(html)

    with browser.session:
        page = Page.of_html(browser.get(f"/?invitation={invitation}")[1])
        sent = [*page.hidden.items(), ("invitation", invitation)]
        page = Page.of_html(browser.post("/enter", sent)[1])
        return walk(page, answer, person, think)
