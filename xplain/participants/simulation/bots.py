"""Dry runs against a running server: ``study bots key=… count=40``.

Simulated participants come over HTTP, or each in a real browser, with invitations of the stream
"bot", which marks them in the data for ever. The plan that they need is read from the snapshot
that the server offers, so the server may run anywhere.
"""

from __future__ import annotations

import argparse
import http.client
import io
import re
import tempfile
import time
import zipfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import urlencode, urlsplit

from xplain.errors import InputError, XplainError
from xplain.participants.simulation import chromium
from xplain.participants.simulation.http_client import Browser, Page, visit
from xplain.randomness import stream
from xplain.study.protocol.plan import StudyPlan
from xplain.study.settings import one_clear_line
from xplain.study.simulation.participant import Habits, Person
from xplain.study.stored import opened, plan_of


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

    def plan(self) -> StudyPlan:
        """The study's plan, from a snapshot."""
        with tempfile.TemporaryDirectory() as folder:
            with zipfile.ZipFile(io.BytesIO(self.archive())) as archive:
                path = Path(archive.extract("study/snapshot.sqlite", folder))
            with opened(path) as connection:
                return plan_of(connection)


def run(
    url: str,
    key: str,
    count: int,
    at_once: int,
    pace: float,
    habits: Habits,
    seed: int,
    in_chromium: bool,
) -> Counter[str]:
    """Lets bots take part; how many ended at which stage.

    Args:
        url, key: of the server.
        count: bots.
        at_once: how many of them at a time.
        pace: seconds of waiting a simulated second of thinking; 0 = none.
        habits: of all.
        seed: of their streams.
        in_chromium: each in a real browser instead of bare HTTP.
    """
    researcher = Researcher(url, key)
    plan = researcher.plan()

    def think(seconds: float) -> None:
        time.sleep(pace * seconds)

    def one(number: int, invitation: str) -> str:
        person = Person(plan, habits, stream(seed, "bots", number))
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


def main(arguments: list[str] | None = None) -> None:
    """Parses the command's arguments, lets bots take part, prints how many ended where."""
    parser = argparse.ArgumentParser(
        prog="python -m xplain.participants.simulation.bots",
        description="Lets simulated participants take part in a running study, over HTTP. They "
        "are marked as bots in the data for ever, and take nobody's place.",
    )
    parser.add_argument("--url", default="http://127.0.0.1:8080", help="of the server")
    parser.add_argument("--key", required=True, help="the researcher's key")
    parser.add_argument("--count", type=int, default=40, help="bots (default 40)")
    parser.add_argument("--at-once", type=int, default=8, help="at a time (default 8)")
    parser.add_argument("--pace", type=float, default=0.0, help="1 = in real time; default 0")
    parser.add_argument("--leaving", type=float, default=0.0, help="chance to leave, a page")
    parser.add_argument("--chromium", action="store_true", help="each in a real browser")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", type=Path, help="where to put the export (ZIP) afterwards")
    given = parser.parse_args(arguments)
    with one_clear_line():
        for name, value in (("--count", given.count), ("--at-once", given.at_once)):
            if not 0 < value <= 10_000:
                raise InputError(name, value, "a whole number from 1 to 10000")
        if given.chromium and (what := chromium.missing()):
            raise InputError("--chromium", "not here", f"install {what}")
        habits = Habits(leaving=given.leaving)
        try:
            stages = run(
                given.url,
                given.key,
                given.count,
                given.at_once,
                given.pace,
                habits,
                given.seed,
                given.chromium,
            )
            if given.save:
                given.save.write_bytes(Researcher(given.url, given.key).archive())
        except (ConnectionError, TimeoutError) as error:
            raise XplainError(f"--url={given.url}: the server went away ({error})") from None
        print(", ".join(f"{number} {stage}" for stage, number in stages.most_common()))


if __name__ == "__main__":
    main()
