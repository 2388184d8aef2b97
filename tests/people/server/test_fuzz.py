"""Thousands of hostile requests on every route: a clear page or a 4xx, and the data unharmed."""

import http.client
import json
import socket
from collections import Counter
from collections.abc import Callable
from typing import Any
from urllib.parse import quote, urlencode, urlsplit

import numpy as np
import pytest

from tests.people.server_process import running
from tests.people.street import bot_of, flow_of
from tests.people.visitors import (
    GENEROUS,
    Client,
    Opened,
    differences,
    newcomer,
    pages,
    query,
)
from xplain.people.store import Store
from xplain.people.web import create_app

Send = Callable[[str, str, dict[str, str], bytes], int]
ROUTES = (
    *("/", "/enter", "/study", "/events", "/alive", "/researcher", "/researcher/login"),
    *("/researcher/invitations", "/researcher/export", "/static/study.js", "/static/../app.py"),
    *(
        "/picture/0",
        "/picture/%2e%2e",
        "/static/%2e%2e/schema.sql",
        "/nowhere",
        "//",
        "/study/",
        "/%00",
        "/study;x=1",
    ),
)
METHODS = ("GET", "POST", "POST", "POST", "POST", "PUT", "DELETE", "HEAD", "OPTIONS", "PATCH")
KINDS = (
    "application/x-www-form-urlencoded",
    "application/x-www-form-urlencoded",
    "application/x-www-form-urlencoded; charset=utf-7",
    "application/json",
    "multipart/form-data; boundary=b",
    "multipart/form-data",
    "text/xml",
    "",
)
NAMES = (
    *(
        "token",
        "sequence",
        "kind",
        "agree",
        "text",
        "label",
        "ms",
        "true",
        "answer_age",
        "answer_comment",
    ),
    *("label_0", "label_1", "label_2", "label_3", "q0", "q1", "q2", "q3", "invitation", "count"),
    *("PROLIFIC_PID", "STUDY_ID", "SESSION_ID", "stream", "key", "user_type", "condition"),
    *("orders", "labels", "answers", "chosen", "tab", "items", "belief", "__class__", "a[b]"),
    *("fact_0", "fact_1", "fact_2", "fact_3", "stated", "others", "role"),
)
EVENTS = (
    *("consent", "read", "example", "ahead", "eligibility", "labels", "labels", "quiz", "beliefs"),
    *("answers", "withdraw"),
)


class Fuzzer:
    """Draws requests; some of them nearly right.

    Args:
        rng: its stream.
        cookies: cookies of the attacker's own participants, with their forms' tokens.
        mark: a text in the cookie's name.
    """

    def __init__(self, rng: np.random.Generator, cookies: list[tuple[str, str]], mark: str) -> None:
        self.rng, self.cookies, self.mark = rng, cookies, mark

    def pick(self, choices: Any) -> Any:
        return choices[int(self.rng.integers(len(choices)))]

    def value(self) -> str:
        """Draws a text: plausible, hostile or random."""
        draws: tuple[Callable[[], str], ...] = (
            lambda: str(self.rng.integers(-2, 30)),
            lambda: "<script>alert(1)</script>",
            lambda: "' OR 1=1; DROP TABLE event; --",
            lambda: "{{7*7}}${7*7}%s%n../../etc/passwd",
            lambda: "\x00\r\nSet-Cookie: participant=x\u202e\ud800".encode(
                errors="replace"
            ).decode(),
            lambda: self.rng.bytes(int(self.rng.integers(40))).decode("latin-1"),
            lambda: "9" * int(self.rng.integers(1, 5000)),
            lambda: self.pick(EVENTS),
            lambda: self.pick(("NaN", "-0", "1e999", "٣", "0x10", " 1", "1 ", "+1", "true", "[]")),
            lambda: "ü" * int(self.rng.integers(300)),
        )
        return str(self.pick(draws)())

    def json(self, depth: int = 0) -> Any:
        if depth > 3 or self.rng.random() < 0.4:
            return self.pick((None, True, -1, 0, 1e308, 10**30, self.value(), [], {}, self.value()))
        if self.rng.random() < 0.5:
            return [self.json(depth + 1) for _ in range(int(self.rng.integers(4)))]
        return {self.pick(NAMES): self.json(depth + 1) for _ in range(int(self.rng.integers(5)))}

    def request(self) -> tuple[str, str, dict[str, str], bytes]:
        """Draws method, path, headers and body."""
        method, path, kind = self.pick(METHODS), self.pick(ROUTES), self.pick(KINDS)
        cookie, token = self.pick(self.cookies)
        near = self.rng.random()
        fields = [(self.pick(NAMES), self.value()) for _ in range(int(self.rng.integers(6)))]
        if near < 0.5:  # the right place, the right token, then nonsense
            fields = [("token", token), ("sequence", str(self.rng.integers(12))), *fields]
            fields += [("kind", self.pick(EVENTS))]
            method, path = "POST", self.pick(("/study", "/events", "/enter", "/study"))
        body: bytes
        if "json" in kind or path == "/events":
            value = self.json()
            if isinstance(value, dict) and near < 0.5:
                item = {"n": self.json(3), "kind": "visible", "ms": self.json(3), "at": 5}
                value |= {"token": token, "tab": "0123456789abcdef", "items": [item]}
            body = json.dumps(value).encode()
        elif "multipart" in kind:
            parts = [
                f'--b\r\nContent-Disposition: form-data; name="{n}"; filename="{v[:9]}"\r\n\r\n{v}'
                for n, v in fields
            ]
            body = "\r\n".join(parts).encode(errors="replace") + b"\r\n--b--"
        else:
            body = urlencode(fields, errors="replace").encode()
        if self.rng.random() < 0.1:
            body = self.rng.bytes(int(self.rng.integers(3000)))
        if self.rng.random() < 0.01:
            body = b"a=" + b"x" * 200_000
        query = quote(self.value(), errors="replace") if self.rng.random() < 0.4 else ""
        headers = {"Content-Type": kind} if kind else {}
        held = self.pick((cookie, cookie, cookie, cookie[:-1] + "0", "x", cookie.split(".")[0]))
        headers["Cookie"] = f"study_{self.mark}={held}"
        if self.rng.random() < 0.1:
            headers["X-Forwarded-For"] = self.pick(("127.0.0.1", "x" * 300, "1.1.1.1, 2.2.2.2"))
        return method, path + (f"?{query}={query}" if query else ""), headers, body


