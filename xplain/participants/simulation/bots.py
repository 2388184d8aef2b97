"""Dry runs against a running server: ``study bots``, ``collect bots``.

Simulated participants come over HTTP, or each in a real browser, with invitations of the stream
"bot", which marks them in the data for ever. The plan that they need is read from the snapshot
that the server offers, so the server may run anywhere.
"""

from __future__ import annotations

import http.client
import io
import re
import sqlite3
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlencode, urlsplit

from xplain.errors import InputError
from xplain.participants.simulation import chromium
from xplain.participants.simulation.http_client import Browser, Page, Visitor, visit
from xplain.participants.stored import Plan, opened, plan_of


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
        self.browser.close()
        if status != 200:
            raise InputError("--key", key, "the researcher's key, which the server prints")
        self.token = Page(html).hidden["token"]

    def invite(self, count: int, stream_name: str = "bot") -> list[str]:
        """Makes ``count`` invitations of a stream; their tokens."""
        fields = [("token", self.token), ("count", str(count)), ("stream", stream_name)]
        _, html = self.browser.post("/researcher/invitations", fields)
        self.browser.close()
        return re.findall(r"\?invitation=([\w-]+)", html)

    def archive(self) -> bytes:
        """The export, as a ZIP archive."""
        parts = urlsplit(self.browser.url)
        connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=60)
        cookies = "; ".join(f"{k}={v}" for k, v in self.browser.cookies.items())
        headers = {"Cookie": cookies, "Content-Type": "application/x-www-form-urlencoded"}
        body = urlencode({"token": self.token})
        connection.request("POST", "/researcher/export", body, headers)
        content = connection.getresponse().read()
        connection.close()
        return content

    @contextmanager
    def snapshot(self) -> Iterator[sqlite3.Connection]:
        """A snapshot of the server's database, to be read."""
        with tempfile.TemporaryDirectory() as folder:
            with zipfile.ZipFile(io.BytesIO(self.archive())) as archive:
                path = Path(archive.extract("study/snapshot.sqlite", folder))
            with opened(path) as connection:
                yield connection

    def plan(self, kind: type[Plan]) -> Plan:
        """The plan, from a snapshot."""
        with self.snapshot() as connection:
            return plan_of(connection, kind)


def crowd(
    researcher: Researcher,
    count: int,
    at_once: int,
    pace: float,
    person_of: Callable[[int], Visitor],
    in_chromium: bool,
) -> Counter[str]:
    """Lets simulated people take part; how many ended at which stage.

    Args:
        researcher: makes the invitations.
        count: bots.
        at_once: how many of them at a time.
        pace: seconds of waiting a simulated second of thinking; 0 = none.
        person_of: the person with a number.
        in_chromium: each in a real browser instead of bare HTTP.
    """
    url = researcher.browser.url

    def think(seconds: float) -> None:
        time.sleep(pace * seconds)

    def one(number: int, invitation: str) -> str:
        person = person_of(number)
        if not in_chromium:
            return visit(Browser(url), person, invitation, think)
        with chromium.browser() as driver:
            chromium.go_in(driver, url, invitation)
            return chromium.take_part(driver, person, think)

    invitations: list[str] = []
    while len(invitations) < count:
        invitations += researcher.invite(min(500, count - len(invitations)))
    with ThreadPoolExecutor(at_once) as pool:
        return Counter(pool.map(one, range(count), invitations))
