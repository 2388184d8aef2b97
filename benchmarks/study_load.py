"""Measures the server of a study or a collection under load: many participants at once, on this
machine.

    python benchmarks/study_load.py            200 participants, thinking 2 to 10 s between pages
    python benchmarks/study_load.py --quick    2 participants, thinking 0.3 to 0.8 s
    python benchmarks/study_load.py --slow 50  beside 50 connections that send a byte a second
    python benchmarks/study_load.py --protocol collect    20 adaptive questions about rescue each

Prints percentiles of the time that a page takes, from the click to the last byte of the next page
(the answer is stored, then the page is rendered), and of single requests. The exit code is 1 after
any error. The participants run in this process, on the same machine.
"""

import argparse
import http.client
import json
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib import request

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))

from tests.people.server_process import ServerProcess
from xplain.experiment.config import compose_config
from xplain.people.bots import Bot, Browser, Page, Researcher
from xplain.people.collect.bot import Habits as Answers
from xplain.people.collect.bot import bot
from xplain.people.collect.flow import Collection
from xplain.people.collect.prepare import collect_plan
from xplain.people.flow import Flow
from xplain.people.store import Store
from xplain.people.study.bot import Habits, StudyBot
from xplain.people.study.flow import Study
from xplain.people.study.prepare import study_plan

Times = list[float]


class TimedHandler(request.HTTPHandler):
    """Sends requests, and records the seconds until the reply and the status of each."""

    handler_order = 400
    """Less than that of the default handler, so this handler is used."""

    def __init__(self) -> None:
        super().__init__()
        self.timings: list[tuple[float, int]] = []

    def http_open(self, req: request.Request) -> http.client.HTTPResponse:
        """Sends one request."""
        start = time.perf_counter()
        reply = super().http_open(req)
        self.timings.append((time.perf_counter() - start, reply.status))
        return reply


class Participant(threading.Thread):
    """A participant who enters, thinks and answers, loads the page's files, and sends the reports
    of a page with scripts."""

    def __init__(
        self,
        url: str,
        person: Bot[Any, Any],
        invitation: str,
        number: int,
        wait: float,
        think: tuple[float, float],
    ) -> None:
        super().__init__(daemon=True)
        self.browser, self.timed = Browser(url, patience=0), TimedHandler()
        self.browser.client.add_handler(self.timed)
        self.person = person
        self.rng = np.random.default_rng([number, 1])
        self.invitation, self.wait, self.think = invitation, wait, think
        self.pages: Times = []
        self.error = ""

    def run(self) -> None:
        """Takes part in the whole study; an error ends it and is stored."""
        time.sleep(self.wait)
        try:
            self._take_part()
        except (OSError, http.client.HTTPException, AssertionError, KeyError) as error:
            self.error = f"{type(error).__name__}: {error}"

    def _take_part(self) -> None:
        _, html = self._request_page("GET", f"/?invitation={self.invitation}", [])
        for file in ("study.css", "study.js", "robot.svg"):
            self.browser.get(f"/static/{file}")
        fields = [*Page.of_html(html).hidden.items(), ("invitation", self.invitation)]
        status, html = self._request_page("POST", "/enter", fields)
        number = 0
        while (page := Page.of_html(html)).hidden:
            self._send_report(page, number)
            number += 1
            time.sleep(self.rng.uniform(*self.think))
            fields = [*page.hidden.items(), *self.person.fill(page)[0]]
            status, html = self._request_page("POST", "/study", fields)
            assert status == 200, f"{status} at {page.stage}"
        assert page.stage == "done", page.stage

    def _request_page(
        self, method: str, path: str, fields: list[tuple[str, str]]
    ) -> tuple[int, str]:
        start = time.perf_counter()
        answer = self.browser.get(path) if method == "GET" else self.browser.post(path, fields)
        self.pages.append(time.perf_counter() - start)
        return answer

    def _send_report(self, page: Page, number: int) -> None:
        items = [{"n": number, "kind": "visible", "ms": 5.0, "at": 5.0, "what": page.stage}]
        body = {"token": page.hidden["token"], "tab": "0123456789abcdef", "items": items}
        self.browser.client.open(f"{self.browser.url}/events", json.dumps(body).encode()).close()


def percentiles(times: Times) -> str:
    """Formats the median, 95 %, 99 % and maximum, in milliseconds."""
    marks = np.percentile(times, [50, 95, 99, 100]) * 1000
    return "  ".join(
        f"{name} {mark:.0f} ms"
        for name, mark in zip(("p50", "p95", "p99", "max"), marks, strict=True)
    )


