"""Simulated people, in the bare flow and against a running server (``study bots``).

They come over HTTP, with invitations of the stream "bot", which marks them in the data for ever.
The plan that they need is read from the server's export, so the server may run anywhere.
"""

from __future__ import annotations

import io
import re
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Generic, TypeVar

import numpy as np
from werkzeug.datastructures import MultiDict

from xplain.errors import InputError, Probability
from xplain.people.analysis.stored import Plan
from xplain.people.flow import Fields, Flow, S
from xplain.people.plan import LabQuestion
from xplain.people.simulation.browser import Browser, Page, Visitor, visit
from xplain.randomness import below


@dataclass(frozen=True, kw_only=True)
class BotHabits:
    """Assumptions about people. None is measured.

    Attributes:
        mistake: probability of a wrong answer in a practice or a test.
        leaving: probability of leaving at each page.
    """

    mistake: Probability = 0.02
    leaving: Probability = 0.0


H = TypeVar("H", bound=BotHabits)
P = TypeVar("P")


class Bot(Generic[P, H]):
    """One simulated participant, who only uses what the pages tell.

    A stage's page is answered by the method of that name, which gives its fields and the seconds
    that they took; pages without one need no answer but the button. Each stage draws from a stream
    of its own, so that a page more changes nothing on the others.

    Args:
        plan: for the sentences and the true labels.
        habits: how they behave.
        rng: their stream.
    """

    def __init__(self, plan: P, habits: H, rng: np.random.Generator) -> None:
        self.plan, self.habits, self.rng = plan, habits, rng
        self.streams = cache(partial(below, rng))
        self.corrected: set[tuple[str, int]] = set()

    def chance(self, probability: float) -> bool:
        """Whether something of this probability happens."""
        return bool(self.rng.random() < probability)

    def leaves(self, page: Page) -> bool:
        """Whether this page is where they drop out."""
        self.rng = self.streams(page.stage)
        return self.chance(self.habits.leaving)

    def practises(self, page: Page, right: int) -> Fields:
        """The label of a practice step. Who errs is told so, and errs once."""
        errs = self.chance(self.habits.mistake) and (page.stage, right) not in self.corrected
        if errs:
            self.corrected.add((page.stage, right))
        return [("label", str(right ^ errs))]

    def asked(self, questions: tuple[LabQuestion, ...]) -> Fields:
        """What is right, else the first that is allowed, of questions that need an answer."""
        return [
            (q.name, q.right or (q.options or (str(q.low) if q.kind == "number" else "–",))[0])
            for q in questions
            if q.needed
        ]

    def fill(self, page: Page) -> tuple[Fields, float]:
        """The fields that they fill in on a page, and how long it took them, in seconds."""
        self.rng = self.streams(page.stage)
        answer = getattr(self, f"at_{page.stage}", lambda page: None)
        filled: tuple[Fields, float] | Fields = answer(page) or []
        return filled if isinstance(filled, tuple) else (filled, 0.0)

    def at_consent(self, page: Page) -> Fields:
        """Agrees."""
        return [("agree", "1")]

    def at_ahead(self, page: Page) -> Fields:
        """Sees what the step is good for."""
        return self.practises(page, 1)

    def at_questions(self, page: Page) -> Fields:
        """Says no more than is needed."""
        return self.asked(self.plan.asked)  # type: ignore[attr-defined]


def answer(flow: Flow[Any, S], bot: Bot[Any, Any], state: S) -> tuple[str, dict[str, Any]]:
    """Kind and payload of a bot's answer to the page of a state, in the bare flow."""
    kind, (filled, _) = flow.waits_for(state), bot.fill(Page.of_view(flow.view(state)))
    return kind, flow.read(state, kind, MultiDict(filled))


def take_part(flow: Flow[Any, S], bot: Bot[Any, Any], state: S) -> S:
    """A bot in the bare flow, from a state to the end or to where they leave."""
    while not state.over and not bot.leaves(Page.of_view(flow.view(state))):
        state = flow.advance(state, *answer(flow, bot, state))
    return state


class Researcher:
    """The researcher's page, used by a program.

    Args:
        url: of the server.
        key: that the server printed at its start.
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
        """Makes ``count`` invitations of a stream; their tokens."""
        fields = [("token", self.token), ("count", str(count)), ("stream", stream_name)]
        _, html = self.browser.post("/researcher/invitations", fields)
        return re.findall(r"\?invitation=([\w-]+)", html)

    def archive(self) -> bytes:
        """The export, as a ZIP archive."""
        url = f"{self.browser.url}/researcher/export"
        return self.browser.session.post(url, data={"token": self.token}, timeout=60).content

    def plan(self, kind: type[Plan]) -> Plan:
        """The plan, from the server's export."""
        with zipfile.ZipFile(io.BytesIO(self.archive())) as archive:
            return kind.from_text(archive.read("study/plan.json").decode())


def crowd(
    researcher: Researcher,
    count: int,
    at_once: int,
    pace: float,
    person_of: Callable[[int], Visitor],
) -> Counter[str]:
    """Lets simulated people take part; how many ended at which stage.

    Args:
        researcher: makes the invitations.
        count: bots.
        at_once: how many of them at a time.
        pace: seconds of waiting a simulated second of thinking; 0 = none.
        person_of: the person with a number.
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
