"""Simulated people, who use a running server (``study bots``).

Bots use HTTP and invitations for bots, so their data is always marked. They read the plan from the
server's export, so the server may run anywhere.
"""

from __future__ import annotations

import io
import re
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, Generic, Protocol, TypeVar

import lxml.html
import numpy as np
import requests
from requests.cookies import RequestsCookieJar

from xplain.errors import InputError, Probability
from xplain.people.flow import Fields
from xplain.people.log import Plan
from xplain.people.plan import LabQuestion
from xplain.randomness import below

WIDTH = {"width": "1280"}
"""Window width that a client without scripts reports."""


def _select_class(tag: str, name: str) -> str:
    return f"//{tag}[contains(concat(' ', normalize-space(@class), ' '), ' {name} ')]"


_LEAVING = f"[not(ancestor::{_select_class('details', 'leave')[2:]})]"


@dataclass(frozen=True)
class Page:
    """The content of a page, as a participant sees it.

    Attributes:
        stage: stage of the flow; "" on other pages.
        facts, messages: the sentences on the page.
        new: the messages that are given on this page, for the first time or again.
        fields: radio buttons and checkboxes by name; each has (value, text) pairs.
        steps: the transitions that a clip shows.
        hidden: the hidden fields of the form.
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
        """Reads a page from its HTML."""
        tree = lxml.html.document_fromstring(html)
        fields: dict[str, list[tuple[str, str]]] = {}
        for one in tree.xpath(f"//input[@type='radio' or @type='checkbox']{_LEAVING}"):
            said = _read_text(one.getparent())
            fields.setdefault(one.get("name"), []).append((one.get("value"), said))
        hidden = {
            one.get("name"): one.get("value") or WIDTH.get(one.get("name"), "")
            for one in tree.xpath(f"//input[@type='hidden']{_LEAVING}")
        }
        message = _select_class("div", "message")
        return cls(
            stage=tree.find("body").get("data-stage", ""),
            facts=[_read_text(one) for one in tree.xpath(_select_class("ul", "facts") + "/li")],
            messages=[_read_text(one) for one in tree.xpath(message)],
            new=[
                _read_text(one) for one in tree.xpath(message) if "new" in one.get("class").split()
            ],
            fields=fields,
            steps=[int(step) for step in tree.xpath("//*[not(self::body)]/@data-step") if step],
            hidden=hidden,
            headings=[_read_text(one) for one in tree.iter("h1")],
        )


def _read_text(element: Any) -> str:
    """Reads the text of an element, without "new" tags and without letters in a picture."""
    said = element.xpath(".//text()[not(parent::span[@class='tag'] or ancestor::svg)]")
    return " ".join("".join(said).split())


class Visitor(Protocol):
    """A simulated person."""

    def leaves(self, page: Page) -> bool:
        """True if the person drops out at this page."""
        ...

    def fill(self, page: Page) -> tuple[Fields, float]:
        """Fills in a page. Returns the fields and the time that it took, in seconds."""
        ...


class Cookies(RequestsCookieJar):
    """A cookie jar that keeps https cookies also over http, for servers behind an https proxy."""

    def set_cookie(self, cookie: Any, *args: Any, **kwargs: Any) -> Any:
        """Stores the cookie for any protocol."""
        cookie.secure = False
        return super().set_cookie(cookie, *args, **kwargs)


def new_session() -> requests.Session:
    """Makes a session that ignores the proxies of the environment."""
    session = requests.Session()
    session.trust_env, session.cookies = False, Cookies()
    return session


@dataclass
class Browser:
    """An HTTP client that tries again while the server is unavailable.

    Attributes:
        url: address of the server.
        patience: seconds to try.
        timings: (seconds, status) of every request.
        session: holds the cookies.
    """

    url: str
    patience: float = 30.0
    timings: list[tuple[float, int]] = field(default_factory=list)
    session: requests.Session = field(default_factory=new_session)

    def get(self, path: str) -> tuple[int, str]:
        """Requests a page and follows redirects."""
        return self.send("GET", path)

    def post(self, path: str, fields: Fields) -> tuple[int, str]:
        """Sends a form and follows redirects."""
        return self.send("POST", path, fields)

    def send(self, method: str, path: str, fields: Fields | None = None) -> tuple[int, str]:
        """Returns status and text of the last response.

        Raises:
            OSError: the server was unavailable for longer than ``patience``.
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
    """Answers all pages from an open page to the end of the flow.

    Args:
        page: the open page.
        answer: sends the fields of a page and returns the next page.
        person: the visitor who answers.
        think: is called before each answer, with the seconds that a person would take.
        look: is called with every page.

    Returns:
        The last stage, or "left" after a drop-out.
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
    """The server did not accept an answer. Arguments: the HTTP status, and the page's stage
    (``entrance``: the server did not admit the person)."""


def visit(
    browser: Browser,
    person: Visitor,
    invitation: str,
    think: Callable[[float], None] = lambda seconds: None,
) -> str:
    """Opens an invitation, and answers all pages to the end (:func:`walk`).

    Raises:
        Refusal: an answer was not accepted.
        OSError: the server was unavailable for longer than the browser's ``patience``.
    """

    def send(path: str, page: Page, stage: str, fields: Fields) -> Page:
        status, html = browser.post(path, [*page.hidden.items(), *fields])
        if status >= 400:
            raise Refusal(status, stage)
        return Page.of_html(html)

    def answer(page: Page, fields: Fields) -> Page:
        return send("/study", page, page.stage, fields)

    with browser.session:
        page = Page.of_html(browser.get(f"/?invitation={invitation}")[1])
        page = send("/enter", page, "entrance", [("invitation", invitation)])
        return walk(page, answer, person, think)


@dataclass(frozen=True, kw_only=True)
class BotHabits:
    """Assumptions about people, which were not measured.

    Attributes:
        mistake: probability of a wrong answer in a practice or a test.
        leaving: probability of leaving at each page.
    """

    mistake: Probability = 0.02
    leaving: Probability = 0.0


H = TypeVar("H", bound=BotHabits)
P = TypeVar("P")


class Bot(Generic[P, H]):
    """One simulated participant, who knows only what the pages say.

    The method ``at_<stage>`` answers a stage's page: it returns the fields, or the fields and the
    duration in seconds. Pages without such a method need only a click. Each stage draws from its
    own random stream, so an additional page does not change other pages.

    Args:
        plan: has the sentences and the true labels.
        habits: the assumed behaviour.
        rng: random stream.
    """

    def __init__(self, plan: P, habits: H, rng: np.random.Generator) -> None:
        self.plan, self.habits, self.rng = plan, habits, rng
        self.streams = cache(partial(below, rng))
        self.corrected: set[tuple[str, int]] = set()

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return bool(self.rng.random() < probability)

    def leaves(self, page: Page) -> bool:
        """True if the participant drops out at this page."""
        self.rng = self.streams(page.stage)
        return self.chance(self.habits.leaving)

    def practises(self, page: Page, right: int) -> Fields:
        """Chooses the label of a practice step. The page reports a wrong label, so a bot errs at
        most once."""
        errs = self.chance(self.habits.mistake) and (page.stage, right) not in self.corrected
        if errs:
            self.corrected.add((page.stage, right))
        return [("label", str(right ^ errs))]

    def answer_questions(self, questions: tuple[LabQuestion, ...]) -> Fields:
        """Answers each required question: with the right answer if there is one, otherwise with the
        first allowed answer."""
        return [
            (q.field, q.right or (q.options or (str(q.low) if q.kind == "number" else "–",))[0])
            for q in questions
            if q.needed
        ]

    def fill(self, page: Page) -> tuple[Fields, float]:
        """Fills in a page. Returns the fields and the time that it took, in seconds."""
        self.rng = self.streams(page.stage)
        answer = getattr(self, f"at_{page.stage}", lambda page: None)
        filled: tuple[Fields, float] | Fields = answer(page) or []
        return filled if isinstance(filled, tuple) else (filled, 0.0)

    def at_consent(self, page: Page) -> Fields:
        """Agrees to take part."""
        return [("agree", "1")]

    def at_ahead(self, page: Page) -> Fields:
        """Answers that the step makes sense."""
        return self.practises(page, 1)

    def at_questions(self, page: Page) -> Fields:
        """Answers only the required questions."""
        return self.answer_questions(self.plan.asked)  # type: ignore[attr-defined]


class Researcher:
    """A program's access to the researcher's page.

    Args:
        url: address of the server.
        key: key that the server printed at its start.
    """

    def __init__(self, url: str, key: str) -> None:
        self.browser = Browser(url, patience=2)
        try:
            status, html = self.browser.post("/researcher/login", [("key", key)])
        except OSError as error:
            raise InputError("--url", url, f"a running study server ({error})") from None
        if status != 200:
            raise InputError("--key", key, "the researcher's key, which the server prints")
        self.token = Page.of_html(html).hidden["token"]

    def invite(self, count: int, stream_name: str = "bot") -> list[str]:
        """Creates invitations, and returns their tokens.

        Args:
            count: number of invitations.
            stream_name: kind of the invited participants: "person", "pilot" or "bot".
        """
        fields = [("token", self.token), ("count", str(count)), ("stream", stream_name)]
        _, html = self.browser.post("/researcher/invitations", fields)
        return re.findall(r"\?invitation=([\w-]+)", html)

    def archive(self) -> bytes:
        """Downloads the export, as a ZIP archive."""
        url = f"{self.browser.url}/researcher/export"
        return self.browser.session.post(url, data={"token": self.token}, timeout=60).content

    def plan(self, kind: type[Plan]) -> Plan:
        """Reads the plan in the server's export."""
        with zipfile.ZipFile(io.BytesIO(self.archive())) as archive:
            return kind.from_text(archive.read("study/plan.json").decode())


def crowd(
    researcher: Researcher,
    count: int,
    at_once: int,
    pace: float,
    person_of: Callable[[int], Visitor],
) -> Counter[str]:
    """Runs simulated people. Returns the number that ended at each stage.

    Args:
        researcher: creates the invitations.
        count: number of bots.
        at_once: maximum number of bots at the same time.
        pace: seconds to wait for each simulated second of thinking; 0 = no waiting.
        person_of: makes the simulated person from the bot's number, 0 … count − 1.
    """
    url = researcher.browser.url

    def think(seconds: float) -> None:
        time.sleep(pace * seconds)

    def one(number: int, invitation: str) -> str:
        return visit(Browser(url), person_of(number), invitation, think)

    invitations: list[str] = []
    while len(invitations) < count:
        invitations += researcher.invite(min(500, count - len(invitations)))
    with ThreadPoolExecutor(at_once) as pool:
        return Counter(pool.map(one, range(count), invitations))