class Slow(threading.Thread):
    """Connections that never finish a request: each sends one byte of its header per second."""

    def __init__(self, port: int, count: int) -> None:
        super().__init__(daemon=True)
        self.port, self.count, self.ended = port, count, threading.Event()

    def run(self) -> None:
        """Runs until :attr:`ended`; replaces connections that the server closes."""
        held: list[socket.socket] = []
        while not self.ended.wait(1.0):
            while len(held) < self.count:
                held.append(socket.create_connection(("127.0.0.1", self.port), timeout=10))
                held[-1].sendall(b"POST /study HTTP/1.1\r\nHost: x\r\nX-A: ")
            for one in list(held):
                try:
                    one.sendall(b"a")
                except OSError:
                    held.remove(one)
        for one in held:
            one.close()


def study() -> tuple[Flow[Any, Any], Callable[[int], Bot[Any, Any]]]:
    """Makes the shipped study and its people."""
    small = ["seed=0", "observers.points=150", "trace.candidates=40"]
    plan = study_plan(compose_config("study", small))
    habits = Habits(0, 0, 0, 0, mistake=0)
    rng = np.random.default_rng
    return Study.of(plan), lambda number: StudyBot(plan, habits, rng(number))


def collect() -> tuple[Flow[Any, Any], Callable[[int], Bot[Any, Any]]]:
    """Makes a collection about rescue with adaptive questions, and its people."""
    plan = collect_plan(compose_config("collect", ["rules.people=6"]))
    habits = Answers(error=0.05, mistake=0)
    return Collection.of(plan), lambda number: bot(plan, habits, 0, number)


def stolen() -> tuple[int, int]:
    """Returns the processor time that other machines took from this one, and all time, since its
    start; (0, 0) if the system does not report them."""
    try:
        numbers = [int(x) for x in Path("/proc/stat").read_text().split("\n")[0].split()[1:]]
    except OSError:
        return 0, 0
    return numbers[7], sum(numbers)


def measure(command: str, people: int, think: tuple[float, float], ramp: float, slow: int) -> int:
    """Runs the load and prints the results. Returns the number of participants with an error."""
    protocol, person = {"study": study, "collect": collect}[command]()
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "study.sqlite"
        Store(database, protocol).close()
        # The server has its default limits.
        with ServerProcess(database, command=command) as server:
            invitations = Researcher(server.url, server.key).invite(people)
            rng = np.random.default_rng(0)
            crowd = [
                Participant(server.url, person(number), token, number, rng.uniform(0, ramp), think)
                for number, token in enumerate(invitations)
            ]
            beside = Slow(server.port, slow)
            if slow:
                beside.start()
            start, before = time.perf_counter(), stolen()
            for one in crowd:
                one.start()
            for one in crowd:
                one.join()
            took, after = time.perf_counter() - start, stolen()
            beside.ended.set()
    pages = [t for one in crowd for t in one.pages]
    requests = [t for one in crowd for t, _ in one.timed.timings]
    errors = [one.error for one in crowd if one.error]
    errors += [str(s) for one in crowd for _, s in one.timed.timings if s >= 400]
    print(
        f"{command}: {people} participants at once, thinking {think[0]:g} to {think[1]:g} s, "
        f"{took:.0f} s{f', beside {slow} slow connections' if slow else ''}"
    )
    if after[1] > before[1]:
        share = (after[0] - before[0]) / (after[1] - before[1])
        print(f"{share:.0%} of the processors' time went to other machines")
    print(f"{len(pages):6d} pages     {percentiles(pages)}")
    print(f"{len(requests):6d} requests  {percentiles(requests)}  ({len(requests) / took:.0f} /s)")
    print(f"{len(errors):6d} errors    {'; '.join(sorted(set(errors))[:5])}")
    return len(errors)


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--people", type=int, default=200)
    parser.add_argument("--slow", type=int, default=0)
    parser.add_argument("--protocol", choices=["study", "collect"], default="study")
    given = parser.parse_args()
    people, think, ramp = given.people, (2.0, 10.0), 8.0
    if given.quick:
        people, think, ramp = 2, (0.3, 0.8), 0.5
    sys.exit(measure(given.protocol, people, think, ramp, given.slow) > 0)


if __name__ == "__main__":
    main()
