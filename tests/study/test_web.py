"""The pages: the way through them, and everything a hostile visitor may try."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flask import Flask
from flask.testing import FlaskClient

from tests.study.conftest import FAULTLESS, GENEROUS, Visitor, enter, field
from tests.study.stand_in import street_plan
from xplain.errors import InputError
from xplain.participants.server.app import create_app
from xplain.participants.server.http import Server
from xplain.participants.server.map_svg import legend, picture
from xplain.participants.server.security import Keys, RateLimit
from xplain.participants.server.store import Store
from xplain.participants.simulation.http_client import Page, fill, visit
from xplain.study.protocol.plan import Study
from xplain.study.simulation.participant import Person


@pytest.fixture
def app(store: Store) -> Flask:
    return create_app(store, GENEROUS)


@pytest.fixture
def client(app: Flask) -> FlaskClient:
    return app.test_client()


def pages(visitor: Visitor, person: Person, invitation: str) -> Iterator[tuple[str, Page]]:
    """Every page on the way, before it is answered."""
    html = enter(visitor, invitation)
    while True:
        page = Page(html)
        yield html, page
        if not page.hidden:
            return
        status, html = visitor.post("/study", [*page.hidden.items(), *fill(person, page)[0]])
        assert status == 200


def test_the_way_from_entrance_to_code(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], Person]
) -> None:
    (token,) = store.invite(1, "person")
    seen = [page.stage for _, page in pages(browser(), person(), token)]
    m = store.study.plan.n_steps
    assert seen == [
        *("consent", "briefing", "training", "training", "eligibility"),
        *["evaluation"] * m,
        *("quiz", "questions", "done"),
    ]
    who = store.enter_invited(token)
    assert store.participant(who).code in browser_html(store, browser(), token)


def browser_html(store: Store, visitor: Visitor, token: str) -> str:
    enter(visitor, token)
    return visitor.get("/study")[1]


def test_reload_back_second_tab_and_double_click_change_nothing(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], Person]
) -> None:
    (token,) = store.invite(1, "person")
    one, two, old = browser(), browser(), []
    someone = person()
    for html, page in pages(one, someone, token):
        assert Page(one.get("/study")[1]).stage == page.stage  # reload
        enter(two, token)
        assert Page(two.get("/study")[1]).hidden == page.hidden  # another tab, another device
        for fields in old:  # every page before, sent once more
            status, again = one.post("/study", fields)
            assert status == 200
            assert Page(again).hidden == page.hidden
        if page.hidden:
            old.append([*page.hidden.items(), *_anything(page)])
        del html
    kinds = [e["kind"] for e in store.query("SELECT kind FROM event WHERE source = 'protocol'")]
    assert kinds == [
        *("consent", "read", "example", "example", "eligibility"),
        *["labels"] * store.study.plan.n_steps,
        *("quiz", "answers"),
    ]


def _anything(page: Page) -> list[tuple[str, str]]:
    return [(name, choices[-1].value) for name, choices in page.groups().items()]


def test_earlier_labels_stay_and_only_the_new_one_is_needed(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], Person]
) -> None:
    visitor = browser()
    for _, page in pages(visitor, person(), store.invite(1, "person")[0]):
        if page.stage == "evaluation":
            break
    hidden = dict(page.hidden)
    _, html = visitor.post("/study", [*hidden.items(), ("label_0", "0")])
    hidden = Page(html).hidden
    assert 'name="label_0" value="0" required checked' in html
    status, html = visitor.post("/study", [*hidden.items()])
    assert status == 400
    assert "Please label" in html
    status, html = visitor.post("/study", [*hidden.items(), ("label_1", "1")])
    assert status == 200
    labels = store.query("SELECT labels FROM step WHERE k = 1")
    assert labels == [{"labels": "[0, 1]"}]


def test_forged_answers_are_turned_away_and_leave_no_trace(
    store: Store, client: FlaskClient, browser: Callable[[], Visitor]
) -> None:
    visitor = browser()
    html = enter(visitor, store.invite(1, "person")[0])
    token, text = field(html, "token"), field(html, "text")
    good = {"token": token, "sequence": "0", "kind": "consent", "agree": "1", "text": text}
    before = store.query("SELECT * FROM event"), store.query("SELECT * FROM participant")
    forged: list[dict[str, str]] = [
        good | {"token": ""},
        good | {"token": "0" * 64},
        good | {"sequence": "1"},
        good | {"sequence": "-1"},
        good | {"sequence": "٣"},
        good | {"sequence": "9" * 4000},
        good | {"kind": "labels"},
        good | {"kind": "time_out"},
        good | {"kind": "<script>"},
        good | {"agree": "2"},
        good | {"agree": "true"},
        good | {"text": "0" * 64},
        {k: v for k, v in good.items() if k != "sequence"},
        # What only the server decides is not heard.
        good | {"agree": "", "user_type": "1", "condition": "conformant", "orders": "{}"},
    ]
    for fields in forged:
        status, _ = visitor.post("/study", list(fields.items()))
        assert 400 <= status < 500, fields
    assert client.post("/study", data=good).status_code == 403  # no cookie
    assert before == (
        store.query("SELECT * FROM event"),
        [row | {"seen": before[1][0]["seen"]} for row in store.query("SELECT * FROM participant")],
    )


def test_nobody_can_be_somebody_else(
    store: Store, app: Flask, browser: Callable[[], Visitor]
) -> None:
    one, two = browser(), browser()
    first, second = (
        enter(v, t) for v, t in zip((one, two), store.invite(2, "person"), strict=True)
    )
    # The other one's form with one's own cookie.
    fields = [(n, field(first, n)) for n in ("token", "sequence", "kind", "text")]
    status, _ = two.post("/study", [*fields, ("agree", "1")])
    assert status == 403
    assert field(first, "token") != field(second, "token")
    # A cookie made from the other one's id, without the server's key.
    ids = [row["id"] for row in store.query("SELECT id FROM participant")]
    for value in (*ids, f"{ids[0]}.", f"{ids[0]}.{'0' * 64}", "." * 9, "\x00", "é" * 40):
        client = app.test_client()
        client.set_cookie("participant", value)
        assert client.get("/study").status_code == 403
        assert client.post("/events", json={}).status_code == 403


def test_headers_keep_browsers_strict(client: FlaskClient, store: Store) -> None:
    for path in ("/", "/study", "/nowhere", "/researcher", "/static/study.js"):
        reply = client.get(path)
        headers = reply.headers
        reply.close()
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
    assert "SameSite=Lax" in cookie
    secure = create_app(store, Server(https=True)).test_client().get("/")
    assert "Secure" in secure.headers["Set-Cookie"]
    assert "max-age" in secure.headers["Strict-Transport-Security"]


def test_pages_have_no_inline_script_or_style_and_load_nothing_from_elsewhere(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], Person]
) -> None:
    for html, page in pages(browser(), person(), store.invite(1, "bot")[0]):
        assert not re.search(r"<script(?! src=\"/static)", html), page.stage
        assert not re.search(r"\son\w+=|\sstyle=|<style|javascript:", html), page.stage
        assert not re.search(r"(src|href)=\"(?!/|#)", html), page.stage
        assert "Simulated participant" in html  # bots are marked on every page too
        assert not re.search(r"conformant|personalized|type [XYZ]", html), page.stage


def test_what_people_write_is_escaped_everywhere(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], Person]
) -> None:
    attack = "<script>alert(1)</script>\"'><img src=x onerror=alert(1)>{{7*7}}\x00\u202e"
    visitor = browser()
    _, html = visitor.get("/?invitation=" + "%3Cscript%3Ealert(1)%3C/script%3E&PROLIFIC_PID=%22%3E")
    assert "<script>alert" not in html
    for html, page in pages(visitor, person(), store.invite(1, "person")[0]):
        assert "<script>alert" not in html
        if page.stage == "questions":
            fields = [*page.hidden.items(), ("age", attack), ("comment", attack)]
            status, html = visitor.post("/study", fields)
            assert status == 400
            assert "<script>alert" not in html
            visitor.post("/study", [*page.hidden.items(), ("age", "30"), ("comment", attack)])
            break
    (row,) = store.query("SELECT payload FROM event WHERE kind = 'answers'")
    assert "<script>" in row["payload"]  # kept as it was written
    _, html = visitor.get("/researcher")
    assert "<script>alert" not in html
    # The domain's own sentences are text, too.
    plan = street_plan()
    assert "<robot>" in plan.facts[0].belief


def test_sentences_of_the_domain_are_escaped(
    store: Store, browser: Callable[[], Visitor], person: Callable[[], Person]
) -> None:
    for html, page in pages(browser(), person(), store.invite(1, "person")[0]):
        assert "<robot>" not in html
        if page.stage == "briefing":
            assert "&lt;robot&gt;" in html
            assert "fine for the robot &amp; quick" in html


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
    (row,) = store.query("SELECT id FROM participant")
    return str(row["id"])


@pytest.mark.parametrize(
    "change",
    [
        {"tab": "short"},
        {"tab": 5},
        {"items": {}},
        {"items": [5]},
        {"items": [{"n": 0}] * 51},
        {"items": [{"n": -1, "kind": "visible", "ms": 1, "at": 1}]},
        {"items": [{"n": True, "kind": "visible", "ms": 1, "at": 1}]},
        {"items": [{"n": 0, "kind": "labels", "ms": 1, "at": 1}]},
        {"items": [{"n": 0, "kind": "visible", "ms": float("nan"), "at": 1}]},
        {"items": [{"n": 0, "kind": "visible", "ms": 1e300, "at": 1}]},
        {"items": [{"n": 0, "kind": "visible", "ms": 1, "at": "1"}]},
        {"items": [{"n": 0, "kind": "visible", "ms": 1, "at": 1, "what": "x" * 41}]},
        {"token": None},
        {"token": "0" * 64},
    ],
)
def test_reports_of_pages_are_checked(
    store: Store, browser: Callable[[], Visitor], change: dict[str, Any]
) -> None:
    visitor = browser()
    token = field(enter(visitor, store.invite(1, "person")[0]), "token")
    item = {"n": 0, "kind": "visible", "ms": 1.5, "at": 1e12, "what": "consent"}
    good = {"token": token, "tab": "0123456789abcdef", "items": [item]}
    assert visitor.client.post("/events", json=good).status_code == 200
    assert 400 <= visitor.client.post("/events", json=good | change).status_code < 500
    assert store.query("SELECT count(*) AS n FROM event WHERE kind = 'visible'") == [{"n": 1}]


def test_requests_are_limited_by_participant_and_by_address(tmp_path: Path, study: Study) -> None:
    store = Store(tmp_path / "s.sqlite", study)
    app = create_app(store, Server(burst=20, visitor_burst=10))
    client = app.test_client()
    statuses = [client.get("/").status_code for _ in range(12)]
    assert statuses[:10] == [200] * 10
    assert statuses[-1] == 429
    assert client.get("/").headers["Retry-After"] == "5"
    with client.get("/static/study.css") as style:
        assert style.status_code == 200
    other = app.test_client()
    other.set_cookie("participant", Keys(store.keyed).cookie(store.enter_open()))
    assert other.get("/study").status_code == 200  # not held back by the crowd
    assert {other.get("/study").status_code for _ in range(25)} == {200, 429}
    store.close()


def test_a_bucket_fills_up_again_and_forgets_the_oldest() -> None:
    now = [0.0]
    limit = RateLimit(2.0, 3.0, lambda: now[0], most=2)
    assert [limit.allows("a") for _ in range(4)] == [True, True, True, False]
    now[0] = 0.5
    assert [limit.allows("a") for _ in range(2)] == [True, False]
    limit.allows("b")
    limit.allows("c")
    assert len(limit._buckets) == 2
    assert limit.allows("a")


def test_entry_is_as_configured(store: Store) -> None:
    closed = create_app(store, Server(entry=("prolific",))).test_client()
    html = closed.get("/").text
    visitor = field(html, "token")
    assert 'name="invitation"' not in html
    (token,) = store.invite(1, "person")
    for data in ({"invitation": token}, {}, {"invitation": ""}):
        assert closed.post("/enter", data=data | {"token": visitor}).status_code == 403
    ids = {"PROLIFIC_PID": "p", "STUDY_ID": "s", "SESSION_ID": "x"}
    assert closed.post("/enter", data=ids).status_code == 403  # without the form's token
    assert closed.post("/enter", data=ids | {"token": visitor}).status_code == 303
    long = ids | {"PROLIFIC_PID": "p" * 101, "token": visitor}
    assert closed.post("/enter", data=long).status_code == 403
    with pytest.raises(InputError, match=r"server\.entry"):
        Server(entry=("anybody",))


def test_the_platform_gets_its_code_back(store: Store, person: Callable[[], Person]) -> None:
    server = Server(
        completion_url="https://example.org/back?cc={code}",
        completion_code="C0DE",
        burst=1e9,
        visitor_burst=1e9,
    )
    visitor = Visitor(create_app(store, server).test_client())
    *_, (html, _) = pages(visitor, person(), store.invite(1, "person")[0])
    assert 'href="https://example.org/back?cc=C0DE"' in html


def test_the_researchers_page_needs_its_key(store: Store, client: FlaskClient) -> None:
    assert "Who is where" not in client.get("/researcher").text
    for path in ("/researcher/invitations", "/researcher/export"):
        assert client.post(path, data={"count": "1", "stream": "bot"}).status_code == 403
    assert client.post("/researcher/login", data={"key": "guess"}).status_code == 403
    keys = Keys(store.keyed)
    done = client.post("/researcher/login", data={"key": keys.researcher})
    assert done.status_code == 303
    assert "SameSite=Strict" in done.headers["Set-Cookie"]
    html = client.get("/researcher").text
    assert "Who is where" in html
    token = field(html, "token")
    good = {"token": token, "count": "3", "stream": "pilot"}
    for bad in ({"count": "0"}, {"count": "501"}, {"count": "x"}, {"stream": "king"}):
        assert client.post("/researcher/invitations", data=good | bad).status_code == 400
    assert client.post("/researcher/invitations", data=good | {"token": ""}).status_code == 403
    html = client.post("/researcher/invitations", data=good).text
    tokens = re.findall(r"\?invitation=([\w-]+)", html)
    assert len(tokens) == 3
    assert store.participant(store.enter_invited(tokens[0])).stream == "pilot"
    archive = client.post("/researcher/export", data={"token": token})
    assert archive.data[:2] == b"PK"


def test_the_map_says_what_happened_and_a_domain_without_one_does_without(study: Study) -> None:
    plan = study.plan
    assert [name for name, _ in legend(plan)] == ["bridge", "market", "school", "tunnel"]
    for k in range(1, plan.n_steps + 1):
        svg = picture(plan, k)
        numbers = re.findall(r'font-weight="700" fill="#fff">([\d·]+)</text>', svg)
        assert [int(n) for text in numbers for n in text.split("·")] == list(range(1, k + 1))
        assert "style=" not in svg
    assert ">B<" in picture(plan, 1)  # a letter where there is no icon
    assert plan.icons["market"] in picture(plan, 1)
    assert picture(street_plan(map_shown=False), 1) == ""


def test_a_domain_without_a_map_gets_its_study(tmp_path: Path) -> None:
    from xplain.study.prepare import study_of

    study = study_of(street_plan(map_shown=False, questions=[]))
    store = Store(tmp_path / "s.sqlite", study)
    visitor = Visitor(create_app(store, GENEROUS).test_client())
    person = Person(study.plan, FAULTLESS, np.random.default_rng(0))
    assert visit(visitor, person, store.invite(1, "bot")[0]) == "done"
    store.close()


def test_nonsense_on_every_route_gets_a_page(client: FlaskClient, store: Store) -> None:
    rng = np.random.default_rng(0)
    before = store.query("SELECT count(*) AS n FROM event")
    for path in ("/", "/enter", "/study", "/events", "/researcher", "/researcher/login", "/x"):
        for method in ("GET", "POST", "PUT", "DELETE", "OPTIONS", "HEAD"):
            for kind in ("application/json", "multipart/form-data; boundary=x", "text/plain", "\t"):
                body = rng.bytes(200)
                reply = client.open(
                    path + "?" + "%00%ff%f0" * 3, method=method, data=body, content_type=kind
                )
                assert reply.status_code < 500, (path, method, kind)
    assert store.query("SELECT count(*) AS n FROM event") == before
