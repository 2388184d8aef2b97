"""Checks of every request: limits, headers, and errors as pages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.people.client import Client
from tests.people.visitors import Visitor, enter, field, query
from xplain.people.server import GUESSES, Keys, Server
from xplain.people.store import Store
from xplain.people.study.flow import Study
from xplain.people.web import create_app


def test_headers_keep_browsers_strict(client: Client, store: Store) -> None:
    for path in ("/", "/study", "/nowhere", "/researcher", "/static/study.js"):
        reply = client.get(path)
        headers = reply.headers
        policy = headers["Content-Security-Policy"]
        assert "unsafe" not in policy
        assert "default-src 'none'" in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["X-Frame-Options"] == "DENY"
        assert headers["Referrer-Policy"] == "no-referrer"
        stored = headers["Cache-Control"]
        assert stored == ("public, max-age=3600" if "static" in path else "no-store")
    cookie = client.get("/").headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=lax" in cookie
    secure = Client(create_app(store, Server(https=True))).get("/")
    assert "Secure" in secure.headers["Set-Cookie"]
    assert "max-age" in secure.headers["Strict-Transport-Security"]


def test_too_much_is_turned_away(store: Store, browser: Callable[[], Visitor]) -> None:
    visitor = browser()
    html = enter(visitor, store.invite(1, "person")[0])
    good = {n: field(html, n) for n in ("token", "sequence", "kind", "text")}
    client = visitor.client
    big = "x" * 10_000_000
    assert client.post("/study", data=good | {"agree": big}).status_code == 413
    assert client.post("/events", data=big).status_code in (403, 413)
    assert client.post("/enter", data={"invitation": big}).status_code == 413
    many = {f"field{i}": "" for i in range(5000)}
    assert client.post("/study", data=good | many).status_code in (400, 403, 413)
    deep = "[" * 60_000
    assert client.post("/events", data=deep).status_code in (400, 403)
    assert store.participant(_only(store)).state.accepted == 0


def _only(store: Store) -> str:
    (who,) = store.people
    return who


def test_requests_are_limited_by_participant_and_by_address(tmp_path: Path, study: Study) -> None:
    store = Store(tmp_path / "s.sqlite", study)
    slow = {
        "requests_per_second": 1e-6,
        "visitors_per_second": 1e-6,
    }
    app = create_app(store, Server(burst=20, visitor_burst=10, **slow))
    client = Client(app)
    statuses = [client.get("/").status_code for _ in range(12)]
    assert statuses[:10] == [200] * 10
    assert statuses[-1] == 429
    assert client.get("/").headers["Retry-After"] == "5"
    assert client.get("/static/study.css").status_code == 200
    other = Client(app)
    other.set_cookie(
        f"participant_{Keys(store.secret).mark}", Keys(store.secret).cookie(store.enter_as_pilot())
    )
    assert other.get("/study").status_code == 200  # not held back by the crowd
    assert {other.get("/study").status_code for _ in range(25)} == {200, 429}
    store.close()


def test_wrong_keys_of_researchers_hold_nobody_back(tmp_path: Path, study: Study) -> None:
    store = Store(tmp_path / "s.sqlite", study)
    app = create_app(store, Server(visitors_per_second=1e-6))
    guesser, researcher, newcomer = (Client(app) for _ in range(3))
    guesses = [guesser.post("/researcher/login", data={"key": f"{n}"}) for n in range(20)]
    assert [reply.status_code for reply in guesses[:GUESSES]] == [403] * GUESSES
    assert guesses[-1].status_code == 429
    assert newcomer.get("/").status_code == 200
    key = Keys(store.secret).researcher
    reply = researcher.post("/researcher/login", data={"key": key}, follow_redirects=True)
    assert (reply.status_code, "at a glance" in reply.text) == (200, True)
    # A crowd at the address does not hold back who is logged in, either.
    while newcomer.get("/").status_code == 200:
        pass
    assert researcher.get("/researcher").status_code == 200
    store.close()


def test_nonsense_on_every_route_gets_a_page(client: Client, store: Store) -> None:
    rng = np.random.default_rng(0)
    before = query(store, "SELECT count(*) AS n FROM event")
    for path in ("/", "/enter", "/study", "/events", "/researcher", "/researcher/login", "/x"):
        for method in ("GET", "POST", "PUT", "DELETE", "OPTIONS", "HEAD"):
            for kind in ("application/json", "multipart/form-data; boundary=x", "text/plain", "x"):
                body, headers = rng.bytes(200), {"content-type": kind}
                reply = client.open(
                    path + "?" + "%00%ff%f0" * 3, method=method, data=body, headers=headers
                )
                assert reply.status_code < 500, (path, method, kind)
    assert query(store, "SELECT count(*) AS n FROM event") == before
