"""Kills the server with -9 while people take part: no acknowledged answer may be lost or stored
twice."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from tests.people.server_process import ServerProcess
from tests.people.visitors import query
from xplain.errors import InputError
from xplain.people.bots import Browser, Page, Researcher, Visitor
from xplain.people.store import Store

RATE = (
    *("server.requests_per_second=1e6", "server.burst=1e6", "server.visitor_burst=1e6"),
    "server.blinded=false",
)


class Careful:
    """A participant who records every answer that the server acknowledged."""

    def __init__(self, url: str, person: Visitor, invitation: str) -> None:
        self.browser = Browser(url, patience=90)
        self.person, self.invitation = person, invitation
        self.acknowledged: list[int] = []

    def take_part(self) -> str:
        """Takes part to the end, however often the server dies; this loop sends unacknowledged
        answers again."""
        _, html = self.browser.get(f"/?invitation={self.invitation}")
        fields = [*Page.of_html(html).hidden.items(), ("invitation", self.invitation)]
        page = Page.of_html(self.browser.post("/enter", fields)[1])
        while page.hidden:
            time.sleep(0.1)
            answer = [*page.hidden.items(), *self.person.fill(page)[0]]
            status, html = self.browser.post("/study", answer)
            assert status == 200, html
            self.acknowledged.append(int(page.hidden["sequence"]))
            page = Page.of_html(html)
        return page.stage


def survive(
    database: Path,
    flow: Any,
    command: str,
    person: Callable[[int, int], Visitor],
    kills: int,
    people: int,
) -> tuple[int, int]:
    """Kills the server while people answer, and compares stored with acknowledged answers.

    Args:
        database: a database with a plan.
        flow: the flow of the plan, as the server runs it.
        command: ``study`` or ``collect``.
        person: makes the i-th person of place j.
        kills: number of kills of the server.
        people: number of people at a time.

    Returns:
        The numbers of acknowledged and of stored answers.
    """
    server = ServerProcess(database, *RATE, command=command)
    server.start()
    ended = threading.Event()

    def parade(place: int) -> list[Careful]:
        """Sends one person after another, until the last kill."""
        own: list[Careful] = []
        while not ended.is_set():
            visitor = Careful(server.url, person(len(own), place), invitations[place].pop())
            assert visitor.take_part() == "done"
            own.append(visitor)
        return own

    def watch() -> int:
        """Opens the researcher's page again and again; returns the number of received pages."""
        seen = 0
        while not ended.is_set():
            try:
                watching = Researcher(server.url, server.key).browser  # logins end with the server
                status, html = watching.get("/researcher")
                seen += status == 200 and "</table>" in html
            except (InputError, OSError):
                pass  # the server is away
            time.sleep(0.5)
        return seen

    researcher = Researcher(server.url, server.key)
    invitations = [researcher.invite(100) for _ in range(people)]
    with ThreadPoolExecutor(people + 1) as pool:
        futures = [pool.submit(parade, place) for place in range(people)]
        watched = pool.submit(watch)
        pause = np.random.default_rng(0)
        for _ in range(kills):
            time.sleep(0.4 + pause.random())
            server.kill()
            server.start()
        ended.set()
        assert watched.result() > 0
        visitors = [visitor for future in futures for visitor in future.result()]
    server.stop()
    return _compare(Store(database, flow), visitors)


def _compare(store: Store, visitors: list[Careful]) -> tuple[int, int]:
    stored = 0
    for visitor in visitors:
        who = store.enter_invited(visitor.invitation)
        rows = query(
            store,
            "SELECT source_sequence AS n FROM event WHERE participant = ? AND "
            "source = 'protocol' ORDER BY sequence",
            (who,),
        )
        numbers = [row["n"] for row in rows]
        assert numbers == list(range(len(rows)))  # none lost, none doubled
        # Everybody saw every page once, in order: they went on where they were.
        assert visitor.acknowledged == sorted(set(visitor.acknowledged))
        assert set(visitor.acknowledged) <= set(numbers)
        assert store.participant(who).state.stage == "done"
        stored += len(rows)
    assert query(store, "PRAGMA integrity_check") == [{"integrity_check": "ok"}]
    store.close()
    return sum(len(visitor.acknowledged) for visitor in visitors), stored
