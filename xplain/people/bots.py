"""Simulated people, who use a running server (``study bots``).

Bots use HTTP and invitations for bots, so their data is always marked. They read the plan from the
server's export, so the server may run anywhere.
"""

from __future__ import annotations

import html
import io
import re
import ssl
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from http.client import HTTPException
from http.cookiejar import CookieJar, DefaultCookiePolicy
from typing import Any, Generic, TypeVar
from urllib import request
from urllib.error import HTTPError
from urllib.parse import urlencode, urljoin

import numpy as np
from markupsafe import Markup

from xplain.errors import InputError, Probability
from xplain.people.flow import Fields
from xplain.people.log import Plan
from xplain.randomness import below

WIDTH = {"width": "1280"}
"""Width of a bot's window, in CSS pixels, for the consent's field that a browser's script fills."""
_INPUT = re.compile(r"<input ([^>]*)>([^<]*)")
_ATTRIBUTE = re.compile(r'([\w-]+)="([^"]*)"')
_UNREAD = re.compile(r'<svg.*?</svg>|<span class="tag">.*?</span>', re.DOTALL)
"""Letters in pictures, and the tags of new messages."""


def _read_text(content: str) -> str:
    return Markup(_UNREAD.sub("", content)).striptags()


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
    """

    stage: str
    facts: Sequence[str] = ()
    messages: Sequence[str] = ()
    new: Sequence[str] = ()
    fields: Mapping[str, Sequence[tuple[Any, str]]] = field(default_factory=dict)
    steps: Sequence[int] = ()
    hidden: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of_html(cls, text: str) -> Page:
        """Reads the main part of a page from its HTML. The templates of this package wrote the
        page, so patterns suffice."""
        main = text.partition("<main ")[2].partition("</main>")[0]
        fields, hidden = dict[str, list[tuple[str, str]]](), dict[str, str]()
        for tag, after in _INPUT.findall(main):
            about = {name: html.unescape(value) for name, value in _ATTRIBUTE.findall(tag)}
            name, value = about["name"], about.get("value", "")
            if about.get("type") in ("radio", "checkbox"):
                fields.setdefault(name, []).append((value, _read_text(after)))
            elif about.get("type") == "hidden":
                hidden[name] = value or WIDTH.get(name, "")
        facts = re.findall(r'<ul class="[^"]*\bfacts">(.*?)</ul>', main, re.DOTALL)
        messages = re.findall(r'<div class="message( new)?">(.*?)</div>', main, re.DOTALL)
        return cls(
            stage="".join(re.findall(r'<body [^>]*data-stage="(\w+)"', text)),
            facts=[*map(_read_text, re.findall("<li.*?</li>", "".join(facts), re.DOTALL))],
            messages=[_read_text(said) for _, said in messages],
            new=[_read_text(said) for new, said in messages if new],
            fields=fields,
            steps=[int(step) for step in re.findall(r'data-step="(\d+)"', main)],
            hidden=hidden,
        )


def make_client() -> request.OpenerDirector:
    """Makes an HTTP client with cookies. It ignores the proxies of the environment, and trusts the
    certificate authorities of the system, or those in the file SSL_CERT_FILE. It sends cookies of
    https also over http, to servers behind an https proxy."""
    cookies = CookieJar(DefaultCookiePolicy(secure_protocols=("http", "https")))
    secure = request.HTTPSHandler(context=ssl.create_default_context())
    return request.build_opener(
        request.ProxyHandler({}), secure, request.HTTPCookieProcessor(cookies)
    )


@dataclass
class Browser:
    """A browser without scripts that tries again while the server is unavailable.

    Attributes:
        url: address of the server.
        patience: seconds to try.
        client: sends the requests and keeps the cookies.
    """

    url: str
    patience: float = 30.0
    client: request.OpenerDirector = field(default_factory=make_client)

    def get(self, path: str) -> tuple[int, str]:
        """Requests a page and follows redirects. Returns its status and text, as :meth:`post`."""
        return self.post(path, None)

    def post(self, path: str, fields: Fields | None) -> tuple[int, str]:
        """Sends a form, or requests a page if ``fields`` is None, and follows redirects.

        Raises:
            ConnectionError: the server was unavailable for longer than ``patience``.
        """
        until = time.monotonic() + self.patience
        while True:
            late = time.monotonic() > until
            try:
                status, content = self.send(path, fields)
            except (OSError, HTTPException, ValueError) as error:  # ValueError: no URL
                if late:
                    raise ConnectionError(str(error)) from None
            else:
                if late or status not in (429, 500, 502):
                    return status, content.decode(errors="replace")
            time.sleep(0.2)

    def send(self, path: str, fields: Fields | None = None) -> tuple[int, bytes]:
        """Sends one request, and returns the status and content of the last reply."""
        data = None if fields is None else urlencode(fields).encode()
        try:
            reply = self.client.open(self.url + path, data, timeout=60)
        except HTTPError as error:
            reply = error
        with reply:
            return reply.status, reply.read()


def walk(
    page: Page,
    answer: Callable[[Page, Fields], Page],
    person: Bot[Any, Any],
    think: Callable[[float], None] = lambda seconds: None,
) -> str:
    """Answers all pages from an open page to the end of the flow.

    Args:
        page: the open page.
        answer: sends the fields of a page and returns the next page.
        person: the simulated person who answers.
        think: is called before each answer, with the seconds that a person would take.

    Returns:
        The last stage, or "left" after a drop-out.
    """
    while page.hidden:
        if person.leaves(page):
            return "left"
        fields, seconds = person.fill(page)
        think(seconds)
        page = answer(page, fields)
    return page.stage


class Refusal(Exception):
    """The server did not accept an answer. Arguments: the HTTP status, and the page's stage
    (``entrance``: the server did not admit the person)."""


def visit(
    browser: Browser,
    person: Bot[Any, Any],
    invitation: str,
    think: Callable[[float], None] = lambda seconds: None,
) -> str:
    """Opens an invitation, and answers all pages to the end (:func:`walk`).

    Raises:
        Refusal: an answer was not accepted.
        ConnectionError: the server was unavailable for longer than the browser's ``patience``.
    """

    def answer(page: Page, fields: Fields) -> Page:
        path = "/study" if page.stage else "/enter"
        status, html = browser.post(path, [*page.hidden.items(), *fields])
        if status >= 400:
            raise Refusal(status, page.stage or "entrance")
        return Page.of_html(html)

    entrance = Page.of_html(browser.get(f"/?invitation={invitation}")[1])
    return walk(answer(entrance, [("invitation", invitation)]), answer, person, think)


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


class Bot(Generic[Plan, H]):
    """One simulated participant, who knows only what the pages say.

    The method ``at_<stage>`` answers a stage's page: it returns the fields, or the fields and the
    duration in seconds. Other pages need only a click, or answers to the lab's own questions. Each
    stage draws from its own random stream, so an additional page does not change other pages.

    Args:
        plan: has the sentences and the true labels.
        habits: the assumed behaviour.
        rng: random stream.

    Attributes:
        told: sentences of the briefing so far.
        role: index of the role whose briefing the participant read.
        known: bitmask of the facts that the participant learned from messages.
    """

    def __init__(self, plan: Plan, habits: H, rng: np.random.Generator) -> None:
        self.plan, self.habits, self.rng = plan, habits, rng
        self.streams = cache(partial(below, rng))
        self.corrected: set[tuple[str, int]] = set()
        self.told: set[str] = set()
        self.role = 0
        self.known = 0

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return bool(self.rng.random() < probability)

    def leaves(self, page: Page) -> bool:
        """True if the participant drops out at this page."""
        self.rng = self.streams(page.stage)
        return self.chance(self.habits.leaving)

    def at_practice(self, page: Page) -> Fields:
        """Answers that the step makes sense only if the page gives the message; a step that needs
        thinking ahead makes sense. The page reports a wrong label, so a bot errs at most once."""
        message = " ".join(self.plan.example.message.split())  # as a browser shows it
        right = int(page.stage == "ahead" or message in page.messages)
        errs = self.chance(self.habits.mistake) and (page.stage, right) not in self.corrected
        if errs:
            self.corrected.add((page.stage, right))
        return [("label", str(right ^ errs))]

    at_ahead = at_practice

    def go_on(self, page: Page) -> Fields:
        """Answers each required question of the lab: with the right answer if there is one,
        otherwise with the first allowed answer."""
        asked = {"before": self.plan.before, "questions": self.plan.asked}.get(page.stage, ())
        return [
            (q.field, q.right or (q.options or (str(q.low) if q.kind == "number" else "–",))[0])
            for q in asked
            if q.needed
        ]

    def at_consent(self, page: Page) -> Fields:
        """Agrees to take part."""
        return [("agree", "1")]

    def learn(self, page: Page, briefings: Sequence[Sequence[str]]) -> None:
        """Learns the facts of a briefing, if there is one, and finds the role with these facts."""
        self.told |= {*page.facts}
        if page.facts:
            self.role = next(i for i, told in enumerate(briefings) if self.told <= {*told})

    def fill(self, page: Page) -> tuple[Fields, float]:
        """Fills in a page. Returns the fields and the time that it took, in seconds."""
        self.rng = self.streams(page.stage)
        answer = getattr(self, f"at_{page.stage}", self.go_on)
        filled: tuple[Fields, float] | Fields = answer(page) or []
        return filled if isinstance(filled, tuple) else (filled, 0.0)


class Researcher:
    """A program's access to the researcher's page.

    Args:
        url: address of the server.
        key: key that the server printed at its start.
    """

    def __init__(self, url: str, key: str) -> None:
        self.browser = Browser(url.rstrip("/"), patience=2)
        try:
            status, html = self.browser.post("/researcher/login", [("key", key)])
        except ConnectionError as error:
            raise InputError("--url", url, f"a running study server ({error})") from None
        self.token = Page.of_html(html).hidden.get("token", "")
        if status != 200 or not self.token:
            raise InputError("--key", key, "the researcher's key, which the server prints")
        # Cookies are below the path of the server's address, which all forms have.
        path = html.partition('/researcher/invitations"')[0].rpartition('"')[2]
        self.browser.url = urljoin(self.browser.url, path)

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
        return self.browser.send("/researcher/export", [("token", self.token)])[1]

    def plan(self, kind: type[Plan]) -> Plan:
        """Reads the plan in the server's export."""
        with zipfile.ZipFile(io.BytesIO(self.archive())) as archive:
            return kind.from_text(archive.read("study/plan.json").decode())


def crowd(
    researcher: Researcher,
    count: int,
    at_once: int,
    pace: float,
    person_of: Callable[[int], Bot[Any, Any]],
) -> Counter[str]:
    """Runs simulated people. Returns the number that ended at each stage.

    Args:
        researcher: creates the invitations.
        count: number of bots.
        at_once: maximum number of bots at the same time.
        pace: seconds to wait for each simulated second of thinking; 0 = no waiting.
        person_of: makes the simulated person from the bot's number, 0 … count − 1.
    """

    def one(number: int, invitation: str) -> str:
        browser, person = Browser(researcher.browser.url), person_of(number)
        return visit(browser, person, invitation, lambda seconds: time.sleep(pace * seconds))

    invitations: list[str] = []
    while len(invitations) < count:
        invitations += researcher.invite(min(500, count - len(invitations)))
    with ThreadPoolExecutor(at_once) as pool:
        return Counter(pool.map(one, range(count), invitations))