def prey(store: Store) -> tuple[list[tuple[str, str]], list[str]]:
    """Makes participants at every stage; half of them are the attacker's."""
    owned, others = [], []
    for number in range(20):
        (invitation,) = store.invite(1, "bot")
        visitor = newcomer(store)
        way = pages(visitor, bot_of(store.flow, number), invitation)
        for index, (_, page) in enumerate(way):
            if index >= number // 2 or not page.hidden:
                break
        who = store.enter_invited(invitation)
        if number % 2:
            others.append(who)
        else:
            cookie, _ = visitor.client.cookies[f"study_{store.mark}"]
            owned.append((cookie, store.hash_texts("form", who)))
    return owned, others


def records(store: Store, who: list[str]) -> dict[str, Any]:
    """Returns everything that is stored about some participants."""
    return {one: [*store.events("participant = ?", one)] for one in who}


def attack(store: Store, send: Send, count: int, seed: int) -> Counter[int]:
    """Sends requests, and counts the answers by status. Checks that nobody else's data changed,
    that the file is valid, and that every answer was allowed."""
    cookies, others = prey(store)
    fuzzer = Fuzzer(np.random.default_rng(seed), cookies, store.mark)
    before, statuses = records(store, others), Counter[int]()
    for _ in range(count):
        request = fuzzer.request()
        status = send(*request)
        assert status < 500, f"{status} for {request}"
        statuses[status] += 1
    assert records(store, others) == before
    assert query(store, "PRAGMA integrity_check") == [{"integrity_check": "ok"}]
    assert differences(store) == []
    return statuses


@pytest.mark.parametrize(
    ("kind", "count"),
    [("study", 500), ("collect", 250), pytest.param("collect", 10_000, marks=pytest.mark.slow)],
)
def test_hostile_requests_harm_nothing(opened: Opened, kind: str, count: int) -> None:
    store = opened(flow_of(kind))
    client = Client(create_app(store, GENEROUS), cookies=False)

    def send(method: str, path: str, headers: dict[str, str], body: bytes) -> int:
        reply = client.open(path, method=method, headers=headers, data=body)
        assert b"Traceback" not in reply.data
        assert b"<script>alert" not in reply.data
        return reply.status_code

    assert {200, 400, 403, 404, 405} <= attack(store, send, count, 0).keys()


@pytest.mark.slow
def test_ten_thousand_hostile_requests_to_the_real_server(
    store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    with running(create_app(store, GENEROUS)) as url:
        at, garbage = urlsplit(url), np.random.default_rng(5)
        connection = http.client.HTTPConnection(at.netloc, timeout=5)

        def send(method: str, target: str, headers: dict[str, str], body: bytes) -> int:
            try:
                connection.request(method, target, body, headers)
                reply = connection.getresponse()
                reply.read()
            except (ConnectionError, http.client.HTTPException):
                # The server may hang up on what it will not read to the end; it never hangs.
                connection.close()
                return 499
            return reply.status

        statuses = attack(store, send, 10_000, 1)
        for _ in range(200):  # what is no HTTP at all
            with socket.create_connection((at.hostname, at.port), timeout=10) as raw:
                raw.sendall(garbage.bytes(int(garbage.integers(1, 2000))) + b"\r\n\r\n")
        assert send("GET", "/alive", {}, b"") == 200
        connection.close()
    assert "Traceback" not in caplog.text
    assert statuses[499] < 300
